"""DMVFN's network: the best known forecast of video from two frames only, by 2D voxel flow.

Nine blocks from coarse to fine correct a flow [B, 4, H, W] px, which leads from the next frame back into frames 0 and
1, and a mask that weighs the two warped frames:
    (dV, dm) = block(I0, I1, warp(I0), warp(I1), m, V),   V += dV,   m += dm,
    next = sigmoid(m) warp(I0) + (1 - sigmoid(m)) warp(I1).
Rebuilt from the facts of the publication (widths, scales, strides, the routing network). No public weights of it are
available: timing needs none, and `python -m train.peer` trains some.

Source: Hu, Huang, Huang, Xu, Zhou, "A Dynamic Multi-Scale Voxel Flow Network for Video Prediction", CVPR 2023;
github.com/megvii-research/CVPR2023-DMVFN.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional

from vestcl.io import atomic
from vestcl.models.weights_file import check_finite, misfit, read_state_dict

#: Scales of the nine blocks: each sees the frames at 1 / S of their size next to a narrow branch at full size.
SCALES: Final = (4, 4, 4, 2, 2, 2, 1, 1, 1)

#: Channels of a block by its scale.
WIDTHS: Final = {4: 160, 2: 80, 1: 44}

#: The same as (scale, width), block by block.
BLOCKS: Final = tuple((scale, WIDTHS[scale]) for scale in SCALES)

#: The metadata's entry of a file that holds what `VoxelFlowNetwork` was built from.
KEY: Final = "vestcl.voxel_flow"

#: The coarsest blocks work at 1 / S / 4, and come back by doubling: other sizes would not fit together again.
MULTIPLE: Final = 16

#: Both frames, both warped frames, the mask; the flow comes on top of them.
_SEEN: Final = 4 * 3 + 1
_FLOW: Final = 2 * 2

#: Channels of the branch at full size, and of the routing network.
_DETAIL: Final = 8
_ROUTING: Final = 32

#: Blocks that a scene may take on average: probabilities are scaled to this sum.
_BUDGET: Final = 4.5

#: Keeps the scaling finite where every probability is 0.
_TINY: Final = 1e-6


class VoxelFlowBlock(nn.Module):
    """One correction (dV, dm): a wide branch at 1 / (4 S) of the size, a narrow one at 1 / 2, and one way up."""

    def __init__(self, width: int, scale: int) -> None:
        super().__init__()
        self.scale = scale
        self.down = nn.Sequential(_conv(_SEEN + _FLOW, width // 2, 2), _conv(width // 2, width, 2))
        self.body = nn.Sequential(*(_conv(width, width) for _ in range(3)))
        self.squeeze = _conv(width, width // 4)
        self.detail = nn.Sequential(_conv(_SEEN + _FLOW, _DETAIL, 2), _conv(_DETAIL, _DETAIL))
        self.out = nn.ConvTranspose2d(width // 4 + _DETAIL, _FLOW + 1, 4, stride=2, padding=1)

    def forward(self, seen: torch.Tensor, flow: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(frames, warped frames and mask [B, 13, H, W], V [B, 4, H, W] px) -> dV [B, 4, H, W] px, dm [B, 1, H, W]."""
        coarse = self.down(torch.cat([_resize(seen, 1 / self.scale), _resize(flow, 1 / self.scale) / self.scale], 1))
        wide = _resize(self.squeeze(self.body(coarse) + coarse), 2 * self.scale)
        change = self.out(torch.cat([wide, self.detail(torch.cat([seen, flow], 1))], 1))
        return change[:, :_FLOW], change[:, _FLOW:]


class VoxelFlowNetwork(nn.Module):
    """The next frame from two: 3,559,930 parameters, random ones; `load` reads trained ones.

    Args:
        routing: let the routing network draw, for each scene, which blocks run; without it all run, which is what the
            publication calls its network without routing.
        blocks: (scale, width) of each; as published.

    Raises:
        ValueError: no blocks, or a scale that is not 1, 2 or 4, or a width that is not a multiple of 4.
    """

    def __init__(self, routing: bool = False, blocks: Sequence[tuple[int, int]] = BLOCKS) -> None:
        super().__init__()
        if not blocks or not all(scale in WIDTHS and width > 0 and width % 4 == 0 for scale, width in blocks):
            raise ValueError(f"`blocks` must be pairs of a scale 1, 2 or 4 and a multiple of 4, got {blocks}")
        self.routes = routing
        self.sizes = tuple((int(scale), int(width)) for scale, width in blocks)
        self.blocks = nn.ModuleList(VoxelFlowBlock(width, scale) for scale, width in self.sizes)
        self.router = nn.Sequential(
            nn.Conv2d(6, _ROUTING, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(_ROUTING, _ROUTING, 3, padding=1),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
            nn.Linear(_ROUTING, len(self.sizes)),
        )

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """next = sigmoid(m) warp(first) + (1 - sigmoid(m)) warp(second).

        Args:
            first: [B, 3, H, W] in [0, 1], the frame at t - 1; H and W are multiples of 16 px.
            second: [B, 3, H, W] in [0, 1], the frame at t.

        Returns:
            The frame at t + 1, [B, 3, H, W] in [0, 1]; differentiable in both frames and the weights.

        Raises:
            ValueError: frames of another shape.
        """
        *_, last = self.corrected(first, second)
        return last

    def corrected(self, first: torch.Tensor, second: torch.Tensor) -> Iterator[torch.Tensor]:
        """The next frame as it is after each block that runs, the last one being the answer; as `forward`.

        The mean of both frames where routing lets none run.
        """
        _check(first, second)
        runs = self._draw(first, second)
        if not runs.any():
            yield (first + second) / 2
        flow = first.new_zeros(len(first), _FLOW, *first.shape[2:])
        mask, warped = flow[:, :1], (first, second)
        for block, gates in zip(self.blocks, runs.T, strict=True):
            if not gates.any():
                continue
            flow_change, mask_change = block(torch.cat([first, second, *warped, mask], 1), flow)
            gate = gates.to(flow.dtype)[:, None, None, None]
            flow, mask = flow + gate * flow_change, mask + gate * mask_change
            warped = warp(first, flow[:, :2]), warp(second, flow[:, 2:])
            weight = mask.sigmoid()
            yield (weight * warped[0] + (1 - weight) * warped[1]).clamp(0, 1)

    def save(self, path: Path | str) -> None:
        """Weights and what the network was built from, in one safetensors file, whole or not at all.

        Raises:
            ValueError: the folder can't be made.
        """
        tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in self.state_dict().items()}
        built = json.dumps({"routing": self.routes, "blocks": self.sizes})
        with atomic.replacing(path) as temporary:
            save_file(tensors, temporary, metadata={KEY: built})

    @classmethod
    def load(cls, path: Path | str) -> "VoxelFlowNetwork":
        """What `save` wrote, in evaluation mode.

        Raises:
            FileNotFoundError: no such file.
            ValueError: a damaged file, one of another network, or weights that are not finite.
        """
        path, remedy = Path(path), "`python -m train.peer` writes one"
        if not path.is_file():
            raise FileNotFoundError(f"no DMVFN-shaped network at {path}: {remedy}")
        try:
            with safe_open(path, framework="pt") as file:
                built: Any = json.loads((file.metadata() or {})[KEY])
            network = cls(bool(built["routing"]), [(int(scale), int(width)) for scale, width in built["blocks"]])
        except (SafetensorError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"`path` must hold a DMVFN-shaped network, got {path} ({error}): {remedy}") from error
        state = read_state_dict(path)
        if why := misfit(state, network.state_dict()):
            raise ValueError(f"`path` must hold the weights of its network; {path} {why}")
        check_finite(state, path)
        network.load_state_dict(state)
        return network.eval()

    def _draw(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """[B, 9] bool: which blocks run."""
        if not self.routes:
            return torch.ones(len(first), len(self.sizes), dtype=torch.bool, device=first.device)
        wishes = self.router(torch.cat([first, second], 1)).sigmoid()
        return torch.bernoulli((_BUDGET * wishes / (wishes.sum(1, keepdim=True) + _TINY)).clamp(0, 1)).bool()


def warp(image: torch.Tensor, flow: torch.Tensor) -> torch.Tensor:
    """out(p) = image(p + flow(p)), bilinear, with the border's colour beyond it.

    Args:
        image: [B, C, H, W]; H and W above 1.
        flow: [B, 2, H, W] px, x then y.

    Returns:
        [B, C, H, W]; differentiable in both.
    """
    height, width = image.shape[2:]
    across, down = (torch.linspace(-1, 1, size, dtype=image.dtype, device=image.device) for size in (width, height))
    x, y = across + flow[:, 0] * (2 / (width - 1)), down[:, None] + flow[:, 1] * (2 / (height - 1))
    return functional.grid_sample(image, torch.stack([x, y], -1), padding_mode="border", align_corners=True)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride, padding=1), nn.PReLU(outputs))


def _resize(image: torch.Tensor, scale: float) -> torch.Tensor:
    if scale == 1:
        return image
    return functional.interpolate(image, scale_factor=scale, mode="bilinear", align_corners=False)


def _check(first: torch.Tensor, second: torch.Tensor) -> None:
    for name, frame in (("first", first), ("second", second)):
        if frame.ndim != 4 or frame.shape[1] != 3 or frame.shape[2] % MULTIPLE or frame.shape[3] % MULTIPLE:
            wanted = f"[B, 3, H, W] with H and W multiples of {MULTIPLE}"
            raise ValueError(f"`{name}` must be {wanted}, got {list(frame.shape)}")
    if first.shape != second.shape:
        raise ValueError(f"`second` must be {list(first.shape)} as `first` is, got {list(second.shape)}")
