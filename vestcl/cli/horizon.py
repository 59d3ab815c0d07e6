"""How far `vestcl forecast` forecasts, and from which frame: --steps, --seconds, --frame."""

from typing import Final

from vestcl import times
from vestcl.cli import checks, commands
from vestcl.cli.options import RANGES
from vestcl.constants import DEFAULT_STEPS
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input

#: Frames of a street up to the current one where no frame is asked for: SPEC section 10.
STREET_CONTEXT: Final = 4

#: Frames of a street that is made for one forecast: a quarter of an hour.
MOST_STREET_FRAMES: Final = 10_000


def steps_of(options: commands.Forecast, interval: float | None, where: str) -> int:
    """The steps to forecast in a clip.

    Args:
        options: with steps, seconds or neither of them.
        interval: of the clip, seconds; None is not known.
        where: what a message begins with.

    Raises:
        ValueError: seconds that can't be counted in intervals, or too many steps.
    """
    if options.seconds is None:
        return DEFAULT_STEPS if options.steps is None else options.steps
    steps = times.steps_ahead(options.seconds, interval, where)
    if fault := RANGES["steps"].fault(steps):
        raise ValueError(f"{where}: the steps of `seconds` {options.seconds:g} {fault}, got {steps:,}")
    return steps


def horizon_line(options: commands.Forecast, clip: Clip, steps: int) -> str | None:
    """What ``seconds`` became in a clip; None where it is not given."""
    if options.seconds is None or clip.interval is None:
        return None
    length, ahead = f"{clip.interval:.3g} s", steps * clip.interval
    plural = "s" * (steps != 1)
    rounded = "" if abs(ahead - options.seconds) < 1e-3 * clip.interval else f", {ahead:.3g} s in all"
    return f"--seconds {options.seconds:g}: {steps} step{plural} of {length}{rounded} ({clip.name})"


def street_frames(options: commands.Forecast, text: str) -> int:
    """Frames of a street that the forecast takes, seen ones and true ones; other clips have theirs.

    Raises:
        ValueError: too many.
    """
    street = checks.one_street(text)
    if street is None or street.seeds is None:
        return 1
    current = STREET_CONTEXT - 1 if options.frame is None else options.frame
    rate = street.driven.drawn(street.seeds[0]).fps or street_input.DEFAULT_RATE
    frames = current + 1 + (steps_of(options, 1 / float(rate), text) if options.compare else 0)
    if frames > MOST_STREET_FRAMES:
        raise ValueError(f"`frame` must be below {MOST_STREET_FRAMES:,} in a street, got {current}")
    return max(frames, 1)


def current_frame(clip: Clip, options: commands.Forecast, steps: int) -> int:
    """The index t of the last frame that the forecast may see.

    Without ``frame`` the clip's last one; to compare, the last one with a true frame at each of ``steps`` intervals
    after it.

    Raises:
        ValueError: no such frame, none before it, or none after it to compare with.
    """
    last = len(clip) - 1
    index = options.frame
    if index is None:
        whole = (i for i in range(last, 0, -1) if not options.compare or len(clip.after(i, steps)) == steps)
        index = next(whole, 0)
        if index < 1:
            wanted = f"{steps + 2} frames to compare {steps} steps" if options.compare else "2 frames"
            wanted += " without a gap" if last > steps else ""
            raise ValueError(f"{options.input[0]}: must have {wanted}, got {last + 1}")
    highest = last - 1 if options.compare else last
    if not 1 <= index <= highest:
        why = "have a frame before it" + (" and one after it to compare with" if options.compare else "")
        raise ValueError(f"`frame` must be 1 ... {highest}, to {why}, got {index}")
    return index
