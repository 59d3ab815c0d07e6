"""A clip as the commands open it: any data set, a video or a street, at a size, with estimators."""

from typing import Final, NamedTuple

from vestcl.cli import checks
from vestcl.cli.commands import ClipOptions
from vestcl.cli.options import check_pixels
from vestcl.data.open import open_sequence
from vestcl.data.sample import Clip
from vestcl.data.street import input as street_input
from vestcl.forecasting.network.later_frames import ClassesOf, DepthOf

#: Options that are passed on to the clip's reader, which knows whether it has them.
_LAYOUT: Final = ("fov", "fps", "scale", "rig", "sequence", "snippet", "variant", "accumulated_depth")

#: Options of a clip's further files, with what they are if not given.
_FILES: Final = {"depth": None, "depth_scale": None, "labels": None, "label_ids": "trainIds"}


class Estimators(NamedTuple):
    """What estimates depth and classes of a frame; None where nothing is to."""

    depth: DepthOf | None
    segmentation: ClassesOf | None


def open_clip(
    text: str,
    options: ClipOptions,
    size: tuple[int | None, int | None],
    street_frames: int,
    estimators: Estimators | None = None,
) -> Clip:
    """The clip of an input, at a size, with estimators in place of what they replace.

    Args:
        text: a path, or one street.
        options: of its reader.
        size: (height, width) px; None is as it is, or in proportion to the other.
        street_frames: of the street, if it is one.
        estimators: of the same options; None loads them.

    Raises:
        ValueError: as `vestcl.data.open.open_sequence`; an option that a street does not have; an estimator whose
            package or checkpoint is not there.
    """
    checks.check_input(text)
    estimators = estimators or load_estimators(options.depth_model, options.mask_model)
    street = checks.one_street(text)
    files = {name: getattr(options, name) for name in _FILES}
    layout = {name: getattr(options, name) for name in _LAYOUT if getattr(options, name) not in (None, False)}
    if street is not None and street.seeds is not None:
        wrong = [*layout, *(name for name, unset in _FILES.items() if files[name] != unset)]
        if wrong:
            raise ValueError(f"{text}: is a street, which takes height, width, not {', '.join(wrong)}")
        if street.driven.depth or street.driven.masks:
            raise ValueError(f"{text}: must have no depth and masks here; `vestcl prepare` takes them")
        height, width = (given or default for given, default in zip(size, street_input.DEFAULT_SIZE, strict=True))
        clip = street_input.clip(street.seeds[0], street.driven, street_frames, (height, width))
        return with_estimates(clip, estimators)
    checks.check_folders(options)
    check_pixels(*size)
    return with_estimates(open_sequence(text, **files, **layout).fitted(*size), estimators)


def load_estimators(depth_model: str | None, mask_model: str | None) -> Estimators:
    """The estimators that options name: an existing file is an ONNX network, anything else a checkpoint.

    Raises:
        ValueError: an estimator whose package, file or checkpoint is missing, or a file that is not a network.
    """
    if depth_model is None and mask_model is None:
        return Estimators(None, None)
    from vestcl.scene import estimators

    depth: DepthOf | None = None
    classes: ClassesOf | None = None
    try:
        if depth_model is not None:
            is_file = checks.is_network_file("depth_model", depth_model)
            depth = (estimators.OnnxDepth if is_file else estimators.DepthEstimator).load(depth_model)
        if mask_model is not None:
            is_file = checks.is_network_file("mask_model", mask_model)
            classes = (estimators.OnnxSegmentation if is_file else estimators.SegmentationEstimator).load(mask_model)
    except ImportError as error:  # of the optional package; its message names the remedy
        raise ValueError(str(error)) from error
    return Estimators(depth, classes)


def with_estimates(clip: Clip, given: Estimators) -> Clip:
    """The clip with what the estimators give in place of its own depth, its own labels, or both."""
    if given == Estimators(None, None):
        return clip
    from vestcl.scene import estimators

    return estimators.with_estimates(clip, depth=given.depth, segmentation=given.segmentation)
