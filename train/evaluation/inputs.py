"""What methods are given of a clip: where depth, masks, camera motion and inpainting come from, and how rows that have
seen the right camera are labelled.

A stereo pair's depth at t is matched against the right camera's image at t. In a table of that camera's views it is an
input that the paper does not have, so it makes rows of their own, whose names end with PAIR, next to the monocular
ones. Where that very image is what is judged (`train.evaluation.protocols.Protocol.now`) it is refused. Depth that was
matched
elsewhere is no other: that of Cityscapes' disparity files, and that of clips that `vestcl prepare` matched.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from train.evaluation.protocols import Protocol
from vestcl.cli.clip import Estimators, load_estimators, with_estimates
from vestcl.data.sample import Clip
from vestcl.evaluation.scores import RIGHT
from vestcl.forecasting.geometric import Perception
from vestcl.prepare.perception import PreparedPerception, PreparedSequence
from vestcl.scene.inpainting.inpainters import Inpainter, inpainter
from vestcl.scene.inputs import Inputs, inputs_of, is_matched

Depth = Literal["clip", "motion", "pair"]
"""The clip's own (files, scans, an estimator), that of its motion, or that of its stereo pairs."""

#: What ends the name of a row whose depth is from the stereo pair.
PAIR: Final = ", stereo pair"

#: Clips that a sentence lists.
_LISTED: Final = 8


@dataclass(frozen=True, eq=False)
class Preprocessing:
    """How recorded frames are preprocessed, and forecast ones with `perceive` "estimated"."""

    depth_model: str | None = None
    """The estimator of depth, as it was asked for; None keeps the clip's own depth."""
    mask_model: str | None = None
    """That of classes; None keeps the clip's own labels."""
    inpaint: str | None = None
    """The method of inpainting; None is the default."""
    estimators: Estimators = field(default_factory=lambda: Estimators(None, None))
    inpainter: Inpainter | None = None

    @classmethod
    def load(cls, depth_model: str | None, mask_model: str | None, inpaint: str | None) -> "Preprocessing":
        """What the options name.

        Raises:
            ValueError: an estimator whose package or checkpoint is not there, no such method of inpainting.
        """
        fill = None if inpaint is None else inpainter(inpaint, "inpaint")
        return cls(depth_model, mask_model, inpaint, load_estimators(depth_model, mask_model), fill)

    def estimated(self, clip: Clip) -> Clip:
        """The clip with the estimates in place of its own depth and labels; a prepared clip has all that it needs."""
        return clip if isinstance(clip, PreparedSequence) else with_estimates(clip, self.estimators)

    def inputs(self, clip: Clip) -> Inputs:
        """The sources of a clip that `estimated` gave, in words."""
        models = {"mask_model": self.mask_model, "inpaint": self.inpaint}
        has_depth = any(sample.depth is not None for sample in clip)
        return inputs_of(clip, depth_model=self.depth_model if has_depth else None, **models)


def depths(clip: Clip, protocol: Protocol, stereo: bool, estimated: bool = False) -> tuple[Depth, ...]:
    """Where depth comes from, one forecast each; the first one's rows come first.

    Args:
        clip: any of the protocol's.
        protocol: `check_stereo` has passed it.
        stereo: whether stereo pairs are asked for although the clip has depth.
        estimated: whether the clip's depth is from an estimator that was asked for, which has rows in any case.
    """
    own: Depth = "motion" if all(sample.depth is None for sample in clip) else "clip"
    pair: Depth = "pair"
    if any(map(is_matched, clip)):
        own, pair, stereo = "motion", "pair" if stereo and clip[0].right is not None else "clip", True
    elif clip[0].right is None:
        return (own,)
    if protocol.now or not (stereo or own == "motion"):
        return (own,)
    return (own, pair) if RIGHT in protocol.views or estimated else (pair,)


def check_stereo(protocol: Protocol, stereo: bool) -> None:
    """Refuse stereo pairs where the right camera's image at t is what is judged.

    Raises:
        ValueError: ``stereo`` with such a protocol.
    """
    if stereo and protocol.now:
        raise ValueError(
            "`--stereo` must not be used here: depth would be matched against the right camera's image at t, which is "
            "what is judged; without it depth comes from scans, files or motion"
        )


def check_prepared(clip: Clip, protocol: Protocol) -> None:
    """Refuse a prepared clip of unknown inputs, or of the stereo pair where the right camera's image at t is judged.

    Raises:
        ValueError: such a clip.
    """
    if not isinstance(clip, PreparedSequence) or clip.prepared is None:
        return
    inputs, folder = clip.prepared.inputs, clip.prepared.folder
    if inputs is None:
        raise ValueError(f"{folder}: must list where its depth comes from; run `vestcl prepare` again")
    if inputs.stereo and protocol.now:
        raise ValueError(
            f"{folder}: has depth that was matched against the right camera's image at t, which is what is judged; "
            "prepare the clip from scans, or with --depth-model"
        )


def given(clip: Clip, depth: Depth) -> Clip:
    """The clip with as much as forecasts get of it.

    Args:
        clip: at the size that is evaluated.
        depth: of `depths`.
    """
    if depth == "clip":
        return clip
    bare = (dataclasses.replace(s, depth=None, right=s.right if depth == "pair" else None) for s in clip)
    return dataclasses.replace(clip, samples=tuple(bare))


def perceptions(
    clip: Clip, protocol: Protocol, stereo: bool, how: Preprocessing
) -> dict[str, tuple[Perception, Inputs]]:
    """By the label of their rows, what forecasts see of the clip with each source of depth, and its sources in words.

    Args:
        clip: at the size that is evaluated, with estimates in place.
        protocol: which views are judged.
        stereo: whether stereo pairs are asked for although the clip has depth.
        how: preprocessing.
    """
    if isinstance(clip, PreparedSequence):
        check_prepared(clip, protocol)
        assert clip.prepared is not None and clip.prepared.inputs is not None
        inputs = clip.prepared.inputs
        return {PAIR * inputs.stereo: (PreparedPerception(clip, inpaint=how.inpainter), inputs)}
    found = {}
    for depth in depths(clip, protocol, stereo, how.depth_model is not None):
        seen = given(clip, depth)
        if depth == "clip":  # a frame without its own depth takes that of its motion, not that of its pair
            seen = _without_right(seen)
        inputs = how.inputs(seen)
        found[PAIR * inputs.stereo] = (Perception(seen, inpaint=how.inpainter), inputs)
    return found


def _without_right(clip: Clip) -> Clip:
    return dataclasses.replace(clip, samples=tuple(dataclasses.replace(sample, right=None) for sample in clip))


def label(depth: Depth) -> str:
    """What ends the names of its rows."""
    return PAIR if depth == "pair" else ""


def plain(method: str) -> str:
    """A row's method without its label."""
    return method.removesuffix(PAIR)


def label_of(method: str) -> str:
    """The label of a row's method."""
    return method[len(plain(method)) :]


# ---------------------------------------------------------------- sentences


def sentences(by_clip: Mapping[str, Mapping[str, Inputs]]) -> tuple[str, ...]:
    """On what all methods but the baselines are given besides frames t-1 and t: once, or once for all clips.

    Args:
        by_clip: the sources by clip and label of rows.
    """
    groups = dict[tuple[str, ...], list[str]]()
    for clip, by_label in by_clip.items():
        groups.setdefault(_sentences(by_label), []).append(clip)
    if len(groups) < 2:
        return next(iter(groups), ())
    return tuple(f"{_listed(clips)}: {' '.join(notes)}" for notes, clips in groups.items())


def _sentences(by_label: Mapping[str, Inputs]) -> tuple[str, ...]:
    depth = " and from ".join(inputs.depth + _ending(inputs.stereo) for inputs in by_label.values())
    motion = {inputs.motion: _ending(inputs.stereo) for inputs in by_label.values()}
    moved = " and from ".join(words + ending * (len(motion) > 1) for words, ending in motion.items())
    (first, *_) = by_label.values()
    return (
        f"Depth is from {depth}, masks are from {first.masks}.",
        f"Camera motion up to t is from {moved}, inpainting is by {first.inpainting}.",
    )


def _ending(stereo: bool) -> str:
    return f' (rows ending in "{PAIR.strip(", ")}")' * stereo


def _listed(clips: list[str]) -> str:
    return ", ".join(clips[:_LISTED]) + f" and {len(clips) - _LISTED} more" * (len(clips) > _LISTED)
