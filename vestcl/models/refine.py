"""Refinement: a U-Net that makes the image out of what the clouds left on the new view."""

import torch
from torch import nn
from torch.nn import functional

from vestcl.models._layers import channels_last, check, group_norm, upsample
from vestcl.models.config import REFINE_GROUP, RefineConfig, RenderConfig


class Refine(nn.Module):
    """Rendered channels -> image.

    A stem at full resolution; downs of max-pool and two convs, of which the last one is the bottleneck; ups of
    bilinear x2, joined with the level's second conv, conv, joined with its first conv, conv; the last up is joined
    with the stem, and a conv makes three channels. Convs are 3x3 with GroupNorm and PReLU.

    Painting gives sigmoid(y). Residual gives b + y, with y exactly 0 at the start: b is the rendered colour (which
    is premultiplied with coverage), current frame over previous frame, b = c_cur + (1 - coverage_cur) c_prev; out of
    training it is clamped to [0, 1].

    Source: SPEC section 6; 3D Moments (CVPR 2022). There, four max-pools face five doublings, and the first doubled
    image is cut to its middle to fit; here the bottleneck has a max-pool of its own.
    """

    def __init__(
        self, config: RefineConfig | None = None, render: RenderConfig | None = None, features: int = 32
    ) -> None:
        super().__init__()
        config, self.render, self.features = config or RefineConfig(), render or RenderConfig(), features
        if config.residual and not self.render.colour:
            raise ValueError("`config.residual` adds to the rendered colour, so it needs `render.colour`")
        self.residual = config.residual
        self.channels = self.render.channels(features)
        kernel, widths = config.stem_kernel, (config.stem, *config.widths)
        self.stem = nn.Sequential(
            nn.Conv2d(self.channels, config.stem, kernel, padding=kernel // 2, bias=False), nn.PReLU()
        )
        self.downs = nn.ModuleList(Down(*pair) for pair in zip(widths, [*config.widths, widths[-1]], strict=True))
        self.ups = nn.ModuleList(Up(wide, narrow) for wide, narrow in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.out = nn.Conv2d(2 * config.stem, 3, 3, padding=1)
        if self.residual:
            nn.init.zeros_(self.out.weight)
            assert self.out.bias is not None
            nn.init.zeros_(self.out.bias)

    def forward(self, rendered: torch.Tensor) -> torch.Tensor:
        """Paint the image.

        Args:
            rendered: [B, channels, H, W] of any size: for the previous frame's cloud and then the current one's (or
                once, for both together) the features and, if colour is rendered, colour 3, coverage 1 and inverse
                depth 1, as `RenderConfig.channels` counts them.

        Returns:
            image [B, 3, H, W]; differentiable.

        Raises:
            ValueError: ``rendered`` is not floating point [B, channels, H, W].
        """
        check(rendered=(rendered, f"B {self.channels} H W"))
        stem = self.stem(channels_last(rendered))
        levels = []
        x = stem
        for down in self.downs:
            first, x = down(x)
            levels.append((first, x))
        levels.pop()
        for up in self.ups:
            x = up(x, *levels.pop())
        y = self.out(torch.cat([stem, upsample(x, 2, *stem.shape[-2:])], dim=1))
        if not self.residual:
            return y.sigmoid()
        image = self._splatted_colour(rendered) + y
        return image if self.training else image.clamp(0, 1)

    def _splatted_colour(self, rendered: torch.Tensor) -> torch.Tensor:
        """b of the class's formula, [B, 3, H, W]."""
        colour = slice(self.features, self.features + 3)
        if self.render.joint:
            return rendered[:, colour]
        prev, cur = rendered.chunk(2, dim=1)
        uncovered = 1 - cur[:, self.features + 3 : self.features + 4]
        return cur[:, colour] + uncovered * prev[:, colour]


class Down(nn.Module):
    """Half the size (rounded up), then two convs."""

    def __init__(self, channels_in: int, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels_in, channels)
        self.second = _conv(channels, channels)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[B, channels_in, H, W] -> what either conv gives, [B, channels, ceil(H / 2), ceil(W / 2)]."""
        first = self.first(functional.max_pool2d(x, 2, ceil_mode=True))
        return first, self.second(first)


class Up(nn.Module):
    """Twice the size, joined with both convs of the level that is reached."""

    def __init__(self, channels_in: int, channels: int) -> None:
        super().__init__()
        self.first = _conv(2 * channels_in, channels_in)
        self.second = _conv(2 * channels_in, channels)

    def forward(self, x: torch.Tensor, level_first: torch.Tensor, level_second: torch.Tensor) -> torch.Tensor:
        """[B, channels_in, h, w] and two [B, channels_in, H, W] of twice that size -> [B, channels, H, W]."""
        x = upsample(x, 2, *level_second.shape[-2:])
        x = self.first(torch.cat([level_second, x], dim=1))
        return self.second(torch.cat([level_first, x], dim=1))


def _conv(channels_in: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, padding=1), group_norm(channels, REFINE_GROUP), nn.PReLU())
