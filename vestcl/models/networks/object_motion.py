"""Object-motion forecasting (OMF): how every point moves to the next frame, as a correction of the rigid flow."""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.config import ObjectMotionConfig, RoutingConfig
from vestcl.models.networks.layers import channels_last, frame_pair, side_by_side, upsample
from vestcl.shapes import check

#: Motion of both frames to t + 1: xyz of the previous one, xyz of the current one.
MOTION_CHANNELS: Final = 6

#: A block of shape "dmvfn" works, within its scale, at this fraction of the size.
_DMVFN_STRIDE: Final = 4

#: Probability from which on a block runs outside training.
_THRESHOLD: Final = 0.5


class ObjectMotionForecast(NamedTuple):
    """What the cascade gives."""

    flow: torch.Tensor
    """U [B, 6, H, W] m: ``displacement_xyz`` to t + 1 of the previous frame's pixels, then of the current one's."""
    candidates: list[torch.Tensor]
    """U^(i-1) + dU^i [B, 6, H, W] m, for each block that was computed: for losses on every block."""
    ran: torch.Tensor
    """[B, L] bool: which blocks count in ``flow``, and outside training the only ones that were computed."""
    probabilities: torch.Tensor | None
    """[B, L] that a block runs, for `budget_loss`; None without routing."""


class ObjectMotion(nn.Module):
    """A cascade of L blocks from coarse to fine: U^i = U^(i-1) + g_i dU^i, from the rigid flow U^0.

    Each block sees [F, log D, M] of both frames, with ``inpainted`` [F_bg, log D_bg] of both as well, and U^(i-1), in
    metres at every scale. dU starts at exactly 0.
    g_i = 1, or with routing a Bernoulli variable of the probability that a small network gives, with the gradient
    passed straight through; outside training a rule decides, and blocks that it leaves out are not computed.
    Sizes that the scales don't divide are padded by their last rows and columns, and cut again.

    Source: SPEC section 5; the paper's section on object-motion forecasting; DMVFN (CVPR 2023).
    """

    def __init__(self, config: ObjectMotionConfig | None = None, features: int = 32) -> None:
        super().__init__()
        config = config or ObjectMotionConfig()
        self.config, self.scales, self.features = config, config.scales, features
        frames = 2 * (features + 2) + (2 * (features + 1) if config.inpainted else 0)
        self.blocks = nn.ModuleList(
            MotionBlock(frames, config.shape, scale, width, config.detail)
            for scale, width in zip(config.scales, config.widths, strict=True)
        )
        self.routing = None if config.routing is None else Routing(frames, len(config.scales), config.routing)
        self.multiple = math.lcm(*config.scales) * (_DMVFN_STRIDE if config.shape == "dmvfn" else 1)
        #: What blocks get in place of the frames, at each scale, and how many of them: `vestcl.models.inference.fast`
        #: sets both.
        self.shared: Callable[[torch.Tensor], Any] | None = None
        self.sharing = 0

    def forward(
        self,
        features_prev: torch.Tensor,
        features_cur: torch.Tensor,
        depth_prev: torch.Tensor,
        depth_cur: torch.Tensor,
        mask_prev: torch.Tensor,
        mask_cur: torch.Tensor,
        flow0: torch.Tensor,
        blocks: int | None = None,
        backgrounds: Sequence[torch.Tensor] = (),
    ) -> ObjectMotionForecast:
        """Forecast the motion of both frames' pixels. All arguments are at the image's size, whatever that is.

        Args:
            features_prev: [B, features, H, W] of the frame at t - 1.
            features_cur: the same at t.
            depth_prev: [B, 1, H, W] m.
            depth_cur: the same at t.
            mask_prev: [B, 1, H, W], 1 on the static background.
            mask_cur: the same at t.
            flow0: [B, 6, H, W] m, the rigid flow of both frames' pixels to t + 1.
            blocks: only the first this many run, of those that routing chooses; None is all.
            backgrounds: with ``inpainted`` features [B, features, H, W] of the background at t - 1 and at t, and its
                depth [B, 1, H, W] m at t - 1 and at t.

        Returns:
            The forecast; differentiable in all arguments.

        Raises:
            ValueError: an argument of another shape, or backgrounds that are missing or not expected.
        """
        prev, cur = frame_pair(features_prev, features_cur, depth_prev, depth_cur, mask_prev, mask_cur, self.features)
        if len(backgrounds) != (4 if self.config.inpainted else 0):
            wanted = "F_bg, F_bg, D_bg, D_bg" if self.config.inpainted else "empty"
            raise ValueError(f"`backgrounds` must be {wanted} for this configuration, got {len(backgrounds)} tensors")
        if self.config.inpainted:
            features, depths = backgrounds[:2], backgrounds[2:]
            behind = frame_pair(*features, *depths, mask_prev, mask_cur, self.features)  # type: ignore[arg-type, call-arg]
            prev, cur = prev + behind[0][:-1], cur + behind[1][:-1]
        batch, _, height, width = features_prev.shape
        check(flow0=(flow0, f"{batch} {MOTION_CHANNELS} {height} {width}"))
        frames, flow = self._pad(side_by_side([*prev, *cur])), self._pad(flow0)
        shrunk = {scale: shrink(frames, scale) for scale in {max(self.scales), *self.scales[:blocks]}}
        if self.routing is None:
            probabilities, gates = None, flow.new_ones(len(flow), len(self.blocks))
        else:
            probabilities, gates = self.routing(shrunk[max(self.scales)])
        if blocks is not None:
            gates = gates * (torch.arange(gates.shape[1]) < blocks)
        flow, candidates = self._cascade(frames, shrunk, flow, gates[:, :blocks])
        cut = [candidate[..., :height, :width] for candidate in candidates]
        return ObjectMotionForecast(flow[..., :height, :width], cut, gates.detach().bool(), probabilities)

    @property
    def reach(self) -> int:
        """`reach_of` all blocks."""
        return self.reach_of(None)

    def reach_of(self, blocks: int | None) -> int:
        """Pixels beyond a pixel that its motion may depend on: what the first ``blocks`` (None: all) reach, added up.

        A conv on cells of s pixels reaches s further, and so does bilinear resizing to or from them; and a cell of a
        stride begins up to a cell before the pixel.
        """
        of_block = (lambda s: 28 * s + 2) if self.config.shape == "dmvfn" else (lambda s: 8 * s + 1)
        return sum(map(of_block, self.scales[:blocks]))

    @property
    def learns(self) -> bool:
        """Whether gradients are recorded for any of its parameters."""
        return torch.is_grad_enabled() and any(parameter.requires_grad for parameter in self.parameters())

    @property
    def changes_nothing(self) -> bool:
        """Whether it is as it was made, dU = 0, and nothing is to learn: then U = U^0, and it need not run."""
        if self.learns:
            return False
        last = [block.get_submodule("out") for block in self.blocks]
        return not any(parameter.any() for layer in last for parameter in layer.parameters())

    def _cascade(
        self, frames: torch.Tensor, shrunk: dict[int, torch.Tensor], flow: torch.Tensor, gates: torch.Tensor
    ) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """All blocks in turn; outside training, each for the samples that chose it."""
        candidates = []
        plain = {1: frames} | shrunk
        shared = plain if self.shared is None else {scale: self.shared(tensor) for scale, tensor in plain.items()}
        for index, (block, scale, gate) in enumerate(zip(self.blocks, self.scales, gates.unbind(1), strict=False)):
            if self.training or self.routing is None:
                looked_at = shared if index < self.sharing else plain
                residual = block(looked_at[1], looked_at[scale], flow)
                candidates.append(flow + residual)
                flow = candidates[-1] if self.routing is None else flow + gate[:, None, None, None] * residual
                continue
            chosen = gate.nonzero()[:, 0]
            if len(chosen):
                some = slice(None) if len(chosen) == len(flow) else chosen
                residual = block(frames[some], shrunk[scale][some], flow[some])
                flow = flow.index_add(0, chosen, residual)
                candidates.append(flow)
        return flow, candidates

    def _pad(self, image: torch.Tensor) -> torch.Tensor:
        below, right = (-size % self.multiple for size in image.shape[-2:])
        padded = functional.pad(image, (0, right, 0, below), mode="replicate") if below or right else image
        return channels_last(padded)


class MotionBlock(nn.Module):
    """dU = conv(cat[A, B]): one multi-scale motion-flow block.

    Branch A shrinks its input by ``scale``, then c = conv(conv(input)), conv(c + conv(conv(conv(c)))), and back up.
    Branch B is two convs at full size. All 3x3, an activation after each but the last, which starts at 0.
    "paper": strides 1, ReLU. "dmvfn": the first two convs of A and the first of B have stride 2, and a transposed
    4x4 conv of stride 2 ends the block; PReLU per channel.
    """

    def __init__(self, frames: int, shape: str, scale: int, width: int, detail: int) -> None:
        super().__init__()
        fast = shape == "dmvfn"
        stride = 2 if fast else 1
        self.up = scale * 2 if fast else scale
        self.shrunk_in = MotionConv(frames, width // 2, stride)
        self.shrunk_act = _activation(width // 2, fast)
        self.down = _conv(width // 2, width, fast, stride)
        self.inner = nn.Sequential(*(_conv(width, width, fast) for _ in range(3)))
        self.squeeze = _conv(width, width // 4, fast)
        self.full_in = MotionConv(frames, detail, stride)
        self.full_act = _activation(detail, fast)
        self.full = _conv(detail, detail, fast)
        joined = width // 4 + detail
        self.out: nn.Conv2d | nn.ConvTranspose2d = (
            nn.ConvTranspose2d(joined, MOTION_CHANNELS, 4, stride=2, padding=1)
            if fast
            else nn.Conv2d(joined, MOTION_CHANNELS, 3, padding=1)
        )
        for parameter in self.out.parameters():
            nn.init.zeros_(parameter)
        self.scale = scale

    def forward(self, frames: torch.Tensor, shrunk: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
        """Correct the motion.

        Args:
            frames: [B, frames, H, W], both frames' channels; the block's strides divide H and W.
            shrunk: [B, frames, H / scale, W / scale], the same shrunk.
            flow: U [B, 6, H, W] m.

        Returns:
            dU [B, 6, H, W] m; differentiable.
        """
        coarse = self.down(self.shrunk_act(self.shrunk_in(shrunk, shrink(flow, self.scale))))
        coarse = self.squeeze(self.inner(coarse) + coarse)
        full = self.full(self.full_act(self.full_in(frames, flow)))
        return self.out(side_by_side([upsample(coarse, self.up, *full.shape[-2:]), full]))


class MotionConv(nn.Conv2d):
    """conv3x3(cat[frames, U]) as conv(frames) + conv(U): the wide input is neither copied nor kept for each block."""

    def __init__(self, frames: int, channels: int, stride: int) -> None:
        super().__init__(frames + MOTION_CHANNELS, channels, 3, stride=stride, padding=1)

    def forward(self, frames: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        """[B, frames, H, W] and [B, 6, H, W] -> [B, channels, ceil(H / stride), ceil(W / stride)]."""
        of_frames, of_flow = self.weight.split([frames.shape[1], MOTION_CHANNELS], dim=1)
        result = functional.conv2d(frames, of_frames, self.bias, self.stride, self.padding)
        return result + functional.conv2d(flow, of_flow, None, self.stride, self.padding)


class Routing(nn.Module):
    """Which blocks a scene needs: two 3x3 convs on the shrunk pair of frames, mean, linear, sigmoid.

    The bias starts where the expected number of blocks is the budget.

    Source: DMVFN (CVPR 2023), which instead scales each scene's probabilities to the budget; here easy scenes may
    take less than others, and `budget_loss` holds their mean.
    """

    def __init__(self, frames: int, blocks: int, config: RoutingConfig) -> None:
        super().__init__()
        self.look = nn.Sequential(
            nn.Conv2d(frames, config.width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.width, config.width, 3, padding=1),
        )
        self.choose = nn.Linear(config.width, blocks)
        self.rule, self.top = config.rule, max(1, math.floor(config.budget + 0.5))
        share = torch.tensor(config.budget / blocks)
        with torch.no_grad():
            self.choose.bias.fill_(share.logit())

    def forward(self, shrunk: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[B, frames, h, w] -> probabilities [B, L], and gates [B, L] of exactly 0 and 1; differentiable."""
        probabilities = self.choose(self.look(shrunk).mean(dim=(2, 3))).sigmoid()
        if self.training:
            return probabilities, StraightThroughBernoulli.apply(probabilities)
        if self.rule == "threshold":
            return probabilities, (probabilities >= _THRESHOLD).to(shrunk.dtype)
        best = probabilities.topk(self.top, dim=1).indices
        return probabilities, torch.zeros_like(probabilities).scatter(1, best, 1)


class StraightThroughBernoulli(torch.autograd.Function):
    """g ~ Bernoulli(p), with dg / dp = 1."""

    @staticmethod
    def forward(ctx: Any, probabilities: torch.Tensor) -> torch.Tensor:
        """Draw."""
        return torch.bernoulli(probabilities)

    @staticmethod
    def backward(ctx: Any, grad_gates: torch.Tensor) -> torch.Tensor:
        """Pass on."""
        return grad_gates


def budget_loss(probabilities: torch.Tensor, budget: float) -> torch.Tensor:
    """((mean over scenes of the expected number of blocks - budget) / L)^2.

    Args:
        probabilities: [B, L] that each block runs.
        budget: blocks that should run on average.

    Returns:
        A scalar in [0, 1]; differentiable.
    """
    return ((probabilities.sum(dim=1).mean() - budget) / probabilities.shape[1]).square()


def shrink(image: torch.Tensor, scale: int) -> torch.Tensor:
    """Bilinear by 1 / scale, which divides H and W: [B, C, H, W] -> [B, C, H / scale, W / scale]. Metres stay."""
    if scale == 1:
        return image
    size = [length // scale for length in image.shape[-2:]]
    return functional.interpolate(image, size, mode="bilinear", align_corners=False)


def _activation(channels: int, fast: bool) -> nn.Module:
    return nn.PReLU(channels) if fast else nn.ReLU()


def _conv(channels_in: int, channels: int, fast: bool, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, stride=stride, padding=1), _activation(channels, fast))
