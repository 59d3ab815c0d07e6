"""The published train and test drives of KITTI raw, and the windows that a clip is cut into."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final


def _drives(day: str, *numbers: str) -> tuple[str, ...]:
    return tuple(f"2011_{day}_drive_{number}_sync" for number in numbers)


#: Video prediction (SPEC section 10): 4 drives, 1,337 windows of 9 in image_02.
KITTI_PREDICTION_TEST: Final = _drives("09_26", "0060", "0084", "0093", "0096")

#: Video prediction: 24 drives.
KITTI_PREDICTION_TRAIN: Final = (
    *_drives("09_26", "0001", "0002", "0005", "0009", "0011", "0013", "0014", "0017", "0018", "0048"),
    *_drives("09_26", "0051", "0056", "0057", "0059", "0091", "0095", "0104", "0106", "0113", "0117"),
    *_drives("09_28", "0001", "0002"),
    *_drives("09_29", "0026", "0071"),
)

#: Novel views, the split of layered depth images (Tulsiani et al., 2018): NumPy's shuffle of the 28 drives with seed 0,
#: of which 20 train, 4 validate and 4 test. VEST-MPI has the same (vest/datasets/kitti_ldi.py of
#: github.com/zzyunzhi/vest).
KITTI_VIEWS_TEST: Final = _drives("09_26", "0001", "0057", "0084", "0106")
KITTI_VIEWS_VAL: Final = _drives("09_26", "0009", "0017", "0048", "0117")

#: Novel views: the other 20 of the same 28 city drives.
KITTI_VIEWS_TRAIN: Final = tuple(
    drive
    for drive in sorted(KITTI_PREDICTION_TRAIN + KITTI_PREDICTION_TEST)
    if drive not in KITTI_VIEWS_TEST + KITTI_VIEWS_VAL
)

#: The drives that a training configuration may be held to, by the name of the split.
KITTI_TRAINING: Final = {"kitti-prediction": KITTI_PREDICTION_TRAIN, "kitti-views": KITTI_VIEWS_TRAIN}

#: Cityscapes' training snippets of 30 frames. The paper says that it trains on 2,945 videos. Which 30 it would leave
#: out is in no published list, and no code of the paper is published. The data preparation of DMVFN, whose sizes and
#: KITTI drives the paper shares, makes 2,975 folders (github.com/hzwer/CVPR2023-DMVFN, README: train/000000 to 002974).
#: So it is an unknown choice or a slip of one digit; all 2,975 are taken here.
CITYSCAPES_TRAIN_SNIPPETS: Final = 2_975

#: Frames of a window before the forecast begins. Methods that look at two frames take the last two.
CONTEXT: Final = 4

#: Frames of a window that are forecast.
FUTURE: Final = 5


@dataclass(frozen=True)
class SplitWindow:
    """Indices of consecutive frames in a clip."""

    context: range
    """What a forecast may look at; the last two are frames t-1 and t."""
    future: range
    """Frames t+1, t+2, ..."""


def windows(frames: int, context: int = CONTEXT, future: int = FUTURE, stride: int = 1) -> Iterator[SplitWindow]:
    """All windows of ``context`` + ``future`` frames that fit, in order.

    Args:
        frames: of the clip.
        context: at least 1.
        future: at least 1.
        stride: from the start of one window to the next.

    Raises:
        ValueError: an argument that is too small.
    """
    for name, value, least in (("frames", frames, 0), ("context", context, 1), ("future", future, 1)):
        if value < least:
            raise ValueError(f"`{name}` must be at least {least}, got {value}")
    if stride < 1:
        raise ValueError(f"`stride` must be at least 1, got {stride}")
    starts = range(0, frames - context - future + 1, stride)
    return (SplitWindow(range(at, at + context), range(at + context, at + context + future)) for at in starts)
