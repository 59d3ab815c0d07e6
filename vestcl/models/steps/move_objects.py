"""Object motion where there are objects."""

import functools
from collections.abc import Iterable
from typing import Final, NamedTuple

import torch
from torch.nn import functional

from vestcl.models.config import LOG_DEPTH_FAR
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.skipping import Box, Tally, boxes
from vestcl.models.networks.ego_motion import CameraMotion
from vestcl.models.networks.object_motion import ObjectMotion, ObjectMotionForecast
from vestcl.models.steps.frames import FOREGROUND_BELOW, EncodedFrame

#: From t - 1 and from t to t + 1; OMF runs at the interval that it learned at, of evenly spaced frames.
_INTERVALS: Final = (2, 1)

#: What is slower, metres per interval, is static: at 10 Hz half of a brisk walk ...
SLOWEST: Final = 0.08

#: ... in the mean over cells of this many pixels per side.
_CELL: Final = 32


def unmoved(start: torch.Tensor) -> ObjectMotionForecast:
    """``start`` [B, 6, H, W] m and no block that ran."""
    return ObjectMotionForecast(start, [], torch.zeros(len(start), 0, dtype=torch.bool), None)


def move_objects(
    network: ObjectMotion,
    prev: EncodedFrame,
    cur: EncodedFrame,
    to_next: CameraMotion,
    flow0: torch.Tensor,
    start: torch.Tensor,
    options: InferenceOptions,
    tally: Tally,
) -> ObjectMotionForecast:
    """OMF at full size, [B, 6, H, W] m in and out.

    The sky's rigid flow is hundreds of metres in any bend, which no convolution should see: with (R - I) x scaled
    to a depth of LOG_DEPTH_FAR it is as far as the networks' depth goes. What was taken off is added again.

    Args:
        network: OMF.
        prev: frame at t - 1.
        cur: frame at t.
        to_next: the camera's motion from both.
        flow0: the rigid flow.
        start: what OMF corrects.
        options: with ``objects``, OMF runs around the foreground, if it is to move nothing else; with ``still`` around
            dynamic objects only; ``blocks`` is how many blocks run, None is all.
        tally: is passed how much that left out.
    """
    if options.blocks == 0:
        return unmoved(start)
    moving = torch.cat([frame.layers.mask < FOREGROUND_BELOW for frame in (prev, cur)], dim=1)
    if options.objects and options.still and start is not flow0 and moving.any():
        moving &= _rolling(moving, start - flow0)
    found = _where(network, moving, options, tally)
    if not found:
        return unmoved(start)
    seen, backgrounds = _planes(prev, cur, network.config.inpainted)
    flows = list(zip((prev, cur), to_next[:2], flow0.split(3, dim=1), strict=True))
    pieces, forecasts = list[_Piece](), list[ObjectMotionForecast]()
    for box in found:
        beyond = torch.cat([
            (1 - LOG_DEPTH_FAR / box.cut(frame.layers.depth)).clamp(min=0)
            * (box.cut(flow) - rigid.translation[:, :, None, None])
            for frame, rigid, flow in flows
        ], dim=1)  # fmt: skip
        moves = box.cut(moving) if network.config.where == "foreground" else None
        pieces.append(_Piece(box, beyond, box.cut(start), moves))
        behind = list(map(box.cut, backgrounds))
        forecasts.append(
            network(*map(box.cut, seen), box.cut(start) - beyond, blocks=options.blocks, backgrounds=behind)
        )

    learning = torch.is_grad_enabled()  # only losses look at candidates
    each = zip(*(one.candidates for one in forecasts), strict=True) if learning else ()
    candidates = [_whole(start, pieces, parts) for parts in each]
    return forecasts[0]._replace(flow=_whole(start, pieces, [one.flow for one in forecasts]), candidates=candidates)


def _planes(prev: EncodedFrame, cur: EncodedFrame, inpainted: bool) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """What OMF sees of both frames, and of their backgrounds if it sees them."""
    seen = [prev.features, cur.features]
    seen += [prev.layers.depth, cur.layers.depth, prev.layers.mask, cur.layers.mask]
    if not inpainted:
        return seen, []
    features = [prev.background_features, cur.background_features]
    return seen, [*features, prev.layers.background_depth, cur.layers.background_depth]


class _Piece(NamedTuple):
    """A piece of the image: what OMF does not see of it, and what it may change."""

    box: Box
    beyond: torch.Tensor
    """[B, 6, h, w] m, taken off what OMF sees."""
    start: torch.Tensor
    """[B, 6, h, w] m."""
    moves: torch.Tensor | None
    """bool [B, 2, h, w]; None is all."""

    def finished(self, flow: torch.Tensor) -> torch.Tensor:
        """OMF's answer with what was taken off; ``start`` where nothing may move."""
        flow = flow + self.beyond
        if self.moves is None:
            return flow
        flow, start = (motion.unflatten(1, (2, 3)) for motion in (flow, self.start))
        return torch.where(self.moves[:, :, None], flow, start).flatten(1, 2)


def _whole(start: torch.Tensor, pieces: Iterable[_Piece], parts: Iterable[torch.Tensor]) -> torch.Tensor:
    """``start`` with OMF's answer in each piece."""
    flow = start.clone()
    for piece, part in zip(pieces, parts, strict=True):
        piece.box.cut(flow).copy_(piece.finished(part))
    return flow


def _rolling(foreground: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """bool [B, 2, H, W]: where what is ``foreground`` [B, 2, H, W] moves by SLOWEST per interval or more in addition to
    the rigid flow, ``residual`` [B, 6, H, W] m, in the mean over cells: some pixels of a parked car always seem to."""
    height, width = foreground.shape[2:]
    metres = residual.unflatten(1, (2, 3)).square().sum(dim=2).sqrt() / residual.new_tensor(_INTERVALS)[:, None, None]
    share, moved = (
        functional.avg_pool2d(plane, _CELL, ceil_mode=True)
        for plane in (foreground.to(metres), torch.where(foreground, metres, 0))
    )
    rolling = moved >= SLOWEST * share
    return functional.interpolate(rolling.to(metres), scale_factor=_CELL)[..., :height, :width] > 0


def _where(network: ObjectMotion, moving: torch.Tensor, options: InferenceOptions, tally: Tally) -> list[Box]:
    """The parts of the image that OMF is to see; a single one where it chooses its blocks by the whole scene."""
    batch, _, height, width = moving.shape
    whole = Box(0, height, 0, width)
    if network.config.where == "everywhere" or not options.objects:
        return [whole]
    found = boxes(moving.flatten(0, 1).any(dim=0), options.around(network.reach_of(options.blocks)), network.multiple)
    if network.routing is not None and found:
        found = [functools.reduce(Box.around, found)]
    if not found and network.learns:
        found = [Box(0, min(height, network.multiple), 0, min(width, network.multiple))]  # for a gradient of 0
    tally.add("objects", batch * (whole.pixels - sum(box.pixels for box in found)), batch * whole.pixels, "px")
    return found
