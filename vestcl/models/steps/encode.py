"""Frames through the encoder: each once, and backgrounds where they differ from their frame."""

import torch
from torch.nn import functional

from vestcl.models.config import EncoderConfig
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.skipping import Box, Tally, boxes
from vestcl.models.networks.encoder import COARSEST, STRIDE, Encoder, reach, upsample_features
from vestcl.models.networks.group_norm import NotedStatistics
from vestcl.models.steps.frames import FOREGROUND_BELOW, EncodedFrame
from vestcl.scene.layers import LayerBatch


def encode(
    encoder: Encoder, config: EncoderConfig, layers: LayerBatch, options: InferenceOptions, tally: Tally
) -> EncodedFrame:
    """Features of frames and of their backgrounds.

    Args:
        encoder: the network.
        config: its configuration, with the background's normalisation.
        layers: of B frames.
        options: with ``background`` the background is encoded where it has to be.
        tally: is passed how much that left out.
    """
    if config.background == "own":
        own, background = _apart(encoder, layers, tally)
    else:
        own, background = _borrowing(encoder, config, layers, options, tally)
    own, background = own.to(layers.image.dtype), background.to(layers.image.dtype)
    return EncodedFrame(layers, upsample_features(own, *layers.image.shape[2:]), background, own is background)


def _apart(encoder: Encoder, layers: LayerBatch, tally: Tally) -> tuple[torch.Tensor, torch.Tensor]:
    """Frames and backgrounds in one pass; backgrounds without foreground in front are the frame itself."""
    batch = len(layers.image)
    has_foreground = (layers.mask < FOREGROUND_BELOW).flatten(1).any(dim=1)
    grid = encoder(torch.cat([layers.image, layers.background_image[has_foreground]]))
    tally.add("background", _pixels(layers, batch - int(has_foreground.sum())), _pixels(layers, batch), "px")
    own = grid[:batch]
    if not has_foreground.any():
        return own, own
    rows = torch.arange(batch)
    rows[has_foreground] = torch.arange(batch, len(grid))
    return own, grid.index_select(0, rows)


def _borrowing(
    encoder: Encoder, config: EncoderConfig, layers: LayerBatch, options: InferenceOptions, tally: Tally
) -> tuple[torch.Tensor, torch.Tensor]:
    """Backgrounds by their frames' statistics, and their frames' features in cells where they are the frame."""
    statistics = NotedStatistics()
    own = encoder(layers.image, statistics.note)
    differs = (layers.background_image != layers.image).any(dim=1, keepdim=True)
    rows, total = differs.flatten(1).any(dim=1).nonzero()[:, 0], _pixels(layers, len(own))
    if options.background and not len(rows):
        tally.add("background", total, total, "px")
        return own, own
    height, width = differs.shape[2:]
    parts = [Box(0, height, 0, width)]
    if options.background:
        parts = boxes(differs.any(dim=0)[0], options.around(reach(config)), COARSEST)
    else:
        rows = torch.arange(len(own))
    cells = functional.max_pool2d(differs[rows].to(own.dtype), STRIDE, ceil_mode=True) > 0
    background, some = own.clone(), own[rows]
    for box in parts:
        grid = encoder(box.cut(layers.background_image[rows]), statistics.borrowed(rows))
        box.cut(some, STRIDE).copy_(torch.where(box.cut(cells, STRIDE), grid, box.cut(some, STRIDE)))
    background[rows] = some
    tally.add("background", total - len(rows) * sum(box.pixels for box in parts), total, "px")
    return own, background


def _pixels(layers: LayerBatch, frames: int) -> int:
    return frames * layers.image.shape[2] * layers.image.shape[3]
