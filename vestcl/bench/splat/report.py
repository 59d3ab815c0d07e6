"""The tables, figures and plots of `vestcl bench splat`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from rich import box
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from vestcl.bench.common import plots as _plots
from vestcl.bench.common.results import X_COPY, Measure
from vestcl.bench.common.timing import Spread, is_quiet
from vestcl.bench.splat.kernels import Profile
from vestcl.bench.splat.measure import Facts, Memory, Pass, Peers, Ratio, Speed, growth
from vestcl.evaluation.tables import Grid

#: What a cell may end with, and its colour on the screen.
_VERDICTS: Final = {"reached": "green", "missed": "red", "can't tell": "yellow", "better": "green", "worse": "red"}

_AGAIN: Final = "measure again"


def screen(grid: Grid) -> RenderableType:
    """For the terminal: a row's verdict in its colour, and in red the note that other processes disturbed it."""
    table = Table(title=Text(grid.title, "italic"), title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    for number, heading in enumerate(grid.heading):
        table.add_column(Text(heading), justify="right" if number else "left")
    for row in grid.rows:
        table.add_row(*map(_coloured, row))
    if grid.notes:
        table.caption = Text("\n").join(Text(note, "red" if note.endswith(_AGAIN) else "") for note in grid.notes)
        table.caption_style, table.caption_justify = "", "left"
    return table


def _coloured(cell: str) -> Text:
    text = Text(cell)
    for verdict, colour in _VERDICTS.items():
        text.highlight_regex(f"{verdict}$", colour)
    return text


def milliseconds(spread: Spread) -> str:
    """Median and quartiles."""
    return f"{spread.median * 1e3:.2f} ({spread.low * 1e3:.2f}-{spread.high * 1e3:.2f})"


def busy(*others_cores: float | None) -> tuple[str, ...]:
    """A note where other processes disturbed what a table shows."""
    busiest = max((cores or 0.0 for cores in others_cores), default=0.0)
    if is_quiet(busiest):
        return ()
    return (f"other processes kept {busiest:.1f} cores busy meanwhile: {_AGAIN}",)


def _times(spread: Spread) -> str:
    return f"{spread.median:.1f}"


def _verdict(ratio: Ratio, sign: str) -> str:
    if ratio.target is None:
        return ""
    verdicts = {True: "reached", False: "missed", None: "can't tell"}
    return f"{sign} {ratio.target:g} {verdicts[ratio.reached]}"


def _size(facts: Facts) -> str:
    return f"{facts.height}x{facts.width}, C = {facts.channels}, radius {facts.radius:g}"


def _scene(facts: Facts) -> str:
    return f"{_size(facts)} px: {facts.fragments:,} fragments, at most {facts.most_layers} on a pixel"


def _passes(speed: Speed) -> tuple[tuple[str, Pass], ...]:
    return ("forward", speed.forward), ("forward + backward", speed.both)


# ---------------------------------------------------------------- tables


def speed_grid(speed: Speed) -> Grid:
    """One scene beside the copies of its bytes."""
    rows = []
    for name, one in _passes(speed):
        verdict = _verdict(one.copies, "<=")
        row = name, milliseconds(one.time), str(one.time.runs), _times(one.copies.spread), verdict
        rows.append((*row, _times(one.forward_copies)))
    for name, copy in (("forward", speed.forward_copy), ("backward", speed.backward_copy)):
        label = f"{name} copy, {copy.megabytes:.0f} MB, {copy.by}"
        rows.append((label, milliseconds(copy.time), str(copy.time.runs), "", "", ""))
    heading = "", "ms (quartiles)", "runs", "x copy", "target", "x forward copy"
    return Grid(_scene(speed.facts), heading, tuple(rows), busy(speed.others_cores))


def peer_grid(result: Peers) -> Grid:
    """vestcl and the peers: times, ratios and errors."""
    heading = ("", "forward ms", "both ms", "x vestcl", "x, both", "target", *result.peers[0].errors)
    rows = []
    for peer in result.peers:
        ratios = _times(peer.forward_ratio), _times(peer.both_ratio.spread), _verdict(peer.both_ratio, ">=")
        times = (f"{spread.median * 1e3:.1f}" for spread in (peer.forward, peer.both))
        rows.append((peer.name, *times, *ratios, *(f"{error:.0e}" for error in peer.errors.values())))
    title = f"{_scene(result.facts)}; errors relative to the twin in float64"
    return Grid(title, heading, tuple(rows), busy(result.others_cores))


def kernel_grid(profile: Profile) -> Grid:
    """The kernels of one forward + backward."""
    rows = []
    for kernel in profile.kernels:
        moved = "-" if kernel.megabytes is None else f"{kernel.megabytes:.1f}"
        speed = "-" if kernel.gigabytes_per_second is None else f"{kernel.gigabytes_per_second:.1f}"
        rows.append((kernel.name, str(kernel.launches), f"{kernel.time.median * 1e3:.3f}", moved, speed))
    rows.append(("no kernel running", "", f"{profile.between * 1e3:.3f}", "", ""))
    rows.append(("the call, profiled", "", f"{profile.call.median * 1e3:.3f}", "", ""))
    title = f"Kernels of one forward + backward, radius {profile.radius:g} px"
    return Grid(title, ("", "launches", "ms", "MB", "GB/s"), tuple(rows), busy(profile.others_cores))


def memory_grid(memories: Sequence[Memory]) -> Grid:
    """Scratch memory beside the features."""
    rows = []
    for one in memories:
        verdict = f"<= {one.target:g} {'reached' if one.reached else 'missed'}"
        sizes = (f"{size / 1e6:.1f}" for size in (one.scratch_bytes, one.features_bytes))
        rows.append((f"radius {one.radius:g} px", *sizes, f"{one.ratio:.2f}", verdict))
    title = "Scratch memory of forward + backward"
    return Grid(title, ("", "MB", "features MB", "x features", "target"), tuple(rows))


def series_grid(title: str, speeds: Sequence[Speed]) -> Grid:
    """Time per pixel, over sizes or channels."""
    heading = "", "C", "forward ms", "ns/pixel", "x copy", "both ms", "ns/pixel", "x copy", "copy ns/pixel"
    rows = []
    for speed in speeds:
        facts = speed.facts
        pixels, cells = facts.height * facts.width, []
        for _, one in _passes(speed):
            median = one.time.median
            cells += [f"{median * 1e3:.2f}", f"{median * 1e9 / pixels:.1f}", _times(one.copies.spread)]
        copy = f"{speed.forward_copy.time.median * 1e9 / pixels:.1f}"
        rows.append((f"{facts.height}x{facts.width}, radius {facts.radius:g}", str(facts.channels), *cells, copy))
    notes = *growth_lines(speeds), *busy(*(speed.others_cores for speed in speeds))
    return Grid(title, heading, tuple(rows), notes)


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


# ---------------------------------------------------------------- figures


def speed_measures(speed: Speed) -> Iterator[Measure]:
    """Times, and as multiples of the copy."""
    for name, one in _passes(speed):
        full = f"splat {name}, {_size(speed.facts)}"
        yield Measure.of(full, "s", one.time)
        yield Measure.of(full + X_COPY, "1", one.copies.spread)


def peer_measures(result: Peers) -> Iterator[Measure]:
    """Each peer's times over vestcl's."""
    for peer in result.peers[1:]:
        yield Measure.of(f"{peer.name} / splat forward, {_size(result.facts)}", "1", peer.forward_ratio, "higher")
        both = f"{peer.name} / splat forward + backward, {_size(result.facts)}"
        yield Measure.of(both, "1", peer.both_ratio.spread, "higher")


def inside_measures(profile: Profile, memory: Memory) -> Iterator[Measure]:
    """Kernels, and scratch memory."""
    for kernel in profile.kernels:
        yield Measure.of(f"kernel {kernel.name}, radius {profile.radius:g}", "s", kernel.time)
    size = float(memory.scratch_bytes)
    yield Measure(f"scratch memory, radius {memory.radius:g}", "B", size, size, size)


# ---------------------------------------------------------------- plots


def series_plot(path: Path, title: str, speeds: Sequence[Speed], over_size: bool) -> Path:
    """Time over points or channels: splat's passes, and the copies of their bytes dashed."""
    lines = []
    for radius in dict.fromkeys(speed.facts.radius for speed in speeds):
        those = [speed for speed in speeds if speed.facts.radius == radius]
        x = [one.facts.points if over_size else one.facts.channels for one in those]
        for number, (name, _) in enumerate(_passes(those[0])):
            times = [_passes(one)[number][1].time for one in those]
            lines.append(_plots.Curve(f"{name}, radius {radius:g}", x, times, 1e3))
        if radius == speeds[0].facts.radius:
            copy = _plots.Curve("copy of the forward's bytes", x, [s.forward_copy.time for s in those], 1e3, True)
    x_label = "points (and pixels)" if over_size else "channels"
    return _plots.curves(path, title, x_label, "ms", [*lines, copy])


def kernel_plot(path: Path, title: str, profiles: Sequence[Profile]) -> Path:
    """The kernels of each radius as bars."""
    groups = {f"radius {one.radius:g} px": {kernel.name: kernel.time for kernel in one.kernels} for one in profiles}
    return _plots.bars(path, title, "ms in one forward + backward", groups, 1e3)
