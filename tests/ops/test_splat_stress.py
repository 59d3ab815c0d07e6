"""vestcl.ops.splat at its limits: long lists, extreme numbers, numbers that aren't any, and scenes by hypothesis."""

import math
import os
from typing import Any

import numpy as np
import pytest
import tolerances
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from test_splat import INPUTS, Scene, all_of, assert_same_bits, detached, pile, scene
from tolerances import assert_close, assert_like_reference

from vestcl import opencl, reference
from vestcl.ops.splat import splat

PER_POINT = ("points_uv", "z", "radii", "opacities", "features")


@pytest.fixture
def long_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand roundings in a row."""
    monkeypatch.setitem(tolerances.TOLERANCE, torch.float32, 2e-5)


def crowd(count: int, channels: int = 3, size: int = 16, **own: Any) -> Scene:
    """Points that cover one tile or a part of it."""
    arguments = detached(scene(1, count, channels, **own)) | {"height": size, "width": size}
    dtype = arguments["features"].dtype
    arguments["points_uv"] = torch.rand(1, count, 2, dtype=dtype) * size
    arguments["z"] = torch.rand(1, count, dtype=dtype) * 50 + 1
    return recording(arguments)


def recording(arguments: Scene) -> Scene:
    return arguments | {name: arguments[name].detach().requires_grad_() for name in INPUTS}


def without(arguments: Scene, index: int) -> Scene:
    """The scene without point ``index``."""
    others = [i for i in range(arguments["z"].shape[1]) if i != index]
    kept = {name: arguments[name].detach()[:, others] for name in PER_POINT}
    return recording(arguments | kept)


def assert_as_if_absent(arguments: Scene, index: int) -> None:
    """Point ``index`` leaves no trace in image, coverage and the others' gradients, and has none itself."""
    image, coverage, *grads = all_of(arguments)
    wanted = all_of(without(arguments, index))
    assert not any(grad[:, index].any() for grad in grads[:4])
    kept = [torch.cat([grad[:, :index], grad[:, index + 1 :]], dim=1) for grad in grads[:4]]
    assert_same_bits((image, coverage, *kept, grads[4]), wanted)


# ---------------------------------------------------------------- many layers


def test_many_layers_of_alpha_exactly_1(mapped_session: opencl.Session) -> None:
    points = pile([1.0] * 600, list(range(600))) | {"backgrounds": torch.ones(1, 1)}
    image, coverage, *grads = all_of(recording(points))
    assert (image.item(), coverage.item()) == (0, 1)
    assert all(grad[:, 0].any() for grad in grads[2:4])
    assert not any(grad[:, 1:].any() for grad in grads[:4]) and not grads[4].any()


@pytest.mark.parametrize("opacities", [(0.6, 1.0), (0.01, 0.02), (0.0, 1.0)])
def test_a_thousand_layers(
    mapped_session: opencl.Session, dtype: torch.dtype, long_lists: None, opacities: tuple[float, float]
) -> None:
    """On every pixel, for the radii are larger than the image. The fainter, the deeper it shows."""
    arguments = crowd(1000, size=4, dtype=dtype)
    with torch.no_grad():
        arguments["radii"] += 8
        arguments["opacities"].uniform_(*opacities)
    assert_like_reference(splat, reference.splat, **arguments)


def test_a_million_points_in_one_tile(mapped_session: opencl.Session, long_lists: None) -> None:
    """4096 in each pixel, where one column of the tensors below lies, in the order of their depths."""
    depths = torch.randperm(1 << 20).float() + 1
    y, x = torch.arange(256) // 16 + 0.5, torch.arange(256) % 16 + 0.5
    opacities, features = torch.rand(1, 1 << 20) / 50, torch.randn(1, 1 << 20, 1)
    order = depths.reshape(-1, 256).argsort(dim=0)
    columns = [values.double().reshape(-1, 256).gather(0, order) for values in (opacities, features)]
    exact_o, exact_f = (column.requires_grad_() for column in columns)
    after = (1 - exact_o).cumprod(dim=0)
    truth = (exact_o * torch.cat([torch.ones(1, 256), after[:-1]]) * exact_f).sum(dim=0), 1 - after[-1]

    inputs = opacities.requires_grad_(), features.requires_grad_()
    points_uv = torch.stack([x, y], dim=-1).repeat(4096, 1)[None]
    outputs = splat(points_uv, depths[None], torch.full_like(opacities, 0.5), *inputs, 16, 16)
    weights = torch.randn(2, 256)
    grads = torch.autograd.grad(outputs, inputs, [w.reshape(1, 1, 16, 16) for w in weights])
    truths = torch.autograd.grad(truth, (exact_o, exact_f), list(weights.double()))
    for output, wanted in zip(outputs, truth, strict=True):
        assert_close(output.flatten(), wanted)
    for grad, wanted in zip(grads, truths, strict=True):
        assert_close(grad.reshape(-1, 256).gather(0, order), wanted, "gradient")


def spread(depths: str, count: int, dtype: torch.dtype) -> torch.Tensor:
    """Depths [1, count] that take a sort every way it has."""
    bits = torch.int32 if dtype == torch.float32 else torch.int64
    last_bits = (torch.ones(count, dtype=dtype).view(bits) + torch.randperm(count)).to(bits).view(dtype)
    patterns = {
        "all equal": torch.full((count,), 2),
        "two": torch.randint(1, 3, (count,)),
        "last bits": last_bits,
        "last bits, one far": torch.where(torch.arange(count) == count // 2, torch.tensor(1e30), last_bits),
        "descending": torch.arange(count, 0, -1),
        "wide": 10 ** (torch.rand(count) * 38 - 1),
    }
    return patterns[depths].to(dtype)[None]


@pytest.mark.parametrize("depths", ["all equal", "two", "last bits", "last bits, one far", "descending", "wide"])
@pytest.mark.parametrize("count", [20, 700])
def test_any_depths_in_order(mapped_session: opencl.Session, dtype: torch.dtype, depths: str, count: int) -> None:
    arguments = crowd(count, dtype=dtype) | {"z": spread(depths, count, dtype)}
    assert_like_reference(splat, reference.splat, **arguments)


# ---------------------------------------------------------------- sizes


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 50), (33, 1), (16, 16), (17, 15), (32, 64)])
def test_image_sizes(mapped_session: opencl.Session, height: int, width: int) -> None:
    arguments = scene(2, 90, 3) | {"height": height, "width": width, "backgrounds": None}
    assert_like_reference(splat, reference.splat, **arguments)


@pytest.mark.parametrize("min_transmittance", [0.0, 0.2])
def test_footprints_over_many_tiles(
    mapped_session: opencl.Session, float64: torch.dtype, min_transmittance: float
) -> None:
    """Up to 9 x 6 tiles, which takes as many launches, and lists of several segments."""
    arguments = scene(2, 60, 3, float64) | {"height": 90, "width": 130}
    with torch.no_grad():
        arguments["points_uv"] *= 3.5
        arguments["radii"] *= 12
    assert_like_reference(splat, reference.splat, **arguments, min_transmittance=min_transmittance)


def test_a_footprint_ends_where_the_distance_is_the_radius(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    """d2 < r^2, and both are exact here: of a row of pixels, a point on the first centre reaches r."""
    radii = torch.arange(1, 100, dtype=dtype)[:, None]
    ones = torch.ones_like(radii)
    points_uv = torch.full((99, 1, 2), 0.5, dtype=dtype)
    _, coverage = splat(points_uv, ones, radii, ones, ones[..., None], 1, 100)
    assert torch.equal(coverage[:, 0, 0] != 0, torch.arange(100) < radii)


@pytest.mark.parametrize("radius", [-1.0, 0.0, 1e-6, 0.5, 1e4])
def test_radii(mapped_session: opencl.Session, radius: float) -> None:
    arguments = scene(2, 90, 3)
    with torch.no_grad():
        arguments["radii"][:, ::3] = radius
        arguments["opacities"][:, ::3] *= 0.2
    assert_like_reference(splat, reference.splat, **arguments)


@pytest.mark.parametrize(
    ("radius", "u"), [(1e-45, 3.5), (1e-30, 3.5), (1e-20, 3.5), (1e18, 3.5), (1e30, 3.5), (2e20, 1e20), (2e30, -1e30)]
)
def test_radii_whose_square_is_no_float32(mapped_session: opencl.Session, radius: float, u: float) -> None:
    """They make fragments or not, but no gradient that isn't finite."""
    arguments = scene(1, 90, 3)
    with torch.no_grad():
        arguments["radii"][:, ::3] = radius
        arguments["points_uv"][:, ::3] = torch.tensor([u, 3.5])
    assert all(output.isfinite().all() for output in all_of(arguments))


@pytest.mark.parametrize("u", [1e30, -1e30, 3e38])
def test_points_far_outside_are_absent(mapped_session: opencl.Session, u: float) -> None:
    arguments = crowd(60)
    for far in ((u, 3.0), (3.0, u), (u, u), (u, -u)):
        with torch.no_grad():
            arguments["points_uv"][0, 7] = torch.tensor(far)
        assert_as_if_absent(arguments, 7)


@pytest.mark.parametrize("z", [0.0, -0.0, -1.0, 1e-40, 0.0999, -1e30])
def test_points_before_the_near_plane_are_absent(mapped_session: opencl.Session, z: float) -> None:
    arguments = crowd(60)
    arguments["z"][0, 7] = z
    assert_as_if_absent(arguments, 7)


@pytest.mark.parametrize("z", [0.1, 1e30, 3e38])
def test_depths_that_show(mapped_session: opencl.Session, dtype: torch.dtype, z: float) -> None:
    points = pile([1.0], [3.0], dtype=dtype)
    assert splat(**(points | {"z": torch.tensor([[z]], dtype=dtype)}))[0].item() == 3


# ---------------------------------------------------------------- numbers that aren't finite


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", PER_POINT)
def test_points_that_are_not_finite_are_absent(mapped_session: opencl.Session, name: str, bad: float) -> None:
    """Also where one number of several is bad, and where many points are."""
    arguments = crowd(60, channels=5)
    with torch.no_grad():
        arguments[name][0, 7].view(-1)[-1] = bad
    assert_as_if_absent(arguments, 7)
    with torch.no_grad():
        arguments[name][0, ::2] = bad
    assert all(output.isfinite().all() for output in all_of(arguments))


@pytest.mark.parametrize("layers", [64, 128, 256, 512])
def test_a_point_that_is_not_finite_behind_opaque_ones(mapped_session: opencl.Session, layers: int) -> None:
    """dL/da of the opaque one is f minus what lies behind it: that is the point after the next, at any list length."""
    faint, behind = [0.001] * (layers - 1), [0.5] * 9
    features = [*torch.randn(layers).tolist(), math.nan, *range(8)]
    points = pile([*faint, 1.0, *behind], features) | {"backgrounds": torch.ones(1, 1)}
    assert_as_if_absent(recording(points), layers)


# ---------------------------------------------------------------- opacities and truncation


def test_opacity_0_has_a_gradient(mapped_session: opencl.Session, dtype: torch.dtype) -> None:
    arguments = crowd(60, dtype=dtype)
    with torch.no_grad():
        arguments["opacities"][0, ::2] = 0
    assert_like_reference(splat, reference.splat, **arguments)
    with torch.no_grad():
        arguments["opacities"].zero_()
        arguments["radii"] += 1
    image, coverage, *grads = all_of(arguments)
    assert not coverage.any() and torch.equal(image, arguments["backgrounds"][:, :, None, None].expand_as(image))
    assert grads[2].count_nonzero() == 60 and not grads[0].any() and not grads[1].any() and not grads[3].any()


def test_opacities_outside_0_to_1_are_used_as_they_stand(mapped_session: opencl.Session) -> None:
    arguments = scene(1, 60, 3)
    with torch.no_grad():
        arguments["opacities"] *= torch.randn(1, 60)
    assert_like_reference(splat, reference.splat, **arguments)


@pytest.mark.parametrize("min_transmittance", [0.5, 0.01, 1e-4])
def test_error_of_truncation(mapped_session: opencl.Session, min_transmittance: float) -> None:
    arguments = detached(crowd(600))
    (image, coverage), (exact, covered) = splat(**arguments, min_transmittance=min_transmittance), splat(**arguments)
    contrast = (arguments["features"] - arguments["backgrounds"][:, None]).abs().max()
    assert 0 < (image - exact).abs().max() <= min_transmittance * contrast
    assert 0 < (covered - coverage).max() <= min_transmittance


# ---------------------------------------------------------------- hypothesis

#: Multiples of 1/64: float64 computes d2 and r^2 exactly, so that both sides agree where a footprint ends.
STEPS = 64
ODD = {
    "points_uv": [math.nan, math.inf, -math.inf, 1e30, -1e30],
    "z": [math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-310, 1e300],
    "radii": [math.nan, math.inf, -math.inf, 0.0, -1.0],
    "opacities": [math.nan, math.inf, -math.inf, 0.0, 1.0],
    "features": [math.nan, math.inf, -math.inf, 0.0],
}
RANGES = {"points_uv": (-8, 48), "z": (-1, 3), "radii": (0, 20), "opacities": (0, 1), "features": (-2, 2)}


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    batch, count, channels = draw(st.integers(1, 2)), draw(st.integers(0, 25)), draw(st.sampled_from([1, 3, 5]))
    last = {"points_uv": (2,), "features": (channels,)}
    values: Scene = {"height": draw(st.integers(1, 40)), "width": draw(st.integers(1, 40))}
    for name, (low, high) in RANGES.items():
        common = st.integers(low * STEPS, high * STEPS).map(lambda n: n / STEPS)
        numbers = draw(st.sampled_from([common, common, st.one_of(common, st.sampled_from(ODD[name]))]))
        shape = (batch, count, *last.get(name, ()))
        values[name] = torch.from_numpy(draw(arrays(np.float64, shape, elements=numbers, fill=st.nothing())))
    return recording(values | {"backgrounds": torch.linspace(-1, 1, batch * channels).double().reshape(batch, -1)})


@settings(
    max_examples=40,
    deadline=None,
    derandomize="CI" in os.environ,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(arguments=scenes())
def test_any_scene_like_reference(mapped_session: opencl.Session, float64: torch.dtype, arguments: Scene) -> None:
    (image, coverage), (expected_image, expected_coverage) = splat(**arguments), reference.splat(**arguments)
    inputs = [arguments[name] for name in INPUTS]
    grads = torch.autograd.grad(image.square().sum() + coverage.sum(), inputs)
    expected = torch.autograd.grad(expected_image.square().sum() + expected_coverage.sum(), inputs)
    for got, wanted in zip((image, coverage, *grads), (expected_image, expected_coverage, *expected), strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-9)
