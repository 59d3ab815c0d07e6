"""torch.compile around operators: a graph break and the eager result, forward and backward."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import torch

from vestcl import opencl
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import composite, rasterize, skipped, splat
from vestcl.ops.stretch import stretch
from vestcl.ops.unproject import unproject

# torch's own, where it looks at a tensor that is not a leaf
pytestmark = pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")

Values = dict[str, torch.Tensor]
CAMERA: Final = torch.tensor([[[4.0, 0, 2], [0, 4, 3], [0, 0, 1]]])


def values(height: int = 6, width: int = 5) -> Values:
    count = height * width
    shapes: dict[str, tuple[int, ...]] = {
        "depth": (1, 1, height, width), "points_xyz": (1, count, 3), "displacement_xyz": (1, count, 3),
        "quaternion": (1, 4), "translation": (1, 3), "points_uv": (1, count, 2), "magnified": (1, height, width),
        "radii": (1, count), "opacities": (1, count), "features": (1, count, 3), "backgrounds": (1, 3),
    }  # fmt: skip
    return {name: torch.rand(shape) + 0.5 for name, shape in shapes.items()}


def all_outputs(v: Values) -> tuple[torch.Tensor, ...]:
    """Every operator, mixed with what is compiled, and an in-place change."""
    height, width = v["depth"].shape[2:]
    points_xyz = unproject(1.5 * v["depth"], CAMERA)
    displacement_xyz = rigid_flow(points_xyz, v["quaternion"], 2 * v["translation"])
    points_uv, z = displace(points_xyz, displacement_xyz + v["displacement_xyz"], CAMERA)
    factor, torn = stretch(points_uv.reshape(1, height, width, 2), v["magnified"])
    radii = v["radii"] * factor.flatten(1)
    raster = rasterize(points_uv, z.detach(), radii, v["opacities"], height, width)
    image, coverage = composite(raster, v["features"] * 2, v["backgrounds"])
    image.clamp_(0.1, 2)
    other, _ = splat(points_uv, z.detach(), radii + 1, v["opacities"], v["features"], height, width)
    return image * other + coverage, other.relu() * skipped(raster).points, torn


OPERATORS: Final[dict[str, Callable[[Values], Any]]] = {
    "unproject": lambda v: unproject(2 * v["depth"], CAMERA) + 1,
    "rigid_flow": lambda v: rigid_flow(v["points_xyz"] * 2, v["quaternion"], v["translation"]) + 1,
    "displace": lambda v: displace(v["points_xyz"] * 2, v["displacement_xyz"], CAMERA),
    "stretch": lambda v: stretch(v["points_uv"].reshape(1, 6, 5, 2) * 2, v["magnified"]),
    "rasterize": lambda v: composite(
        rasterize(v["points_uv"] * 4, v["radii"].detach(), v["radii"], v["opacities"], 6, 5), v["features"] * 2
    ),
    "splat": lambda v: splat(
        v["points_uv"] * 4, v["radii"].detach(), v["radii"], v["opacities"], v["features"], 6, 5, v["backgrounds"]
    ),
}


def results(function: Callable[[Values], Any], inputs: Values) -> list[torch.Tensor]:
    """Outputs, and gradients of all that they depend on."""
    given = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    outputs = function(given)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    recorded = [output for output in outputs if output.requires_grad]
    if recorded:
        torch.autograd.backward(recorded, [torch.linspace(-1, 1, o.numel()).reshape(o.shape) for o in recorded])
    return [*(o.detach() for o in outputs), *(value.grad for value in given.values() if value.grad is not None)]


def assert_same(got: list[torch.Tensor], wanted: list[torch.Tensor]) -> None:
    for one, other in zip(got, wanted, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", OPERATORS)
def test_graph_break_and_the_eager_result(session: opencl.Session, name: str) -> None:
    torch._dynamo.reset()
    inputs = values()
    assert_same(results(torch.compile(OPERATORS[name], backend="eager"), inputs), results(OPERATORS[name], inputs))
    with pytest.raises(torch._dynamo.exc.Unsupported, match="OpenCL kernels outside the graph: leave out fullgraph"):
        torch.compile(OPERATORS[name], backend="eager", fullgraph=True)(inputs)


def test_all_operators_at_two_sizes(session: opencl.Session) -> None:
    torch._dynamo.reset()
    compiled = torch.compile(all_outputs, backend="aot_eager")
    for height in (5, 7):
        inputs = values(height)
        assert_same(results(compiled, inputs), results(all_outputs, inputs))


def test_a_compiled_training_step(session: opencl.Session) -> None:
    """Backward called inside: the compiler meets the operators' backward, too."""
    torch._dynamo.reset()

    def step(v: Values) -> torch.Tensor:
        loss = sum((output**2).sum() for output in all_outputs(v)[:2])
        loss.backward()
        return loss.detach()

    inputs = values()
    assert_same(results(torch.compile(step, backend="eager"), inputs), results(step, inputs))


def test_a_new_shape_recompiles_no_operator(session: opencl.Session) -> None:
    """Frames of vestcl are not compiled at all: they would be, for each shape, up to the compiler's limit."""
    torch._dynamo.reset()
    compiled = torch.compile(lambda v: unproject(v["depth"] * 2, CAMERA) * 2, backend="eager", dynamic=True)
    frames = []
    for width in range(2, 8):
        compiled(values(4, width))
        frames.append(torch._dynamo.utils.counters["frames"]["total"])
    assert frames[1:] == frames[1:2] * 5


def test_numpy_arrays(session: opencl.Session) -> None:
    torch._dynamo.reset()
    arrays = values()["depth"].numpy(), CAMERA.numpy()
    compiled = torch.compile(lambda depth, K: unproject(depth * 2, K) + 1, backend="eager")
    got = compiled(*arrays)
    assert isinstance(got, np.ndarray) and np.array_equal(got, unproject(arrays[0] * 2, arrays[1]) + 1)


def test_an_operator_does_not_import_the_compiler() -> None:
    code = (
        "import sys, torch, vestcl\n"
        "vestcl.unproject(torch.ones(1, 1, 2, 2), torch.eye(3)[None])\n"
        "assert 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
