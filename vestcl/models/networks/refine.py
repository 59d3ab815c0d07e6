"""Refinement: a U-Net that makes the image out of what the clouds left on the new view."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import nn
from torch.nn import functional

from vestcl.models.config import (
    FORECAST_PLANES,
    LEAST_COVERAGE,
    MOST_CHANGE,
    OPAQUE,
    REFINE_GROUP,
    RefineConfig,
    RenderConfig,
)
from vestcl.models.networks.layers import channels_last, group_norm, side_by_side, upsample
from vestcl.shapes import check


class Refine(nn.Module):
    """Rendered channels -> image.

    A stem at full resolution; downs of max-pool and two convs, of which the last one is the bottleneck; ups of
    bilinear x2, joined with the level's second conv, conv, joined with its first conv, conv; the last up is joined
    with the stem, and a conv makes three channels. Convs are 3x3 with GroupNorm and PReLU.

    Without a base it returns sigmoid(y). With one it gives b + y, with y exactly 0 at the start; out of training that
    is clamped to [0, 1]. "splatted" takes the rendered colour (premultiplied with coverage), current frame over
    previous frame, b = c_cur + (1 - coverage_cur) c_prev. "filled" takes colours divided by coverage, opaque from
    OPAQUE on, the current frame over the previous one, and `fill`s what is left.

    Of a geometric forecast (`RefineConfig.refines`) it takes `vestcl.forecasting.network.planes`, image I and coverage
    c among them, and gives I + m(c) tanh(y): m is MOST_CHANGE from coverage OPAQUE on, and 1 where nothing is covered.

    Source: SPEC section 6; 3D Moments (CVPR 2022). There, four max-pools face five doublings, and the first doubled
    image is cut to its middle to fit; here the bottleneck has a max-pool of its own.
    """

    def __init__(
        self, config: RefineConfig | None = None, render: RenderConfig | None = None, features: int = 32
    ) -> None:
        super().__init__()
        config, self.render, self.features = config or RefineConfig(), render or RenderConfig(), features
        if config.base != "none" and not self.render.colour:
            raise ValueError("`config.base` adds to the rendered colour, so it needs `render.colour`")
        self.base = config.base
        self.of_forecast = config.refines == "forecast"
        self.channels = FORECAST_PLANES if self.of_forecast else self.render.channels(features)
        kernel, widths = config.stem_kernel, (config.stem, *config.widths)
        self.stem = nn.Sequential(
            nn.Conv2d(self.channels, config.stem, kernel, padding=kernel // 2, bias=False), nn.PReLU()
        )
        self.downs = nn.ModuleList(Down(*pair) for pair in zip(widths, [*config.widths, widths[-1]], strict=True))
        self.ups = nn.ModuleList(Up(wide, narrow) for wide, narrow in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.out = nn.Conv2d(2 * config.stem, 3, 3, padding=1)
        if self.base != "none":
            nn.init.zeros_(self.out.weight)
            assert self.out.bias is not None
            nn.init.zeros_(self.out.bias)

    def forward(self, rendered: torch.Tensor) -> torch.Tensor:
        """Paint the image.

        Args:
            rendered: [B, channels, H, W] of any size: for the previous frame's cloud and then the current one's (or
                once, for both together) the features and, if colour is rendered, colour 3, coverage 1 and inverse
                depth 1, as `RenderConfig.channels` counts them. Or the planes of a geometric forecast.

        Returns:
            image [B, 3, H, W]; differentiable.

        Raises:
            ValueError: ``rendered`` is not floating point [B, channels, H, W].
        """
        if self.of_forecast:
            image = rendered[:, :3] + self.change(rendered)
            return image if self.training else image.clamp(0, 1)
        y = self.painted(rendered)
        if self.base == "none":
            return y.sigmoid()
        image = self.base_image(rendered) + y
        return image if self.training else image.clamp(0, 1)

    def change(self, planes: torch.Tensor, painted: torch.Tensor | None = None) -> torch.Tensor:
        """m(c) tanh(y) of the class's formula, [B, 3, H, W].

        Args:
            planes: [B, FORECAST_PLANES, H, W] of a geometric forecast.
            painted: y [B, 3, H, W]; None is `painted` of the planes.
        """
        y = self.painted(planes) if painted is None else painted
        covered = (planes[:, 3:4] / OPAQUE).clamp(0, 1)
        return (1 - (1 - MOST_CHANGE) * covered) * y.tanh()

    def painted(self, rendered: torch.Tensor) -> torch.Tensor:
        """y of the class's formula, [B, 3, H, W]; arguments and errors as of `forward`."""
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
        return cast(torch.Tensor, self.out(side_by_side([stem, upsample(x, 2, *stem.shape[-2:])])))

    def base_image(self, rendered: torch.Tensor) -> torch.Tensor:
        """b of the class's formula, [B, 3, H, W], of what `forward` is given."""
        sides = rendered.chunk(1 if self.render.joint else 2, dim=1)
        looks = (side[:, self.features :].split([3, 1, 1], dim=1) for side in sides)
        return self.base_of([(colour, coverage) for colour, coverage, _ in looks])

    def base_of(self, sides: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> torch.Tensor:
        """b, [B, 3, H, W], of the sides' colour [B, 3, H, W] and coverage [B, 1, H, W], the last one in front."""
        image, opacity = (
            torch.zeros_like(sides[0][0], memory_format=torch.contiguous_format),
            torch.zeros_like(sides[0][1]),
        )
        for colour, coverage in sides:
            colour = colour.contiguous()  # three planes are faster to fill than pixels of three
            if self.base == "filled":
                coverage = ((coverage - LEAST_COVERAGE) / (OPAQUE - LEAST_COVERAGE)).clamp(0, 1)
                colour = colour * coverage
            image, opacity = colour + (1 - coverage) * image, coverage + (1 - coverage) * opacity
        return fill(image, opacity) if self.base == "filled" else image


def fill(image: torch.Tensor, opacity: torch.Tensor) -> torch.Tensor:
    """c + (1 - a) up(fill(coarser c, coarser a)): push and pull. A coarser pixel is as opaque as the sum of its four.

    Args:
        image: c [B, C, H, W], times opacity.
        opacity: a [B, 1, H, W] in [0, 1].

    Returns:
        [B, C, H, W], opaque; black where there is nothing in the whole image. Differentiable.

    Source: Gortler et al., The Lumigraph, 1996.
    """
    height, width = image.shape[2:]
    if height == width == 1:
        return image / opacity.clamp(min=1e-6)
    pooled = functional.avg_pool2d(torch.cat([image, opacity], dim=1), 2, ceil_mode=True, count_include_pad=False)
    gain = 1 / pooled[:, -1:].clamp(min=0.25)
    coarse = fill(pooled[:, :-1] * gain, (pooled[:, -1:] * gain).clamp(max=1))
    return image + (1 - opacity) * upsample(coarse, 2, height, width)


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
        x = self.first(side_by_side([level_second, x]))
        return self.second(side_by_side([level_first, x]))


def _conv(channels_in: int, channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(channels_in, channels, 3, padding=1), group_norm(channels, REFINE_GROUP), nn.PReLU())
