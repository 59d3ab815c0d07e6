"""What methods are given of a clip: where depth comes from, and how rows that have seen the right camera are labelled.

A stereo pair's depth at t is matched against the right camera's image at t. In a table of that camera's views it is an
input that the paper does not have, so it makes rows of their own, whose names end with PAIR, next to the monocular
ones. Where that very image is what is judged (`train.protocols.Protocol.now`) it is refused.
"""

import dataclasses
from typing import Final, Literal

from train.protocols import Protocol
from vestcl.data.sample import Clip
from vestcl.scoring import RIGHT

Depth = Literal["clip", "motion", "pair"]
"""The clip's own (files, scans, an estimator), that of its motion, or that of its stereo pairs."""

#: What ends the name of a row whose depth is from the stereo pair.
PAIR: Final = ", stereo pair"

#: Where a clip's own depth comes from, by its reader.
_OWN: Final = {
    "VelodyneScan": "laser scans, densified",
    "StreetDepth": "the street itself, true",
    "DisparityFile": "disparity files",
}


def depths(clip: Clip, protocol: Protocol, stereo: bool) -> tuple[Depth, ...]:
    """Where depth comes from, one forecast each; the first one's rows come first.

    Args:
        clip: any of the protocol's.
        protocol: `check_stereo` has passed it.
        stereo: whether stereo pairs are asked for although the clip has depth.
    """
    own: Depth = "motion" if clip[0].depth is None else "clip"
    if protocol.now or clip[0].right is None or not (stereo or own == "motion"):
        return (own,)
    return (own, "pair") if RIGHT in protocol.views else ("pair",)


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


def label(depth: Depth) -> str:
    """What ends the names of its rows."""
    return PAIR if depth == "pair" else ""


def plain(method: str) -> str:
    """A row's method without its label."""
    return method.removesuffix(PAIR)


def label_of(method: str) -> str:
    """The label of a row's method."""
    return method[len(plain(method)) :]


def known_of(clip: Clip, sources: tuple[Depth, ...] = ("clip",)) -> str:
    """A sentence on what all methods but the baselines are given besides frames t-1 and t.

    Args:
        clip: at the size that is evaluated.
        sources: of `depths`.
    """
    ending = f' (rows ending in "{PAIR.strip(", ")}")'
    words = [_words(clip, depth) + ending * (depth == "pair") for depth in sources]
    labelled = sum(sample.labels is not None for sample in clip)
    masks = (
        "motion" if not labelled else "labels" if labelled == len(clip) else "labels where there are any, else motion"
    )
    return f"Depth is from {' and from '.join(words)}, masks are from {masks}."


def _words(clip: Clip, depth: Depth) -> str:
    if depth == "clip":
        return _OWN.get(type(clip[0].depth).__name__, "files")
    return "motion" if depth == "motion" else "the stereo pair at t-1 and t"
