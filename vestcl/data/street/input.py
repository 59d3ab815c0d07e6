"""Procedural streets by name: "street:7", "street:7-20", "street:7?drive=road,fps=12.5,depth=stereo,masks=motion"."""

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from vestcl.data import street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.data.street.clip import StreetDepth
from vestcl.data.street.driving.drive import Sway
from vestcl.data.street.driving.road import RoadDrive
from vestcl.data.street.sensors import BEAMS, DisturbedLabels, StreetScan
from vestcl.data.street.street import Street

#: Drawn for each street by its seed.
RANDOM: Final = "random"

#: Streets of one input: more are a slip of the finger, and listing them would not end.
MOST_STREETS: Final = 100_000

#: Frames a second that `RANDOM` draws from, and that may be given.
RATES: Final = (8.0, 30.0)
ALL_RATES: Final = (0.1, 240.0)

#: Frames per second without any given.
DEFAULT_RATE: Final = 10.0

#: Height and width of a street in pixels if none is given: SPEC section 10.
DEFAULT_SIZE: Final = (256, 832)

#: With random driving, a street's clip starts somewhere in its first minute, so that all phases of its sway come up.
STARTS: Final = (0.0, 60.0)

#: Streams of the random numbers of a street.
_DRIVE, _START, _RATE, _DEPTH, _MASKS, _BEAMS = range(1, 7)

_PATTERN: Final = re.compile(r"street:(?:(\d{1,18})(?:-(\d{1,18}))?)?(?:\?(.*))?")
_CHOICES: Final = {
    "drive": ("usual", "random", "road"),
    "depth": ("true", "stereo", "motion", "scan", RANDOM),
    "masks": ("true", "motion", "disturbed", RANDOM),
}


@dataclass(frozen=True)
class Driven:
    """How a street is driven and seen. None is not given."""

    drive: str | None = None
    """"usual": a straight street, as it has been since version 0.1; "random": the same with the sway of `Sway.drawn`,
    from a random time on; "road": `RoadDrive`."""
    fps: float | str | None = None
    """Frames per second, or "random"."""
    depth: str | None = None
    """Where depth comes from: "true", "stereo", "motion" or "scan", or "random": one of the latter three."""
    masks: str | None = None
    """Where masks come from: "true" labels, "motion", or "disturbed" labels, or "random": one of the latter two."""

    def named(self) -> str:
        """ "drive=road fps=12.5": what is given."""
        given = {name: getattr(self, name) for name in ("drive", "fps", "depth", "masks")}
        return " ".join(f"{name}={_text(value)}" for name, value in given.items() if value is not None)

    def drawn(self, seed: int) -> "Driven":
        """With what the street of ``seed`` has where "random" is asked for; the random drive stays."""
        fps, depth, masks = self.fps, self.depth, self.masks
        if fps == RANDOM:
            fps = round(float(np.random.default_rng([seed, _RATE]).uniform(*RATES)), 2)
        if depth == RANDOM:
            depth = str(np.random.default_rng([seed, _DEPTH]).choice(["stereo", "motion", "scan"]))
        if masks == RANDOM:
            masks = str(np.random.default_rng([seed, _MASKS]).choice(["motion", "disturbed"]))
        return Driven(self.drive, fps, depth, masks)

    def over(self, other: "Driven") -> "Driven":
        """What is given here, else there."""
        return Driven(*(getattr(self, name) or getattr(other, name) for name in ("drive", "fps", "depth", "masks")))


#: Nothing given.
DEFAULT: Final = Driven()


@dataclass(frozen=True)
class StreetInput:
    """The content of an input's text."""

    seeds: range | None
    """None without a seed."""
    driven: Driven
    text: str

    def each(self) -> list[str]:
        """An input for each seed.

        Raises:
            ValueError: more than `MOST_STREETS`.
        """
        if len(self.seeds or ()) > MOST_STREETS:
            raise ValueError(f"`inputs` must have {MOST_STREETS:,} streets or fewer, got {self.text}")
        _, mark, options = self.text.partition("?")
        return [f"street:{seed}{mark}{options}" for seed in self.seeds or ()]


def parse(text: str) -> StreetInput | None:
    """What "street:SEED", "street:FIRST-LAST" or "street:", with "?KEY=VALUE,KEY=VALUE" or not, says.

    Returns:
        None for any other text.

    Raises:
        ValueError: seeds in the wrong order, an option that a street does not have.
    """
    found = _PATTERN.fullmatch(text)
    if found is None:
        return None
    first, last, options = found[1], found[2] or found[1], found[3]
    seeds = None if first is None else range(int(first), int(last) + 1)
    if seeds is not None and not seeds:
        raise ValueError(f"`inputs` must have streets from a lower to a higher seed, got {text}")
    return StreetInput(seeds, DEFAULT if options is None else _options(text, options), text)


def street(seed: int, driven: Driven) -> tuple[Street, float]:
    """The street of ``seed``, driven as asked for, and the time in seconds at which a clip of it starts."""
    made = Street.generate(seed)
    if driven.drive == "random":
        start = float(np.random.default_rng([seed, _START]).uniform(*STARTS))
        return replace(made, drive=Sway.drawn(np.random.default_rng([seed, _DRIVE]))), start
    return (replace(made, drive=RoadDrive.drawn(seed)) if driven.drive == "road" else made), 0.0


def clip(seed: int, driven: Driven, frames: int, size: tuple[int, int], samples: int = 1, name: str = "") -> Clip:
    """A clip of the street of ``seed``.

    Args:
        seed: 0 or more.
        driven: how; nothing given is the default drive at 10 frames per second with true depth and labels.
        frames: how many.
        size: (height, width) px.
        samples: as `Street.render` has them.
        name: follows "street SEED" in the clip's name.

    Returns:
        The clip. Its right camera is there with depth from motion, too: `perceived` leaves it out.
    """
    driven = driven.drawn(seed)
    made, start = street(seed, driven)
    fps = DEFAULT_RATE if driven.fps is None else float(driven.fps)
    plain = street_clip(made, frames, *size, start=start, samples=samples, fps=fps)
    beams = int(np.random.default_rng([seed, _BEAMS]).choice(BEAMS))
    seen = tuple(_seen(sample, index, driven, beams) for index, sample in enumerate(plain))
    return replace(plain, name=f"{plain.name} {name}".rstrip(), samples=seen)


def perceived(clip: Clip, driven: Driven) -> Clip:
    """The clip as perception sees it: with depth from motion it has one camera."""
    if driven.depth != "motion":
        return clip
    return replace(clip, samples=tuple(replace(sample, right=None) for sample in clip))


def _seen(sample: Sample, index: int, driven: Driven, beams: int) -> Sample:
    if driven.depth is None and driven.masks is None:
        return sample
    assert isinstance(sample.depth, StreetDepth)
    shot = sample.depth.shot
    if driven.depth in ("stereo", "motion"):
        sample = replace(sample, depth=None)
    elif driven.depth == "scan":
        sample = replace(sample, depth=StreetScan(shot, beams, index))
    if driven.masks == "motion":
        sample = replace(sample, labels=None)
    elif driven.masks == "disturbed":
        sample = replace(sample, labels=DisturbedLabels(shot, index))
    return sample


def _options(text: str, options: str) -> Driven:
    given: dict[str, str | float] = {}
    for option in options.split(","):
        name, _, value = option.partition("=")
        if name in given:
            raise ValueError(f"{text}: has {name} twice")
        if name == "fps":
            given[name] = rate(value, f"{text}: fps")
        elif name not in _CHOICES:
            raise ValueError(f"{text}: must have options of drive, fps, depth and masks, as drive=road, got {option!r}")
        elif value not in _CHOICES[name]:
            raise ValueError(f"{text}: {name} must be {', '.join(_CHOICES[name])}, got {value!r}")
        else:
            given[name] = value
    return Driven(**given)  # type: ignore[arg-type]


def rate(value: str, name: str) -> float | str:
    """Frames a second from text.

    Raises:
        ValueError: neither "random" nor a number in `ALL_RATES`; the message calls it ``name``.
    """
    if value == RANDOM:
        return value
    try:
        number = float(value)
    except ValueError:
        number = np.nan
    if not ALL_RATES[0] <= number <= ALL_RATES[1]:
        wanted = f"{ALL_RATES[0]:g} ... {ALL_RATES[1]:g} frames per second or {RANDOM}"
        raise ValueError(f"{name} must be {wanted}, got {value!r}")
    return number


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
