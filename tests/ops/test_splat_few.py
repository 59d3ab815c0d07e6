"""Few points take fewer launches, and the same bits."""

from typing import Any

import pytest
import torch
from test_splat import INPUTS, Scene, all_of, assert_same_bits, scene

from vestcl import opencl
from vestcl.ops import _splat_composite, _splat_lists
from vestcl.ops.splat import rasterize, skipped, splat


@pytest.fixture(autouse=True)
def _makes_fewer_launches(session: opencl.Session) -> None:
    if session.mapping != "tile" or not session.writes_host_memory:
        pytest.skip("only devices that write host memory make fewer launches")


def kernels_of(session: opencl.Session, arguments: Scene) -> list[str]:
    with session.profile() as times:
        all_of(arguments)
    return [kernel.name for kernel in times]


def sized(arguments: Scene, height: int, width: int) -> Scene:
    return arguments | {"height": height, "width": width}


def test_launches(session: opencl.Session) -> None:
    arguments = scene(1, 300, 3)
    wanted = ["list_few", "composite_tiles", "composite_few_backward"]
    assert kernels_of(session, arguments) == wanted
    assert "composite_tiles_backward" in kernels_of(
        session, sized(arguments, 16, 16 * (_splat_composite.FEW_TILES + 1))
    )
    assert kernels_of(session, scene(1, _splat_lists.FEW_POINTS, 3)) == wanted
    assert "composite_tiles_backward" in kernels_of(session, scene(1, 10, 64))
    assert kernels_of(session, scene(1, _splat_lists.FEW_POINTS + 1, 3))[:2] == ["count_tiles", "scan_chunks"]
    assert kernels_of(session, sized(arguments, 16, 16 * _splat_lists.FEW_PAIRS))[0] == "count_tiles"


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("channels", [3, 17])
@pytest.mark.parametrize(("height", "width"), [(20, 37), (1, 1), (16, 32), (130, 16), (3, 90)])
def test_same_bits(
    session: opencl.Session, monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, batch: int, channels: int,
    height: int, width: int,
) -> None:  # fmt: skip
    arguments = sized(scene(batch, 90, channels, dtype), height, width)
    few = all_of(arguments)
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)
    assert_same_bits(few, all_of(arguments))


@pytest.mark.parametrize("min_transmittance", [0.0, 0.3])
def test_same_bits_in_long_lists(
    session: opencl.Session, monkeypatch: pytest.MonkeyPatch, min_transmittance: float
) -> None:
    arguments = scene(1, 1000, 5) | {"min_transmittance": min_transmittance}
    with torch.no_grad():
        arguments["z"] = torch.rand(1, 1000) + 1
        arguments["radii"] *= 6
        arguments["features"][:, ::17] = float("nan")
    few = all_of(arguments)
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)
    assert_same_bits(few, all_of(arguments))


@pytest.mark.parametrize("name", INPUTS)
def test_same_bits_of_one_gradient(session: opencl.Session, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    arguments = scene(1, 100, 3)

    def gradient() -> tuple[torch.Tensor, ...]:
        image, _ = splat(**arguments)
        return torch.autograd.grad(image.square().sum(), arguments[name])

    few = gradient()
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)
    assert_same_bits(few, gradient())


def test_lists_of_a_raster(session: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """What only waits when a job of its own ends: the numbers that the host reads."""
    values: dict[str, Any] = {
        key: value for key, value in scene(2, 200, 1).items() if key not in ("features", "backgrounds")
    }

    def numbers() -> tuple[Any, ...]:
        raster = rasterize(**values)
        lists = raster.lists
        return lists.tile_starts.tolist(), lists.tile_scratch.tolist(), lists.steps, skipped(raster)

    few = numbers()
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)
    assert few == numbers()


def test_packed_clouds(session: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    dense = scene(1, 120, 3)
    packed = {name: dense[name][0] for name in ("points_uv", "z", "radii", "opacities", "features")}
    starts = torch.tensor([0, 0, 50, 50, 120])
    images = splat(**packed, height=20, width=20, cloud_starts=starts)
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)
    assert_same_bits(images, splat(**packed, height=20, width=20, cloud_starts=starts))
