"""Ego-motion forecasting (EMF): how the camera will have moved by the next frame, from two backgrounds."""

from typing import Final, cast

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.config import EgoMotionConfig
from vestcl.models.networks.camera_correction import BoundedCorrection, CameraPrior, as_prior
from vestcl.models.networks.layers import frame_pair, frame_planes, side_by_side
from vestcl.models.networks.rigid_motion import CameraMotion, RigidMotion

__all__ = ["CameraMotion", "EgoMotion", "RigidMotion", "background_tokens", "sinusoidal_positions"]

#: (stride, dilation) of the four convolutions: the one reading of the paper's table that agrees with its sizes.
CONVOLUTIONS: Final = ((2, 1), (1, 2), (2, 1), (1, 1))

#: A token is background where at least this share of its area is, in either frame.
BACKGROUND_SHARE: Final = 0.5

#: Wavelengths of the positions go from 2 pi to this many tokens times 2 pi (Vaswani et al. 2017).
LONGEST_WAVE: Final = 10_000.0

#: A prior's rotations, radians, are shown to the network times that, and are then as large as its translations, metres.
_TURN_SHOWN: Final = 100.0

#: Factors of the network's correction, radians and metres: the largest that a car makes in an interval,
#: so that Adam's first steps, all of one size, are small ones of motion.
_TURN_SAID, _SHIFT_SAID = 0.03, 0.1

#: Metres an interval from which on a correction counts in full: a static car does not turn or sway, and half of
#: what little is measured of it is noise.
_ROLLING: Final = 0.5

#: No motion: the quaternion (1, 0, 0, 0) and the translation 0.
_REST: Final = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

#: Numbers of a small motion: rotation vector and translation.
_NUMBERS: Final = 6


class EgoMotion(nn.Module):
    """Two backgrounds -> the camera's motion from each of them to the next frame.

    Four 3x3 convs with ReLU, shared over the frames, on [F_bg, log D_bg, M]; both frames' channels side by side make
    the tokens. Sinusoidal positions are added, self-attention blocks follow, and the mean of the tokens, normalised,
    goes through a linear layer whose weight starts at 0 and whose bias is rest. Foreground is neither looked at by
    other tokens nor part of the mean, unless there is nothing else.

    With ``start`` "prior" it corrects a motion that was measured and extrapolated: G_k = D_k G with k = 1 ... path, for
    the intervals after t. D_k is the sum of a linear layer of the mean token, and one of the last two motions' numbers:
    how a car sways on is nearly linear in how it did. Both are 0 at the start, and count by min(|t| / _ROLLING, 1), t
    the translation that was measured from t - 1 to t. The motions' numbers are added to every token, too.
    next_from_prev is G_1 after the measured motion from t - 1 to t.

    With ``correction`` "bounded" D_k is a `BoundedCorrection` of a forecast motion G_k: the time between frames and
    all motions that were measured are inputs, and D_k is the identity until training opens a gate.

    Source: SPEC section 4; the paper's section on ego-motion forecasting.
    """

    def __init__(self, config: EgoMotionConfig | None = None, features: int = 32, start: str = "rest") -> None:
        super().__init__()
        config = config or EgoMotionConfig()
        self.features = features
        layers: list[nn.Module] = []
        channels = features + 2
        for width, (stride, dilation) in zip(config.widths, CONVOLUTIONS, strict=True):
            convolution = nn.Conv2d(channels, width, 3, stride=stride, padding=dilation, dilation=dilation)
            layers += [convolution, nn.ReLU()]
            channels = width
        self.frame = nn.Sequential(*layers)
        tokens = 2 * channels
        self.blocks = nn.ModuleList(
            AttentionBlock(tokens, config.heads, config.mlp_ratio) for _ in range(config.blocks)
        )
        self.norm = nn.LayerNorm(tokens)
        self.shown, self.swayed, self.bounded = None, None, None
        if start == "prior" and config.correction == "bounded":
            self.bounded = BoundedCorrection(config.path, tokens)
            return
        if start == "prior":
            self.shown = nn.Linear(2 * _NUMBERS, tokens)
            self.swayed = nn.Linear(2 * _NUMBERS, config.path * _NUMBERS, bias=False)
            self.motion = nn.Linear(tokens, config.path * _NUMBERS)
            nn.init.zeros_(self.swayed.weight)
            nn.init.zeros_(self.motion.bias)
        else:
            self.motion = nn.Linear(tokens, 2 * len(_REST))
            with torch.no_grad():
                self.motion.bias.copy_(torch.tensor(_REST).repeat(2))
        nn.init.zeros_(self.motion.weight)

    def forward(
        self,
        features_prev: torch.Tensor,
        features_cur: torch.Tensor,
        depth_prev: torch.Tensor,
        depth_cur: torch.Tensor,
        mask_prev: torch.Tensor,
        mask_cur: torch.Tensor,
        prior: CameraPrior | tuple[RigidMotion, RigidMotion, RigidMotion] | None = None,
    ) -> CameraMotion:
        """Forecast the camera's motion. All arguments are on the encoder's grid, h x w, of any size.

        Args:
            features_prev: [B, features, h, w] of the inpainted background at t - 1.
            features_cur: the same at t.
            depth_prev: [B, 1, h, w] m of that background.
            depth_cur: the same at t.
            mask_prev: [B, 1, h, w], 1 where the frame itself shows static background.
            mask_cur: the same at t.
            prior: with ``start`` "prior" ``next_from_cur`` to start from, ``cur_from_prev`` as it was measured, and the
                motion before that; a `CameraPrior` has more.

        Returns:
            The camera's motion; differentiable in all but the masks' choice of tokens.

        Raises:
            ValueError: an argument of another shape, or a prior missing or not asked for.
        """
        pair = frame_pair(features_prev, features_cur, depth_prev, depth_cur, mask_prev, mask_cur, self.features)
        prev, cur = (cast(torch.Tensor, self.frame(side_by_side(planes))) for planes in pair)
        return self.decide(prev, cur, mask_prev, mask_cur, prior)

    def look(self, features: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """The first half of `forward`, which each frame goes through separately, and so once: its channels of the
        tokens.

        Args:
            features: [B, features, h, w] of the inpainted background.
            depth: [B, 1, h, w] m of it.
            mask: [B, 1, h, w], 1 where the frame itself shows static background.

        Returns:
            [B, channels, ceil(h / 4), ceil(w / 4)]; differentiable.
        """
        return cast(torch.Tensor, self.frame(side_by_side(frame_planes(features, depth, mask))))

    def decide(
        self,
        grid_prev: torch.Tensor,
        grid_cur: torch.Tensor,
        mask_prev: torch.Tensor,
        mask_cur: torch.Tensor,
        prior: CameraPrior | tuple[RigidMotion, RigidMotion, RigidMotion] | None,
    ) -> CameraMotion:
        """The second half of `forward`: the camera's motion from what `look` gives for both frames.

        Raises:
            ValueError: a prior missing or not asked for.
        """
        starts_from_prior = self.shown is not None or self.bounded is not None
        if (prior is None) == starts_from_prior:
            raise ValueError(f"`prior` must be {'given' if starts_from_prior else 'none'} with this `start`")
        grid = torch.cat([grid_prev, grid_cur], dim=1)
        looked_at = background_tokens(mask_prev, mask_cur, *grid.shape[-2:])
        if prior is None:
            first, second = self.motion(self._mean(grid, looked_at)).chunk(2, dim=1)
            return CameraMotion(RigidMotion(first[:, :4], first[:, 4:]), RigidMotion(second[:, :4], second[:, 4:]))
        known = as_prior(prior)
        path = self._corrected(grid, looked_at, known)
        return CameraMotion(path[0].after(known.cur_from_prev), path[0], tuple(path[1:]))

    def _corrected(self, grid: torch.Tensor, looked_at: torch.Tensor, prior: CameraPrior) -> list[RigidMotion]:
        """The camera's motion of each interval after t."""
        if self.bounded is not None:
            if self.bounded.changes_nothing and not torch.is_grad_enabled():
                return [prior.interval(k) for k in range(max(self.bounded.path, prior.intervals))]
            numbers = self.bounded.numbers(prior)
            return self.bounded(self._mean(grid, looked_at, self.bounded.shown(numbers)), numbers, prior)
        assert self.shown is not None and self.swayed is not None
        measured = torch.cat([_numbers(motion) for motion in (prior.cur_from_prev, prior.prev_from_before)], dim=1)
        said = self.motion(self._mean(grid, looked_at, self.shown(measured)))
        rolling = torch.linalg.vector_norm(prior.cur_from_prev.translation, dim=1, keepdim=True) / _ROLLING
        corrections = ((said + self.swayed(measured)) * rolling.clamp(max=1)).split(_NUMBERS, dim=1)
        return [_correction(six).after(prior.interval(k)) for k, six in enumerate(corrections)]

    def _mean(self, grid: torch.Tensor, looked_at: torch.Tensor, added: torch.Tensor | None = None) -> torch.Tensor:
        """[B, tokens]: the mean token of what is ``looked_at``, with ``added`` [B, tokens] to each before attention."""
        tokens = (grid + sinusoidal_positions(grid)).flatten(2).mT
        if added is not None:
            tokens = tokens + added[:, None]
        for block in self.blocks:
            tokens = block(tokens, looked_at)
        weights = looked_at.to(tokens.dtype) / looked_at.sum(dim=1, keepdim=True)
        return cast(torch.Tensor, (weights[:, None] @ self.norm(tokens))[:, 0])


def _correction(said: torch.Tensor) -> RigidMotion:
    """[B, 6] -> the motion with the quaternion (1, r / 2) for a small turn r = _TURN_SAID said, and the shift."""
    turn, shift = _TURN_SAID * said[:, :3], _SHIFT_SAID * said[:, 3:]
    return RigidMotion(torch.cat([torch.ones_like(turn[:, :1]), turn / 2], dim=1), shift)


def _numbers(motion: RigidMotion) -> torch.Tensor:
    """[B, 6]: rotation vector of a small turn, 2 sign(w) v / |q|, times _TURN_SHOWN, and translation."""
    w, vector = motion.quaternion.split([1, 3], dim=1)
    length = torch.linalg.vector_norm(motion.quaternion, dim=1, keepdim=True).clamp(min=1e-8)
    turn = 2 * torch.where(w < 0, -vector, vector) / length
    return torch.cat([_TURN_SHOWN * turn, motion.translation], dim=1)


class AttentionBlock(nn.Module):
    """x + attention(norm(x)), then x + MLP(norm(x)) with GELU: the transformer's pre-LN block."""

    def __init__(self, channels: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(channels)
        self.query_key_value = nn.Linear(channels, 3 * channels)
        self.project = nn.Linear(channels, channels)
        self.norm2 = nn.LayerNorm(channels)
        self.mlp = nn.Sequential(
            nn.Linear(channels, mlp_ratio * channels), nn.GELU(), nn.Linear(mlp_ratio * channels, channels)
        )

    def forward(self, tokens: torch.Tensor, looked_at: torch.Tensor) -> torch.Tensor:
        """Mix the tokens.

        Args:
            tokens: [B, N, channels].
            looked_at: [B, N] bool; False hides a token from all others, one a sample at least must be True.

        Returns:
            [B, N, channels]; differentiable in ``tokens``.
        """
        split = self.query_key_value(self.norm1(tokens)).unflatten(-1, (3, self.heads, -1))
        query, key, value = split.permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(query, key, value, attn_mask=looked_at[:, None, None])
        tokens = tokens + self.project(mixed.transpose(1, 2).flatten(2))
        return tokens + self.mlp(self.norm2(tokens))


def background_tokens(mask_prev: torch.Tensor, mask_cur: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Which tokens are background in both frames; all of them where none is.

    Args:
        mask_prev: [B, 1, h, w], 1 on the background.
        mask_cur: [B, 1, h, w].
        height: rows of tokens.
        width: columns of tokens.

    Returns:
        [B, height width] bool.
    """
    shares = (functional.adaptive_avg_pool2d(mask, (height, width)) for mask in (mask_prev, mask_cur))
    background = torch.stack([share >= BACKGROUND_SHARE for share in shares]).all(dim=0).flatten(1)
    return background | ~background.any(dim=1, keepdim=True)


def sinusoidal_positions(grid: torch.Tensor) -> torch.Tensor:
    """Position p in channels 2k, 2k + 1 of n: sin and cos of p / LONGEST_WAVE^(2k / n); first rows, then columns.

    Args:
        grid: [B, C, h, w], C a multiple of 4; only size, dtype and device count.

    Returns:
        [C, h, w].
    """
    channels, height, width = grid.shape[1:]
    half = channels // 2
    exponents = torch.arange(0, half, 2, dtype=grid.dtype, device=grid.device) / half
    waves = []
    for size in (height, width):
        angle = torch.arange(size, dtype=grid.dtype, device=grid.device) / LONGEST_WAVE ** exponents[:, None]
        waves.append(torch.stack([angle.sin(), angle.cos()], dim=1).flatten(0, 1))
    rows, columns = waves
    return torch.cat([rows[:, :, None].expand(-1, -1, width), columns[:, None].expand(-1, height, -1)])
