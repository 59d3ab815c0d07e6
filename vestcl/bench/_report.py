"""The tables of `vestcl bench splat`."""

from collections.abc import Iterator, Sequence

from rich import box
from rich.console import RenderableType
from rich.table import Table

from vestcl.bench._kernels import Profile
from vestcl.bench._measure import Facts, Memory, Peers, Ratio, Speed, growth
from vestcl.bench._timing import Spread, is_quiet


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    table.add_column(columns[0])
    for column in columns[1:]:
        table.add_column(column, justify="right")
    return table


def _ms(spread: Spread) -> str:
    return f"{spread.median * 1e3:.2f} ({spread.low * 1e3:.2f}-{spread.high * 1e3:.2f})"


def _times(spread: Spread) -> str:
    return f"{spread.median:.1f}"


def _verdict(ratio: Ratio, sign: str) -> str:
    if ratio.target is None:
        return ""
    verdicts = {True: "[green]reached[/]", False: "[red]missed[/]", None: "[yellow]can't tell[/]"}
    return f"{sign} {ratio.target:g} {verdicts[ratio.reached]}"


def _finished(table: Table, *others_cores: float | None) -> Table:
    """``table``, saying so below where other processes disturbed what it shows."""
    busiest = max((cores or 0.0 for cores in others_cores), default=0.0)
    if not is_quiet(busiest):
        table.caption = f"other processes kept {busiest:.1f} cores busy meanwhile: measure again"
        table.caption_style, table.caption_justify = "red", "left"
    return table


def _scene(facts: Facts) -> str:
    scene = f"{facts.height}x{facts.width}, C = {facts.channels}, radius {facts.radius:g} px"
    return f"{scene}: {facts.fragments:,} fragments, at most {facts.most_layers} on a pixel"


def speed_table(speed: Speed) -> RenderableType:
    """One scene beside the copies of its bytes."""
    table = _table(_scene(speed.facts), "", "ms (quartiles)", "runs", "x copy", "target", "x forward copy")
    for name, one in (("forward", speed.forward), ("forward + backward", speed.both)):
        cells = _ms(one.time), str(one.time.runs), _times(one.copies.spread), _verdict(one.copies, "<=")
        table.add_row(name, *cells, _times(one.forward_copies))
    for name, copy in (("forward", speed.forward_copy), ("backward", speed.backward_copy)):
        table.add_row(f"{name} copy, {copy.megabytes:.0f} MB, {copy.by}", _ms(copy.time), str(copy.time.runs))
    return _finished(table, speed.others_cores)


def peer_table(result: Peers) -> RenderableType:
    """vestcl and the peers: times, ratios and errors."""
    columns = ("", "forward ms", "both ms", "x vestcl", "x, both", "target", *result.peers[0].errors)
    table = _table(f"{_scene(result.facts)}; errors relative to the twin in float64", *columns)
    for peer in result.peers:
        ratios = _times(peer.forward_ratio), _times(peer.both_ratio.spread), _verdict(peer.both_ratio, ">=")
        times = (f"{spread.median * 1e3:.1f}" for spread in (peer.forward, peer.both))
        table.add_row(peer.name, *times, *ratios, *(f"{error:.0e}" for error in peer.errors.values()))
    return _finished(table, result.others_cores)


def kernel_table(profile: Profile) -> RenderableType:
    """The kernels of one forward + backward."""
    table = _table(
        f"Kernels of one forward + backward, radius {profile.radius:g} px", "", "launches", "ms", "MB", "GB/s"
    )
    for kernel in profile.kernels:
        moved = "-" if kernel.megabytes is None else f"{kernel.megabytes:.1f}"
        speed = "-" if kernel.gigabytes_per_second is None else f"{kernel.gigabytes_per_second:.1f}"
        table.add_row(kernel.name, str(kernel.launches), f"{kernel.time.median * 1e3:.3f}", moved, speed)
    table.add_row("no kernel running", "", f"{profile.between * 1e3:.3f}")
    table.add_row("the call, profiled", "", f"{profile.call.median * 1e3:.3f}")
    return _finished(table, profile.others_cores)


def memory_line(memory: Memory) -> str:
    """Scratch memory in a sentence."""
    verdict = "[green]reached[/]" if memory.reached else "[red]missed[/]"
    return (
        f"Scratch memory of forward + backward, radius {memory.radius:g} px: {memory.scratch_bytes / 1e6:.1f} MB, "
        f"{memory.ratio:.2f} x the features ({memory.features_bytes / 1e6:.1f} MB); <= {memory.target:g} {verdict}"
    )


def series_table(title: str, speeds: Sequence[Speed]) -> RenderableType:
    """Time per pixel, over sizes or channels."""
    table = _table(title, "", "C", "forward ms", "ns/pixel", "x copy", "both ms", "ns/pixel", "x copy", "copy ns/pixel")
    for speed in speeds:
        facts = speed.facts
        pixels, cells = facts.height * facts.width, []
        for one in (speed.forward, speed.both):
            median = one.time.median
            cells += [f"{median * 1e3:.2f}", f"{median * 1e9 / pixels:.1f}", _times(one.copies.spread)]
        copy = f"{speed.forward_copy.time.median * 1e9 / pixels:.1f}"
        table.add_row(f"{facts.height}x{facts.width}, radius {facts.radius:g}", str(facts.channels), *cells, copy)
    return _finished(table, *(speed.others_cores for speed in speeds))


def growth_lines(speeds: Sequence[Speed]) -> Iterator[str]:
    """How time grows with size, a sentence a radius; none where size stays the same."""
    for radius in dict.fromkeys(speed.facts.radius for speed in speeds):
        those = [speed for speed in speeds if speed.facts.radius == radius]
        pixels = [speed.facts.height * speed.facts.width for speed in those]
        if len(set(pixels)) > 1:
            forward, both = (
                growth(pixels, [getattr(speed, name).time.median for speed in those]) for name in ("forward", "both")
            )
            yield f"radius {radius:g}: time ~ pixels^{forward:.2f} forward, pixels^{both:.2f} with backward (1: linear)"
