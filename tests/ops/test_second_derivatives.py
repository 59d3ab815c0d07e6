"""Derivatives of the operators' gradients: true, or refused, never dropped in silence."""

import gc
import itertools
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Final

import pytest
import torch
from torch.autograd import gradgradcheck

from vestcl import opencl, reference
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import composite, rasterize, splat
from vestcl.ops.unproject import unproject

Inputs = dict[str, torch.Tensor]
K: Final = torch.tensor([[[5.0, 0, 2], [0, 6, 1.5], [0, 0, 1]]], dtype=torch.float64)
TGT_FROM_SRC: Final = torch.tensor([[[0.8, 0, -0.6, 0.1], [0, 1, 0, 0.2], [0.6, 0, 0.8, 0.3], [0, 0, 0, 1]]]).double()

#: Operators with all derivatives, as functions of what they are differentiable in.
SMOOTH: Final[dict[str, Callable[..., Any]]] = {
    "unproject": lambda depth: unproject(depth, K.to(depth)),
    "rigid_flow": rigid_flow,
    "displace": lambda points_xyz, displacement_xyz: displace(
        points_xyz, displacement_xyz, K.to(points_xyz), TGT_FROM_SRC.to(points_xyz)
    ),
}
REFERENCES: Final[dict[str, Callable[..., Any]]] = {
    "unproject": lambda depth: reference.unproject(depth, K),
    "rigid_flow": reference.rigid_flow,
    "displace": lambda points_xyz, displacement_xyz: reference.displace(points_xyz, displacement_xyz, K, TGT_FROM_SRC),
}
SHAPES: Final = {
    "unproject": {"depth": (1, 1, 2, 3)},
    "rigid_flow": {"points_xyz": (2, 3, 3), "quaternion": (2, 4), "translation": (2, 3)},
    "displace": {"points_xyz": (1, 3, 3), "displacement_xyz": (1, 3, 3)},
}
SPLAT: Final = ("points_uv", "radii", "opacities", "features", "backgrounds")
LOSSES: Final[dict[str, Callable[[torch.Tensor], torch.Tensor]]] = {"linear": lambda x: 2 * x, "cubic": lambda x: x**3}
NO_SECOND: Final = r"vestcl\.splat has no second derivatives: .* use vestcl\.reference\.splat"


def chosen(names: Sequence[str]) -> list[tuple[str, ...]]:
    """Every choice of one or more."""
    return [choice for n in range(1, len(names) + 1) for choice in itertools.combinations(names, n)]


def values(name: str, asked: Sequence[str]) -> Inputs:
    inputs = {key: torch.rand(shape, dtype=torch.float64) + 0.5 for key, shape in SHAPES[name].items()}
    return {key: value.requires_grad_(key in asked) for key, value in inputs.items()}


def outputs(function: Callable[..., Any], loss: Callable[[torch.Tensor], torch.Tensor], *inputs: Any) -> Any:
    result = function(*inputs)
    return tuple(map(loss, result if isinstance(result, tuple) else (result,)))


def scene(asked: Sequence[str], dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    inputs = {
        "points_uv": torch.rand(1, 6, 2, dtype=dtype) * 5,
        "radii": torch.rand(1, 6, dtype=dtype) + 1,
        "opacities": torch.rand(1, 6, dtype=dtype),
        "features": torch.randn(1, 6, 2, dtype=dtype),
        "backgrounds": torch.randn(1, 2, dtype=dtype),
    }
    inputs = {key: value.requires_grad_(key in asked) for key, value in inputs.items()}
    return {**inputs, "z": torch.rand(1, 6, dtype=dtype) + 1, "height": 5, "width": 4}


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("name", "asked"), [(name, asked) for name in SMOOTH for asked in chosen(list(SHAPES[name]))])
def test_gradgradcheck(
    session: opencl.Session, float64: torch.dtype, name: str, asked: tuple[str, ...], loss: str
) -> None:
    inputs = tuple(values(name, asked).values())
    assert gradgradcheck(lambda *given: outputs(SMOOTH[name], LOSSES[loss], *given), inputs)


@pytest.mark.parametrize("name", SMOOTH)
def test_third_derivatives_are_the_references(session: opencl.Session, float64: torch.dtype, name: str) -> None:
    inputs = values(name, list(SHAPES[name]))

    def third(function: Callable[..., Any]) -> list[torch.Tensor]:
        result = outputs(function, LOSSES["cubic"], *inputs.values())
        derivative = sum(output.sum() for output in result)
        for _ in range(2):
            grads = torch.autograd.grad(derivative, list(inputs.values()), create_graph=True)
            derivative = sum((grad**2).sum() for grad in grads)
        return list(torch.autograd.grad(derivative, list(inputs.values())))

    torch.testing.assert_close(third(SMOOTH[name]), third(REFERENCES[name]), rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", SMOOTH)
def test_a_graph_of_the_gradients_does_not_change_them(
    mapped_session: opencl.Session, dtype: torch.dtype, name: str
) -> None:
    """They are the kernels' with ``create_graph=True``, too, and each can be changed in place."""
    inputs = [value.detach().to(dtype).requires_grad_() for value in values(name, list(SHAPES[name])).values()]
    result = outputs(SMOOTH[name], LOSSES["cubic"], *inputs)
    weights = [torch.randn_like(output) for output in result]
    plain = torch.autograd.grad(result, inputs, weights, retain_graph=True)
    graphed = torch.autograd.grad(result, inputs, weights, create_graph=True)
    for one, other in zip(plain, graphed, strict=True):
        assert torch.equal(one, other) and other.requires_grad and not one.requires_grad
        other.mul_(2)
        assert torch.equal(2 * one, other)


def test_one_tensor_twice(session: opencl.Session, float64: torch.dtype) -> None:
    both = torch.rand(1, 3, 3, dtype=float64, requires_grad=True)
    assert gradgradcheck(lambda x: displace(x, x, K), (both,))


def test_second_derivative_where_uv_is_not_finite(session: opencl.Session, float64: torch.dtype) -> None:
    points = torch.tensor([[[1.0, 2, 0], [1, 2, 3], [torch.nan, 1, 2], [torch.inf, 1, 2]]], dtype=float64)
    points = points.requires_grad_()
    points_uv, _ = displace(points, torch.zeros_like(points), torch.eye(3, dtype=float64)[None])
    (grad,) = torch.autograd.grad((points_uv[0, 1] ** 2).sum(), points, create_graph=True)
    (second,) = torch.autograd.grad(grad.sum(), points)
    assert second[0, 1].all() and not second[0, [0, 2, 3]].any()


def test_second_derivative_at_a_quaternion_of_zeros(session: opencl.Session, float64: torch.dtype) -> None:
    """R - I = (2e16) (w [v]x + [v]x [v]x) there, so that d2u / dx^2 of p = (0, 1, 0) is (0, -4e16, 0)."""
    quaternion = torch.zeros(1, 4, dtype=float64, requires_grad=True)
    point = torch.tensor([[[0.0, 1, 0]]], dtype=float64)
    u_y = rigid_flow(point, quaternion, torch.zeros(1, 3, dtype=float64))[0, 0, 1]
    (grad,) = torch.autograd.grad(u_y, quaternion, create_graph=True)
    (second,) = torch.autograd.grad(grad[0, 1], quaternion)
    torch.testing.assert_close(second, torch.tensor([[0, -4e16, 0, 0]], dtype=float64))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("asked", [(name,) for name in SPLAT] + [SPLAT])
def test_splat_refuses_second_derivatives(mapped_session: opencl.Session, asked: tuple[str, ...], loss: str) -> None:
    """By whatever way they would be reached: also where another path to the input would hide that one is missing."""
    arguments = scene(asked, torch.float32)
    inputs = [arguments[name] for name in asked]
    image, coverage = splat(**arguments)
    total = LOSSES[loss](image).sum() + LOSSES[loss](coverage).sum()
    grads = torch.autograd.grad(total, inputs, create_graph=True)
    plain = torch.autograd.grad(total, inputs)
    for name, grad, value in zip(asked, grads, plain, strict=True):
        assert torch.equal(grad, value), f"grad_{name} with and without a graph"
    for grad in grads:
        for target in inputs:
            with pytest.raises(NotImplementedError, match=NO_SECOND):
                torch.autograd.grad(grad.sum() + target.sum(), target, allow_unused=True, retain_graph=True)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("name", SPLAT)
def test_splat_fails_gradgradcheck_by_that_error(
    session: opencl.Session, float64: torch.dtype, name: str, loss: str
) -> None:
    arguments = scene([name])
    with pytest.raises(NotImplementedError, match=NO_SECOND):
        gradgradcheck(
            lambda value: outputs(lambda v: splat(**(arguments | {name: v})), LOSSES[loss], value), (arguments[name],)
        )


def test_derivatives_of_one_gradient_to_other_inputs_are_refused(session: opencl.Session) -> None:
    """Gradients of the features only, and then those of the points they depend on; and through the loss's weights."""
    arguments = scene(["points_uv", "features"], torch.float32)
    weights = torch.rand(1, 2, 5, 4, requires_grad=True)
    loss = (splat(**arguments)[0] * weights).sum()
    (grad,) = torch.autograd.grad(loss, arguments["features"], create_graph=True)
    for target in (arguments["points_uv"], weights):
        with pytest.raises(NotImplementedError, match=NO_SECOND):
            torch.autograd.grad(grad.sum(), target, retain_graph=True)


def test_points_changed_in_place_lead_to_the_refusal(session: opencl.Session) -> None:
    """The gradient belongs to the graph that there was when the geometry was composited."""
    arguments = scene(["points_uv"], torch.float32)
    points_uv = arguments["points_uv"] * 1
    image, _ = splat(**(arguments | {"points_uv": points_uv}))
    points_uv.zero_()
    (grad,) = torch.autograd.grad(image.sum(), arguments["points_uv"], create_graph=True)
    with pytest.raises(NotImplementedError, match=NO_SECOND):
        torch.autograd.grad(grad.sum() + arguments["points_uv"].sum(), arguments["points_uv"])


def test_a_graph_of_splats_gradients_is_freed_with_them(session: opencl.Session) -> None:
    arguments = scene(["features"], torch.float32)
    geometry = ("points_uv", "z", "radii", "opacities", "height", "width")
    raster = rasterize(**{name: arguments[name] for name in geometry})
    image = composite(raster, arguments["features"])[0]
    (grad,) = torch.autograd.grad(image.sum(), arguments["features"], create_graph=True)
    kept = weakref.ref(raster)
    gc.disable()  # what a cycle holds would stay
    try:
        del raster, image
        with_graph = kept() is not None
        del grad
        without = kept() is not None
    finally:
        gc.enable()
    assert (with_graph, without) == (True, False)
