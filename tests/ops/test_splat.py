"""vestcl.ops.splat against the reference implementation and by hand. What is extreme is in test_splat_stress.py."""

from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_like_reference
from torch.autograd import gradcheck

from vestcl import opencl, reference
from vestcl.ops.splat import composite, rasterize, splat

Scene = dict[str, Any]
INPUTS = ("points_uv", "radii", "opacities", "features", "backgrounds")


def scene(batch: int, count: int, channels: int, dtype: torch.dtype = torch.float32) -> Scene:
    """Points on and around an image of 3 x 2 tiles, the last ones partial: a third opaque, of which half lie on a
    pixel's centre (alpha is exactly 1), some at equal depths, some behind the camera, some in many tiles."""
    kinds: dict[str, Any] = {"dtype": dtype}
    opaque = torch.rand(batch, count) < 1 / 3
    points_uv = torch.rand(batch, count, 2, **kinds) * torch.tensor([45, 28]) - 4
    centred = (opaque & (torch.rand(batch, count) < 1 / 2))[..., None]
    radii = torch.rand(batch, count, **kinds) * 3 + 0.3
    values = {
        "points_uv": torch.where(centred, points_uv.floor() + 0.5, points_uv),
        "z": torch.randint(-4, 40, (batch, count)).to(dtype) / 4,
        "radii": torch.where(torch.rand(batch, count) < 0.1, 6 * radii, radii),
        "opacities": torch.where(opaque, 1, torch.rand(batch, count, **kinds)),
        "features": torch.randn(batch, count, channels, **kinds),
        "backgrounds": torch.randn(batch, channels, **kinds),
    }
    for name in INPUTS:
        values[name] = values[name].to(dtype).requires_grad_()
    return {**values, "height": 20, "width": 37}


def detached(arguments: Scene) -> Scene:
    return {key: value.detach() if isinstance(value, torch.Tensor) else value for key, value in arguments.items()}


def pile(o: list[float], f: list[float], r: float = 1.0, dtype: torch.dtype = torch.float32) -> Scene:
    """Points on the centre of an image of one pixel, the nearest first."""
    count = len(o)
    values = {
        "points_uv": torch.full((1, count, 2), 0.5),
        "z": torch.arange(1.0, count + 1)[None],
        "radii": torch.full((1, count), r),
        "opacities": torch.tensor([o]),
        "features": torch.tensor(f)[None, :, None],
    }
    return {name: value.to(dtype) for name, value in values.items()} | {"height": 1, "width": 1}


def all_of(arguments: Scene) -> tuple[torch.Tensor, ...]:
    """Image, coverage, and the gradients of one fixed loss for all inputs."""
    image, coverage = splat(**arguments)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(output.shape, generator=generator, dtype=output.dtype) for output in (image, coverage)]
    return image, coverage, *torch.autograd.grad((image, coverage), [arguments[name] for name in INPUTS], weights)


def assert_same_bits(got: tuple[torch.Tensor, ...], wanted: tuple[torch.Tensor, ...]) -> None:
    for one, other in zip(got, wanted, strict=True):
        assert torch.equal(one, other)


def test_oracle(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    """o = 1, r = 1.5: 1 at the own pixel, 5/9 at the 4-neighbours, 1/9 at the diagonals, nothing further out."""
    point = pile([1.0], [2.0], r=1.5, dtype=dtype) | {"height": 5, "width": 5}
    image, coverage = splat(**(point | {"points_uv": torch.full((1, 1, 2), 2.5, dtype=dtype)}))
    wanted = torch.zeros(1, 1, 5, 5, dtype=torch.float64)
    wanted[0, 0, 1:4, 1:4] = torch.tensor([[1.0, 5, 1], [5, 9, 5], [1, 5, 1]]).double() / 9
    assert coverage[0, 0, 2, 2] == 1
    assert_close(coverage, wanted)
    assert_close(image, 2 * wanted)


def test_two_layers_by_hand(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    """The far one comes first in memory. Own pixel: a = 0.5 in front of 0.75; right neighbour: 5/18 of 5/12."""
    points = pile([0.75, 0.5], [10.0, 20.0], r=1.5, dtype=dtype) | {"width": 2}
    points |= {"z": torch.tensor([[4, 2]], dtype=dtype), "backgrounds": torch.tensor([[100]], dtype=dtype)}
    image, coverage = splat(**points)
    near, far = 5 / 18, 5 / 12
    assert image[0, 0, 0, 0] == 0.5 * 20 + 0.5 * (0.75 * 10 + 0.25 * 100) and coverage[0, 0, 0, 0] == 0.875
    assert image[0, 0, 0, 1].item() == pytest.approx(near * 20 + (1 - near) * (far * 10 + (1 - far) * 100))
    assert coverage[0, 0, 0, 1].item() == pytest.approx(1 - (1 - near) * (1 - far))


def test_gradients_by_hand_behind_an_opaque_point(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    """dL/da_1 = f_1 - f_2 and dL/da_2 = 0, for two opaque points on one pixel: 1 - a = 0 divides nothing."""
    points = pile([1.0, 1.0], [3.0, 5.0], dtype=dtype)
    opacities, features = points["opacities"].requires_grad_(), points["features"].requires_grad_()
    splat(**points)[0].sum().backward()
    assert opacities.grad is not None and opacities.grad.tolist() == [[3 - 5, 0]]
    assert features.grad is not None and features.grad.tolist() == [[[1], [0]]]


def test_equal_depths_are_composited_by_index(mapped_session: opencl.Session) -> None:
    points = pile([1.0] * 3, [1.0, 2.0, 3.0])
    assert splat(**(points | {"z": torch.ones(1, 3)}))[0].item() == 1


def test_min_transmittance_by_hand(mapped_session: opencl.Session) -> None:
    """T is 1, 0.5, 0.25, ...: with 0.5 two points are taken, for 0.5 is not below 0.5; with 0.6 one."""
    points = pile([0.5] * 4, [1.0, 10.0, 100.0, 1000.0])
    for limit, wanted, covered in [(0.0, 78.0, 0.9375), (0.5, 3.0, 0.75), (0.6, 0.5, 0.5)]:
        image, coverage = splat(**points, min_transmittance=limit)
        assert (image.item(), coverage.item()) == (wanted, covered)


@pytest.mark.parametrize(
    ("channels", "dtype"),
    [(n, torch.float32) for n in (1, 2, 3, 4, 5, 16, 32, 37, 64, 256)] + [(n, torch.float64) for n in (1, 5, 16, 37)],
    indirect=["dtype"],
)
def test_like_reference(mapped_session: opencl.Session, dtype: torch.dtype, channels: int) -> None:
    arguments = scene(2, 120, channels, dtype)
    assert_like_reference(splat, reference.splat, **arguments)
    image, coverage = splat(**arguments)
    assert (image.shape, coverage.shape) == ((2, channels, 20, 37), (2, 1, 20, 37))
    assert image.is_contiguous(memory_format=torch.channels_last) and coverage.is_contiguous()


@pytest.mark.parametrize("min_transmittance", [0.02, 0.3])
def test_truncated_like_reference(mapped_session: opencl.Session, dtype: torch.dtype, min_transmittance: float) -> None:
    assert_like_reference(splat, reference.splat, **scene(2, 400, 3, dtype), min_transmittance=min_transmittance)


@pytest.mark.parametrize("output", [0, 1])
def test_gradient_of_one_output_only(mapped_session: opencl.Session, output: int) -> None:
    arguments = scene(2, 50, 3)
    if output == 1:  # the reference's coverage does not depend on these, the operator's gradient of them is 0
        grads = torch.autograd.grad(splat(**arguments)[1].sum(), [arguments[name] for name in INPUTS])
        assert not grads[3].any() and not grads[4].any() and all(grad.any() for grad in grads[:3])
        arguments |= {name: arguments[name].detach() for name in ("features", "backgrounds")}
    assert_like_reference(lambda **a: splat(**a)[output], lambda **a: reference.splat(**a)[output], **arguments)


@pytest.mark.parametrize("asked", INPUTS)
def test_only_the_gradient_asked_for(
    mapped_session: opencl.Session, monkeypatch: pytest.MonkeyPatch, asked: str
) -> None:
    """It is right, and the kernels that compute it are built for it only."""
    arguments = detached(scene(2, 50, 3))
    arguments[asked].requires_grad_()
    built: list[opencl.Defines] = []
    plain = mapped_session.kernel

    def kernel(file: str, name: str, defines: opencl.Defines) -> Any:
        built.append(defines)
        return plain(file, name, defines)

    monkeypatch.setattr(mapped_session, "kernel", kernel)
    assert_like_reference(lambda **a: splat(**a)[0], lambda **a: reference.splat(**a)[0], **arguments)
    backward = [defines for defines in built if "GRAD_FEATURES" in defines]
    assert backward and all({n for n in INPUTS if d[f"GRAD_{n.upper()}"]} == {asked} for d in backward)


def test_gradcheck(mapped_session: opencl.Session, float64: torch.dtype) -> None:
    arguments = scene(2, 12, 2, float64) | {"height": 3, "width": 18}
    with torch.no_grad():
        arguments["points_uv"] *= 0.45
        arguments["points_uv"][:, 0] = 1.5
    check_gradients(arguments)
    check_gradients(arguments | {"min_transmittance": 0.3})  # no T is so close to it that gradcheck's steps cross it


def test_gradcheck_on_a_pile_of_opaque_points(mapped_session: opencl.Session, float64: torch.dtype) -> None:
    """Every point on the pixel's centre with alpha exactly 1 and the same depth."""
    points = pile([1.0] * 5, [1.0, -2.0, 3.0, -4.0, 5.0], dtype=float64)
    opacities, features = points.pop("opacities").requires_grad_(), points.pop("features").requires_grad_()
    points["z"] = torch.ones_like(points["z"])
    assert gradcheck(lambda o, f: splat(**points, opacities=o, features=f), (opacities, features))


def check_gradients(arguments: Scene) -> None:
    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return splat(**(arguments | dict(zip(INPUTS, values, strict=True))))

    assert gradcheck(outputs, tuple(arguments[name] for name in INPUTS))


def test_numpy_in_numpy_out(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = detached(scene(2, 50, 5, dtype))
    arrays: Scene = {name: v.numpy() if isinstance(v, torch.Tensor) else v for name, v in arguments.items()}
    for array, tensor in zip(splat(**arrays), splat(**arguments), strict=True):
        assert isinstance(array, np.ndarray) and np.array_equal(array, tensor.numpy())


@pytest.mark.parametrize("nothing", ["no clouds", "no points", "all behind the camera", "all next to the image"])
def test_nothing_to_draw(mapped_session: opencl.Session, nothing: str) -> None:
    arguments = detached(scene(2, 5, 3))
    if nothing == "no clouds":
        arguments = {name: v[:0] if isinstance(v, torch.Tensor) else v for name, v in arguments.items()}
    elif nothing == "no points":
        arguments |= {name: arguments[name][:, :0] for name in ("points_uv", "z", *INPUTS[1:4])}
    elif nothing == "all behind the camera":
        arguments["z"] = -arguments["z"].abs()
    else:
        arguments["points_uv"] = arguments["points_uv"] + 100
    for name in INPUTS:
        arguments[name].requires_grad_()
    image, coverage, *grads = all_of(arguments)
    assert torch.equal(image, arguments["backgrounds"][:, :, None, None].expand(-1, 3, 20, 37))
    assert coverage.shape == (len(image), 1, 20, 37) and not coverage.any()
    assert [grad.shape for grad in grads] == [arguments[name].shape for name in INPUTS]
    assert not any(grad.any() for grad in grads[:4])
    assert nothing == "no clouds" or grads[4].all()


@pytest.mark.parametrize("counts", [[30, 0, 12], [0, 0, 1], [42], [0]])
def test_packed_clouds_are_the_single_clouds(mapped_session: opencl.Session, counts: list[int]) -> None:
    clouds = [scene(1, count, 5) for count in counts]
    single = [all_of(cloud) for cloud in clouds]
    packed = {name: torch.cat([cloud[name][0] for cloud in clouds]).detach() for name in ("z", *INPUTS[:4])}
    packed |= {"backgrounds": torch.cat([cloud["backgrounds"] for cloud in clouds]).detach()}
    for name in INPUTS:
        packed[name].requires_grad_()
    starts = torch.tensor([0, *np.cumsum(counts)])
    arguments: Scene = packed | {"height": 20, "width": 37, "cloud_starts": starts}
    assert_like_reference(splat, reference.splat, **arguments)
    image, coverage = splat(**arguments)
    for b, (single_image, single_coverage, *_) in enumerate(single):
        assert torch.equal(image[b], single_image[0]) and torch.equal(coverage[b], single_coverage[0])


def test_two_feature_sets_on_one_geometry(mapped_session: opencl.Session) -> None:
    """`composite` on one `rasterize` is `splat`, and the gradients of the two sets add up."""
    first = scene(2, 60, 3)
    second = first | {"features": torch.randn(2, 60, 16, requires_grad=True), "backgrounds": None}
    geometry = {name: first[name] for name in ("points_uv", "z", "radii", "opacities", "height", "width")}
    raster = rasterize(**geometry)
    together = [composite(raster, a["features"], a["backgrounds"]) for a in (first, second)]
    apart = [splat(**a) for a in (first, second)]
    for one, other in zip(together, apart, strict=True):
        assert_same_bits(one, other)
    inputs = [first[name] for name in INPUTS[:4]]
    grads = [torch.autograd.grad(sum(o.square().sum() for pair in p for o in pair), inputs) for p in (together, apart)]
    assert_same_bits(*grads)
    assert (raster.height, raster.width) == (20, 37)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points_uv": torch.ones(2, 5, 3)}, r"`points_uv` must be \[B, N, 2\], got \[2, 5, 3\]"),
        ({"z": torch.ones(2, 4)}, r"`z` must be \[B, N\] with N = 5 as in `points_uv`, got \[2, 4\]"),
        ({"radii": torch.ones(1, 5)}, r"`radii` must be \[B, N\] with B = 2 as in `points_uv`, got \[1, 5\]"),
        ({"opacities": torch.ones(2, 5, 1)}, r"`opacities` must be \[B, N\], got \[2, 5, 1\]"),
        ({"features": torch.ones(2, 6, 3)}, r"`features` must be \[B, N, C\] with N = 5 .*, got \[2, 6, 3\]"),
        ({"features": torch.ones(())}, r"`features` must be \[B, N, C\], got \[\]"),
        ({"features": None}, "`features` must be a torch tensor or a NumPy array, got NoneType"),
        ({"backgrounds": None, "features": torch.ones(2, 5, 0)}, "`features` must have 1 to 1024 channels, got 0"),
        ({"backgrounds": None, "features": torch.ones(2, 5, 1025)}, "must have 1 to 1024 channels, got 1025"),
        ({"backgrounds": torch.ones(2, 4)}, r"`backgrounds` must be .*, got \[2, 4\]"),
        ({"z": np.ones((2, 5), np.float32)}, "`z` must be a torch tensor as `points_uv` is, got a NumPy array"),
        ({"features": np.ones((2, 5, 3), np.float32)}, "`features` must be a torch tensor as"),
        ({"radii": torch.ones(2, 5).double()}, "`radii` must be float32 as `points_uv` is, got float64"),
        ({"features": torch.ones(2, 5, 3).double()}, "`features` must be float32 as .*, got float64"),
        ({"points_uv": torch.ones(2, 5, 2).int()}, "`points_uv` must be float32 or float64, got int32"),
        ({"points_uv": [[[1.0, 2.0]]]}, "`points_uv` must be a torch tensor or a NumPy array, got list"),
        ({"points_uv": torch.ones(2, 5, 2, device="meta")}, r"`points_uv` must be on the CPU .*, got device meta"),
        ({"features": torch.ones(2, 5, 3, device="meta")}, r"`features` must be on the CPU .*, got device meta"),
        ({"features": torch.ones(2, 5, 3).to_sparse()}, "`features` must be a dense tensor, got layout"),
        ({"z": torch.ones(2, 5, requires_grad=True)}, r"`z` must not require grad .*; pass z.detach\(\)"),
        ({"height": 0}, "`height` must be a whole number of pixels >= 1, got 0"),
        ({"width": 2.0}, "`width` must be a whole number of pixels >= 1, got 2.0"),
        ({"min_transmittance": 1.0}, r"`min_transmittance` must be in \[0, 1\), got 1.0"),
        ({"min_transmittance": float("nan")}, r"`min_transmittance` must be in \[0, 1\), got nan"),
        ({"cloud_starts": torch.tensor([0, 5, 10])}, r"`points_uv` must be \[P, 2\], got \[2, 5, 2\]"),
    ],
)
def test_refuses(change: Scene, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        splat(**(scene(2, 5, 3) | change))


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        (torch.tensor([0, 6, 5, 10]), r"`cloud_starts` must rise from 0 to 10, got \[0, 6, 5, 10\]"),
        (torch.tensor([1, 5, 10]), "`cloud_starts` must rise from 0 to 10"),
        (torch.tensor([0, 5, 9]), "`cloud_starts` must rise from 0 to 10"),
        (torch.tensor([0.0, 10.0]), r"`cloud_starts` must be int64 \[B \+ 1\], got float32 \[2\]"),
        (torch.tensor([], dtype=torch.int64), r"`cloud_starts` must be int64 \[B \+ 1\], got int64 \[0\]"),
        (np.array([0, 10]), "`cloud_starts` must be a torch tensor, got ndarray"),
        ([0, 10], "`cloud_starts` must be a torch tensor, got list"),
    ],
)
def test_refuses_starts(starts: Any, message: str) -> None:
    packed = {name: value[0] for name, value in scene(1, 10, 3).items() if name in ("z", *INPUTS[:4])}
    with pytest.raises(ValueError, match=message):
        splat(**packed, height=20, width=37, cloud_starts=starts)


def test_a_depth_that_requires_grad_is_welcome_where_none_is_recorded(session: opencl.Session) -> None:
    with torch.no_grad():
        assert splat(**(scene(1, 5, 3) | {"z": torch.ones(1, 5, requires_grad=True)}))[0].isfinite().all()
