"""Trained networks, faster on a CPU, for inference: the same forecasts for less time and memory traffic.

oneDNN's convolutions do most of what the cores can, so compiling the networks or reordering their weights gains little
(docs/performance.md). What gains: the blocks of object motion share one convolution over the
frames, which all of them look at; what only losses need is dropped; encoder and refinement may compute in bfloat16;
and a process that keeps the memory that it frees is spared its page faults.
"""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from torch.nn import functional

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.processor import computes_bfloat16, keep_freed_memory
from vestcl.models.networks.layers import tensors_in
from vestcl.models.networks.object_motion import (
    MOTION_CHANNELS,
    MotionBlock,
    MotionConv,
    ObjectMotion,
)
from vestcl.models.weights_file import unwrapped

__all__ = ["FastForecaster", "Precision", "accelerate", "computes_bfloat16", "keep_freed_memory", "share_frames"]

Precision = Literal["float32", "bfloat16"]


def accelerate(model: Forecaster, precision: Precision = "float32") -> "FastForecaster":
    """A copy of ``model`` that forecasts the same, faster, and records no gradients; ``model`` stays as it is.

    Args:
        model: a trained one; its configuration, weights and options are copied.
        precision: "float32" gives the same images up to rounding: within 1e-4 of values from 0 to 1, but for pixels
            where that decides which of two points is the nearer one. "bfloat16" lets encoder and refinement compute in
            it: PSNR against the others is 40 dB and more. It pays on processors that have it, see `computes_bfloat16`.

    Returns:
        The copy. Its forecasts have no `ObjectMotionForecast.candidates`.

    Raises:
        ValueError: another precision, or a model that is accelerated already.
    """
    if precision not in get_args(Precision):
        raise ValueError(f"`precision` must be one of {', '.join(get_args(Precision))}, got {precision!r}")
    if isinstance(model, FastForecaster):
        raise ValueError(f"`model` must be a plain Forecaster, got {model.config.name} accelerated already")
    return FastForecaster(model, precision)


class FastForecaster(Forecaster):
    """A `Forecaster` for inference; `accelerate` makes it.

    Args:
        model: whose configuration, weights and options it copies.
        precision: that encoder and refinement compute in.
    """

    def __init__(self, model: Forecaster, precision: Precision) -> None:
        super().__init__(model.config)
        self.load_state_dict(unwrapped(model.state_dict(), model.config.name))
        self.options = replace(model.options, autocast=None if precision == "float32" else precision)
        if self.object_motion is not None:
            share_frames(self.object_motion, self.options.blocks)
        self.eval()
        for parameter in self.parameters():
            parameter.requires_grad_(False)

    def train(self, mode: bool = True) -> "FastForecaster":
        """Stay in evaluation mode.

        Raises:
            ValueError: training mode is asked for.
        """
        if mode:
            raise ValueError("`mode` must be False: an accelerated forecaster can't be trained, got True")
        super().train(False)
        return self

    def requires_grad_(self, requires_grad: bool = True) -> "FastForecaster":
        """Stay without gradients.

        Raises:
            ValueError: they are asked for.
        """
        if requires_grad:
            raise ValueError("`requires_grad` must be False: an accelerated forecaster has no gradients, got True")
        return self

    def forecast(self, *arguments: Any, **named: Any) -> Any:
        """As `Forecaster.forecast`, without gradients.

        Raises:
            ValueError: as there; a tensor that gradients are recorded for.
        """
        return _without_gradient(super().forecast, *arguments, **named)

    def present(self, *arguments: Any, **named: Any) -> Any:
        """As `Forecaster.present`, without gradients.

        Raises:
            ValueError: as there; a tensor that gradients are recorded for.
        """
        return _without_gradient(super().present, *arguments, **named)


def _without_gradient(task: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    if torch.is_grad_enabled():
        for name, value in inspect.signature(task).bind(*arguments, **named).arguments.items():
            if any(tensor.requires_grad for tensor in tensors_in(value)):
                wanted = f"`{name}` must not require a gradient, which an accelerated forecaster does not record"
                raise ValueError(f"{wanted}; got one that does: use the plain model, or torch.no_grad()")
    with torch.no_grad():
        return task(*arguments, **named)


# ---------------------------------------------------------------- object motion


def share_frames(network: ObjectMotion, blocks: int | None = None) -> bool:
    """Let the blocks of ``network`` share one convolution over the frames, for inference; its outputs stay the same.

    A block begins with conv(frames) + conv(U), at full size and at its own scale, and the frames are the same for all
    blocks. Few channels out of many are what convolutions are worst at, and each reads all of the frames.

    Args:
        network: object motion of shape "dmvfn" without routing. Its weights may change at any time.
        blocks: the first this many share, as more are not going to run (see `InferenceOptions.blocks`); None is all.

    Returns:
        Whether they do. Others stay as they are: blocks that routing leaves out would be computed after all, and at the
        paper's strides the joint channels would not fit into caches.
    """
    if network.config.shape != "dmvfn" or network.routing is not None:
        return False
    entering: dict[int, list[tuple[MotionBlock, str]]] = {}
    for block in network.blocks[:blocks]:
        assert isinstance(block, MotionBlock)
        entering.setdefault(1, []).append((block, "full_in"))
        entering.setdefault(block.scale, []).append((block, "shrunk_in"))
    for places in entering.values():
        joint = JointConv([getattr(block, name) for block, name in places])
        start = 0
        for block, name in places:
            setattr(block, name, SharedMotionConv(getattr(block, name), joint, start))
            start += getattr(block, name).out_channels
    network.shared, network.sharing = SharedFrames, len(network.blocks[:blocks])
    return True


class SharedFrames:
    """Both frames' channels at one scale, in one forecast: a `JointConv` over them runs once.

    Args:
        frames: [B, frames, H, W]; they stay as they are while this object is used.
    """

    def __init__(self, frames: torch.Tensor) -> None:
        self._frames = frames
        self._results: dict[JointConv, torch.Tensor] = {}

    def through(self, joint: "JointConv") -> torch.Tensor:
        """``joint`` of the frames."""
        if joint not in self._results:
            self._results[joint] = joint(self._frames)
        return self._results[joint]


class JointConv:
    """The part over the frames of several `MotionConv`, as one convolution.

    Args:
        convs: of one stride. A `SharedMotionConv` of each takes its place.
    """

    def __init__(self, convs: Sequence[MotionConv]) -> None:
        self.convs = list(convs)

    def __call__(self, frames: torch.Tensor) -> torch.Tensor:
        """[B, frames, H, W] -> [B, channels of all, ceil(H / stride), ceil(W / stride)]."""
        conv = self.convs[0]
        weight = torch.cat([one.weight.detach()[:, :-MOTION_CHANNELS] for one in self.convs])
        bias = torch.cat([one.bias.detach() for one in self.convs if one.bias is not None])
        return functional.conv2d(frames, weight, bias, conv.stride, conv.padding)


class SharedMotionConv(MotionConv):
    """`MotionConv` whose part over `SharedFrames` is ``joint``'s; over a tensor it is a plain `MotionConv`.

    Args:
        conv: whose weights it has, and whose place in ``joint`` it takes.
        joint: that ``conv`` is a part of.
        start: its first channel there.
    """

    def __init__(self, conv: MotionConv, joint: JointConv, start: int) -> None:
        super().__init__(conv.in_channels - MOTION_CHANNELS, conv.out_channels, conv.stride[0])
        self.weight, self.bias = conv.weight, conv.bias
        self._joint, self._channels = joint, slice(start, start + conv.out_channels)
        joint.convs = [self if one is conv else one for one in joint.convs]

    def forward(self, frames: torch.Tensor | SharedFrames, flow: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """As `MotionConv.forward`."""
        if isinstance(frames, torch.Tensor):
            return super().forward(frames, flow)
        of_flow = functional.conv2d(flow, self.weight[:, -MOTION_CHANNELS:], None, self.stride, self.padding)
        return of_flow + frames.through(self._joint)[:, self._channels]
