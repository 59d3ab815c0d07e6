"""What is evaluated: which clips, which windows of them, seen from where, at what size, and what the paper reports.

| protocol | clips | windows | judged from |
|---|---|---|---|
| kitti-prediction | 4 test drives of video prediction | 4 + 5 frames, stride 1 | source, t+1 ... t+5 |
| kitti-space-time | the same | the same | right camera, t+1 ... t+5 |
| kitti-space | 4 test drives of novel views | the same | right camera at t; source, t+1 ... t+5 |
| kitti-space-val | 4 validation drives of novel views | the same | the same |
| cityscapes-prediction | all snippets of val | one a snippet, its last 10 frames the future | source, t+1 ... t+10 |
| street | held-out procedural streets | one a street, t = 2 | source and right, t+1 ... t+5 |
| clip | any sequence | every one | source and right, t+1 ... t+5 |

In kitti-space the right camera's image at t is the answer, so no depth may be matched against it
(`train.evaluation.inputs`). The paper's SSIM has several scales; for that one view it follows VEST-MPI (`NOW_NOTE`).

Source: SPEC section 10. Where a two-frame method is used in a window of 4 + 5 it takes frames 2 and 3, counted from 0.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from vestcl.data.open import open_sequence
from vestcl.data.readers.cityscapes import open_cityscapes, snippets
from vestcl.data.readers.kitti_raw import open_kitti_raw
from vestcl.data.readers.splits import CONTEXT, FUTURE, KITTI_PREDICTION_TEST, KITTI_VIEWS_TEST, KITTI_VIEWS_VAL
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.evaluation.scores import RIGHT, SOURCE
from vestcl.prepare.perception import as_clip
from vestcl.prepare.prepared import PreparedClip, find_prepared

Name = Literal[
    "kitti-prediction", "kitti-space-time", "kitti-space", "kitti-space-val", "cityscapes-prediction", "street", "clip"
]  # fmt: skip

#: Streets for evaluation only: no training, tuning or test may use these seeds.
HELD_OUT: Final = range(1100, 1140)

#: The current frame of a street: two frames before it, as `vestcl bench forecast street: --first 2 --last 2` has.
STREET_FRAME: Final = 2

#: The view of kitti-space that shows no future: the right camera at t itself.
NOW: Final = "right at t"

#: There the outer 5 % of each side count as black, see `NOW_NOTE`.
NOW_BORDER: Final = 0.05

#: How that view is scored: found in VEST-MPI's published code, whose convention the paper follows there. Its KITTI
#: split is KITTI_VIEWS_*, by the same shuffle. For t+1, t+3 and t+5 it scores whole images.
NOW_NOTE: Final = (
    f"View {NOW} is scored as VEST-MPI's code does (github.com/zzyunzhi/vest, compute_scores.py): the outer 5 % of "
    "each side are black in image and truth, SSIM has one scale and windows that reach beyond the image, LPIPS is "
    "AlexNet's. That code scores 256 x 768 px and both cameras, each from the other; here it is the right one."
)

#: What every table of the paper's figures says.
PAPER_NOTE: Final = (
    "The paper's figures are of its own depth, masks, inpainting and training; they show the state of the art."
)


@dataclass(frozen=True)
class Where:
    """Where clips come from."""

    data: Path | None
    """A data set's root, or a clip."""
    seeds: range
    """Seeds of streets."""
    size: tuple[int, int]
    """(height, width) of streets, px."""
    frames: int
    """Frames of a street."""
    samples: int
    """Rays per pixel and direction, of streets."""
    prepared: Path | None = None
    """Folder of prepared clips, in place of ``data``."""
    accumulated_depth: bool = False
    """KITTI raw: depth from `proj_depth/groundtruth`, which has the scans of later frames, too."""
    driven: street_input.Driven = street_input.DEFAULT
    """How streets are driven."""

    def root(self) -> Path:
        """``data``.

        Raises:
            ValueError: none is given.
        """
        if self.data is None:
            raise ValueError("`data` must be a folder: the data set's root or, for `clip`, the sequence; got none")
        return self.data


@dataclass(frozen=True)
class Source:
    """A clip that is opened when its turn comes."""

    name: str
    opens: Callable[[], Clip]


@dataclass(frozen=True)
class Published:
    """A row of the paper."""

    method: str
    view: str
    metric: str
    values: dict[int, float]
    """By horizon; 0 is t itself."""


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate."""

    title: str
    sources: Callable[[Where], list[Source]]
    views: tuple[str, ...]
    """Cameras of the future frames, as `vestcl.forecasting.views.parse_view` reads them."""
    size: tuple[int, int] = (256, 832)
    """(height, width) px: clips are resized to it, anisotropically, before anything looks at them."""
    steps: int = FUTURE
    shown: tuple[int, ...] = (1, 3, 5)
    """Horizons of tables."""
    first: int | None = CONTEXT - 1
    """The first current frame t; None: one window a clip, whose future is the clip's end."""
    last: int | None = None
    """The last one; None: as long as the future lasts."""
    now: bool = False
    """Whether the right camera's image at t is asked for, too."""
    paper: tuple[Published, ...] = ()


def currents(frames: int, steps: int, first: int | None, last: int | None = None) -> range:
    """The current frame t of every window, stride 1: a frame precedes it and ``steps`` follow.

    Args:
        frames: of the clip.
        steps: that are forecast.
        first: the first t; None: only the last one that has ``steps`` frames after it.
        last: the last t; None: as long as there are ``steps`` frames after it.

    Returns:
        Indices of frames; ``frames`` - 8 of them for 4 + 5 frames.

    Raises:
        ValueError: ``steps`` or ``first`` below 1.
    """
    if steps < 1 or (first is not None and first < 1):
        raise ValueError(f"`steps` and `first` must be 1 or more, got {steps} and {first}")
    end = frames - 1 - steps
    if first is None:
        first = max(end, 1)
    return range(first, (end if last is None else min(last, end)) + 1)


# ---------------------------------------------------------------- clips


def _kitti(drives: tuple[str, ...]) -> Callable[[Where], list[Source]]:
    def sources(where: Where) -> list[Source]:
        if where.prepared is not None:
            return _prepared(where, drives)
        paths = [where.root() / drive[: len("2011_09_26")] / drive for drive in drives]
        missing = [path.name for path in paths if not path.is_dir()]
        if missing:
            wanted = "DATE/DATE_drive_NNNN_sync of KITTI raw"
            raise ValueError(f"`data` must have {wanted}, got {where.root()} without {', '.join(missing)}")
        opens = functools.partial(open_kitti_raw, accumulated_depth=where.accumulated_depth)
        return [Source(path.name, functools.partial(opens, path)) for path in paths]

    return sources


def _cityscapes(where: Where) -> list[Source]:
    _check_unaccumulated(where)
    if where.prepared is not None:
        return _prepared(where)
    split = where.root() / "leftImg8bit_sequence" / "val"
    names = snippets(split)
    if not names:
        wanted = "leftImg8bit_sequence/val/CITY with the frames and camera/val/CITY with their cameras"
        raise ValueError(f"`data` must have {wanted}, got none in {where.root()}")
    return [Source(name, functools.partial(open_cityscapes, split / name.split("_")[0], name)) for name in names]


def _streets(where: Where) -> list[Source]:
    _check_unaccumulated(where)
    about = where.driven.named()
    names = {seed: f"street {seed} {about}".rstrip() for seed in where.seeds}
    if where.prepared is not None:
        return _prepared(where, list(names.values()))

    def street(seed: int) -> Clip:
        return street_input.clip(seed, where.driven, where.frames, where.size, where.samples, about)

    return [Source(name, functools.partial(street, seed)) for seed, name in names.items()]


def _sequence(where: Where) -> list[Source]:
    if where.prepared is not None:
        return _prepared(where)
    options: dict[str, Any] = {"accumulated_depth": True} if where.accumulated_depth else {}
    clip = open_sequence(where.root(), **options)
    return [Source(clip.name, lambda: clip)]


def _check_unaccumulated(where: Where) -> None:
    if where.accumulated_depth:
        raise ValueError("`accumulated_depth` is of KITTI raw, whose depth set has maps in proj_depth/groundtruth")


def _prepared(where: Where, names: Sequence[str] | None = None) -> list[Source]:
    """Clips that `vestcl prepare` wrote at the size that is evaluated; those of ``names``, or all."""
    assert where.prepared is not None
    found = dict[str, PreparedClip]()
    for clip in find_prepared(where.prepared):
        if clip.size == where.size and (names is None or clip.name in names):
            if other := found.get(clip.name):
                raise ValueError(f"`prepared` must have one clip of a name, got {other.folder} and {clip.folder}")
            found[clip.name] = clip
    missing = [name for name in names or () if name not in found]
    if missing or not found:
        wanted = ", ".join(missing) or "a clip"
        size = f"--height {where.size[0]} --width {where.size[1]}"
        raise ValueError(f"`prepared` must have {wanted} of `vestcl prepare {size}`, got {where.prepared} without")
    return [Source(name, functools.partial(as_clip, found[name])) for name in names or found]


# ---------------------------------------------------------------- the protocols


def _published(method: str, view: str, metric: str, percent: str, horizons: tuple[int, ...] = (1, 3, 5)) -> Published:
    values = (round(float(value) / 100, 4) for value in percent.split())
    return Published(method, view, metric, dict(zip(horizons, values, strict=True)))


def _rows(method: str, view: str, similarity: tuple[str, str], lpips: str, *horizons: int) -> tuple[Published, ...]:
    steps = horizons or (1, 3, 5)
    return (_published(method, view, *similarity, steps), _published(method, view, "lpips", lpips, steps))


#: The rows are those of SPEC section 10. The paper's SSIM is MS-SSIM, but for the view `NOW`.
PROTOCOLS: Final[dict[Name, Protocol]] = {
    "kitti-prediction": Protocol(
        "KITTI, video prediction",
        _kitti(KITTI_PREDICTION_TEST),
        (SOURCE,),
        paper=_rows("the paper", SOURCE, ("ms_ssim", "87.7 77.6 71.3"), "10.1 15.4 19.8"),
    ),
    "kitti-space-time": Protocol(
        "KITTI, VEST-[S+T]: the right camera's future",
        _kitti(KITTI_PREDICTION_TEST),
        (RIGHT,),
        paper=(
            *_rows("the paper", RIGHT, ("ms_ssim", "86.2 76.1 69.3"), "12.3 17.1 21.4"),
            *_rows("the paper, A: fixed depth", RIGHT, ("ms_ssim", "83.2 73.1 66.4"), "15.1 20.2 25.8"),
            *_rows("the paper, B: without EMF", RIGHT, ("ms_ssim", "85.6 75.5 68.4"), "12.9 18.1 22.4"),
            *_rows("the paper, C: without OMF", RIGHT, ("ms_ssim", "84.6 74.8 67.9"), "13.5 19.1 24.3"),
        ),
    ),
    "kitti-space": Protocol(
        "KITTI, VEST-[S,T]: the right camera's present, the source camera's future",
        _kitti(KITTI_VIEWS_TEST),
        (SOURCE,),
        now=True,
        paper=(
            *_rows("the paper, space", NOW, ("ssim", "94.6"), "5.2", 0),
            _published("the paper, time", SOURCE, "lpips", "8.1 18.6 20.4"),
        ),
    ),
    "kitti-space-val": Protocol(
        "KITTI, VEST-[S,T], validation drives: the right camera's present, the source camera's future",
        _kitti(KITTI_VIEWS_VAL),
        (SOURCE,),
        now=True,
    ),
    "cityscapes-prediction": Protocol(
        "Cityscapes, video prediction",
        _cityscapes,
        (SOURCE,),
        size=(512, 1024),
        steps=10,
        shown=(1, 5, 10),
        first=None,
        paper=_rows("the paper", SOURCE, ("ms_ssim", "96.4 86.2 78.0"), "4.6 9.8 14.9", 1, 5, 10),
    ),
    "street": Protocol("procedural streets", _streets, (SOURCE, RIGHT), first=STREET_FRAME, last=STREET_FRAME),
    "clip": Protocol("a sequence", _sequence, (SOURCE, RIGHT), first=1),
}
