"""What vestcl.ops.splat skips: counted by hand and against the reference, without a trace in image and gradients."""

from typing import Any

import numpy as np
import pytest
import torch
from test_splat import Scene, all_of, detached, pile, scene
from tolerances import assert_like_reference

from vestcl import constants, opencl, reference
from vestcl.ops.splat import Skipped, composite, rasterize, skipped, splat

GEOMETRY = ("points_uv", "z", "radii", "opacities", "height", "width")


def rasterized(arguments: Scene) -> Any:
    return rasterize(**{name: arguments[name] for name in GEOMETRY})


def layers(opacities: list[float], side: int) -> Scene:
    """On the centre of every pixel of a square image one point of each opacity, radius 1 px, the first the nearest."""
    row = torch.arange(side) + 0.5
    centres = torch.stack(torch.meshgrid(row, row, indexing="xy"), -1).reshape(-1, 2)
    count = len(opacities) * side**2
    values = {
        "points_uv": centres.repeat(len(opacities), 1)[None],
        "radii": torch.ones(1, count),
        "opacities": torch.tensor(opacities).repeat_interleave(side**2)[None],
        "features": torch.randn(1, count, 3),
        "backgrounds": torch.randn(1, 3),
    }
    z = torch.arange(1.0, len(opacities) + 1).repeat_interleave(side**2)[None]
    return {name: value.requires_grad_() for name, value in values.items()} | {"z": z, "height": side, "width": side}


def test_each_reason_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    nan, inf, centre = float("nan"), float("inf"), (8.5, 8.5)
    rows = [  # u, v, z, radius, opacity
        (*centre, 1, 1, 1),
        (nan, 8.5, 1, 1, 1), (8.5, inf, 1, 1, 1), (*centre, nan, 1, 1), (*centre, 1, inf, 1), (*centre, 1, 1, nan),
        (*centre, 0.09, 1, 1), (*centre, -1, 1, 1),
        (*centre, 1, 0, 1), (*centre, 1, -1, 1), (*centre, 1, 1e-200, 1),
        (-2, 8.5, 1, 1, 1), (8.5, 99, 1, 1, 1), (9, 9, 1, 0.25, 1), (99, 8.5, 1, 1, 0),
        (*centre, 1, 1, 0), (*centre, 2, 1, 0),
    ]  # fmt: skip
    u, v, z, radii, opacities = torch.tensor(rows, dtype=torch.float64).T.to(dtype)[:, None]
    arguments = {"points_uv": torch.stack([u, v], -1), "z": z, "radii": radii, "opacities": opacities}
    raster = rasterize(**arguments, height=16, width=40)
    counted = skipped(raster)
    assert counted == Skipped(
        points=len(rows), not_finite=5, behind=2, no_radius=3, outside=4, transparent=2,
        tiles=3, empty_tiles=2, pixels=640, saturated_pixels=1,
    )  # fmt: skip
    assert counted.culled == len(rows) - 1


@pytest.mark.parametrize("min_transmittance", [0.0, 0.3])
def test_like_the_reference(mapped_session: opencl.Session, dtype: torch.dtype, min_transmittance: float) -> None:
    torch.manual_seed(5)
    arguments = scene(2, 400, 1, dtype)
    counted = skipped(rasterized(arguments), min_transmittance)
    arguments = detached(arguments)
    uv, z, radii = arguments["points_uv"], arguments["z"], arguments["radii"]
    behind = z < constants.NEAR
    reach = [
        ((torch.arange(size) + 0.5 - uv[..., axis, None]).abs() < radii[..., None]).any(-1)
        for axis, size in ((0, arguments["width"]), (1, arguments["height"]))
    ]
    outside = ~behind & ~(reach[0] & reach[1])
    blank = {"features": torch.zeros_like(arguments["features"]), "backgrounds": torch.ones(2, 1, dtype=dtype)}
    left = reference.splat(**arguments | blank, min_transmittance=min_transmittance)[0]
    assert (counted.behind, counted.outside) == (int(behind.sum()), int(outside.sum()))
    assert counted.culled == counted.behind + counted.outside
    assert counted.pixels == left.numel()
    assert counted.saturated_pixels == int(((left == 0) | (left < min_transmittance)).sum()) > 0


def test_nothing_to_show(mapped_session: opencl.Session) -> None:
    none = np.zeros((2, 0), np.float32)
    counted = skipped(rasterize(np.zeros((2, 0, 2), np.float32), none, none, none, 20, 37))
    assert (counted.points, counted.culled, counted.saturated_pixels) == (0, 0, 0)
    assert counted.tiles == counted.empty_tiles == 2 * 2 * 3


def test_min_transmittance_is_checked(session: opencl.Session) -> None:
    with pytest.raises(ValueError, match="`min_transmittance` must be in"):
        skipped(rasterized(detached(pile([1.0], [1.0]))), 1.0)


def test_points_of_opacity_zero_leave_no_trace(mapped_session: opencl.Session) -> None:
    torch.manual_seed(3)
    arguments = detached(scene(2, 300, 4))
    arguments["opacities"][:, ::3] = 0
    assert skipped(rasterized(arguments)).transparent > 0
    kept = arguments | {
        name: torch.stack([row[torch.arange(300) % 3 != 0] for row in arguments[name]])
        for name in ("points_uv", "z", "radii", "opacities", "features")
    }
    for one, other in zip(splat(**arguments), splat(**kept), strict=True):
        assert torch.equal(one, other)


def test_opacity_zero_has_its_gradient(mapped_session: opencl.Session) -> None:
    torch.manual_seed(4)
    arguments = scene(2, 300, 4)
    with torch.no_grad():
        arguments["opacities"][:, ::3] = 0
    assert skipped(rasterized(arguments)).transparent == 0
    assert_like_reference(splat, reference.splat, **arguments)


def test_opacities_that_require_grad_too_late(session: opencl.Session) -> None:
    arguments = detached(pile([0.5], [1.0]))
    raster = rasterized(arguments)
    arguments["opacities"].requires_grad_()
    with pytest.raises(ValueError, match="must require grad when `rasterize` is called"):
        composite(raster, arguments["features"])


@pytest.mark.parametrize("min_transmittance", [0.0, 0.01])
def test_behind_opaque_layers(mapped_session: opencl.Session, min_transmittance: float) -> None:
    """400 points on each of 4 x 4 pixels, the 100th opaque: the traversal stops long before the list ends."""
    torch.manual_seed(6)
    arguments = layers([0.01] * 99 + [1.0] + [0.5] * 300, 4)
    assert skipped(rasterized(arguments), min_transmittance).saturated_pixels == 16
    assert_like_reference(splat, reference.splat, **arguments, min_transmittance=min_transmittance)
    hidden = all_of(arguments)[2:-1]
    for grad in hidden:
        assert not grad.reshape(-1, *grad.shape[2:])[100 * 16 :].any()


@pytest.mark.parametrize("min_transmittance", [0.0, 0.01])
def test_behind_a_wall_across_tiles(mapped_session: opencl.Session, min_transmittance: float) -> None:
    """Points at the corner of four tiles, behind a wall that is opaque in two of them."""
    torch.manual_seed(7)
    arguments, count = layers([1.0], 17), 900
    wall = arguments["points_uv"][..., 0] < 16
    assert wall.sum() == 16 * 17
    behind = {
        "points_uv": 15 + 2 * torch.rand(1, count, 2),
        "z": 2 + torch.rand(1, count),
        "radii": 1 + torch.rand(1, count),
        "opacities": torch.rand(1, count) / 50,
        "features": torch.randn(1, count, 3),
    }
    for name, more in behind.items():
        both = torch.cat([arguments[name].detach()[wall][None], more], 1)
        arguments[name] = both if name == "z" else both.requires_grad_()
    assert_like_reference(splat, reference.splat, **arguments, min_transmittance=min_transmittance)
