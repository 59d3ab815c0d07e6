"""What torch and Python do with operators besides calling them: transforms, forward mode, copies, in-place changes."""

import copy
import io
import pickle
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from vestcl import opencl, reference
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import Raster, composite, rasterize, splat
from vestcl.ops.stretch import stretch
from vestcl.ops.unproject import unproject

# torch's own, where it loads its rules of forward mode
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script:DeprecationWarning")

CAMERA: Final = torch.tensor([[[4.0, 0, 2], [0, 4, 3], [0, 0, 1]]])
POINTS: Final = ("points_uv", "radii", "opacities")


def cloud() -> dict[str, torch.Tensor]:
    """20 points on 6 x 5 pixels."""
    return {
        "points_uv": torch.rand(1, 20, 2) * 6,
        "z": torch.rand(1, 20) + 1,
        "radii": torch.rand(1, 20) + 0.5,
        "opacities": torch.rand(1, 20),
        "features": torch.rand(1, 20, 3),
        "backgrounds": torch.rand(1, 3),
    }


def arguments() -> dict[str, torch.Tensor]:
    shapes = {"depth": (1, 1, 6, 5), "points_xyz": (1, 30, 3), "quaternion": (1, 4), "translation": (1, 3)}
    shapes |= {"displacement_xyz": (1, 30, 3), "gaps_uv": (1, 6, 5, 2), "magnified": (1, 6, 5)}
    return {**{name: torch.rand(shape) + 0.5 for name, shape in shapes.items()}, "K": CAMERA, **cloud()}


def splatted(a: dict[str, torch.Tensor]) -> torch.Tensor:
    return splat(*(a[n] for n in (*POINTS[:1], "z", *POINTS[1:], "features")), 6, 5, a["backgrounds"])[0]


OPERATORS: Final[dict[str, Callable[[dict[str, torch.Tensor]], Any]]] = {
    "unproject": lambda a: unproject(a["depth"], a["K"]),
    "rigid_flow": lambda a: rigid_flow(a["points_xyz"], a["quaternion"], a["translation"]),
    "displace": lambda a: displace(a["points_xyz"], a["displacement_xyz"], a["K"])[0],
    "stretch": lambda a: stretch(a["gaps_uv"], a["magnified"])[0],
    "splat": splatted,
}
#: Every tensor that an operator takes, also those that it has no gradient for: a tangent of theirs would be lost.
TAKES: Final = {
    "unproject": ("depth", "K"),
    "rigid_flow": ("points_xyz", "quaternion", "translation"),
    "displace": ("points_xyz", "displacement_xyz", "K"),
    "stretch": ("gaps_uv", "magnified"),
    "splat": ("z", *POINTS, "features", "backgrounds"),
}
EACH: Final = [(name, given) for name, takes in TAKES.items() for given in takes]


def of_one(name: str, given: str) -> tuple[Callable[[torch.Tensor], torch.Tensor], torch.Tensor]:
    values = arguments()
    return lambda value: OPERATORS[name](values | {given: value}), values[given]


@pytest.mark.parametrize(("name", "given"), EACH)
def test_transforms_are_refused(name: str, given: str) -> None:
    function, value = of_one(name, given)
    transforms: list[Callable[[], Any]] = [
        lambda: torch.func.vmap(function)(value[None]),
        lambda: torch.func.grad(lambda v: function(v).sum())(value),
        lambda: torch.func.jacrev(function)(value),
        lambda: torch.func.jvp(function, (value,), (value,)),
        lambda: torch.func.vmap(lambda scale: function(value).sum() * scale)(torch.ones(3)),
    ]
    message = r"must be used outside torch.func's transforms.* vestcl.reference"
    for transform in transforms:
        with pytest.raises(ValueError, match=rf"{message}|`z` must not require grad"):
            transform()


@pytest.mark.parametrize(("name", "given"), EACH)
def test_forward_mode_is_refused(name: str, given: str) -> None:
    function, value = of_one(name, given)
    with (
        forward_ad.dual_level(),
        pytest.raises(ValueError, match=r"must carry no forward-mode tangent .*autograd\.grad"),
    ):
        function(forward_ad.make_dual(value, torch.ones_like(value)))


@pytest.mark.parametrize(("name", "given"), [("unproject", "depth"), *EACH[2:7], *EACH[-2:]])
def test_forward_mode_over_a_backward_is_refused(name: str, given: str) -> None:
    function, value = of_one(name, given)
    value.requires_grad_()
    output = function(value)
    with forward_ad.dual_level(), pytest.raises(ValueError, match=r"`grad_.*` must carry no forward-mode tangent"):
        torch.autograd.grad(output, value, forward_ad.make_dual(torch.ones_like(output), torch.ones_like(output)))


@pytest.mark.parametrize(("name", "given"), [("unproject", "depth"), ("rigid_flow", "quaternion"), ("splat", "radii")])
def test_vectorised_jacobians_are_refused(name: str, given: str) -> None:
    function, value = of_one(name, given)
    with pytest.raises(ValueError, match=r"`grad_.*` must be used outside .* vectorised Jacobians"):
        torch.autograd.functional.jacobian(function, value, vectorize=True)
    assert torch.autograd.functional.jacobian(lambda v: function(v).sum(), value).shape == value.shape


def test_tracing_is_refused() -> None:
    from torch._subclasses.fake_tensor import FakeTensorMode

    with FakeTensorMode():
        fake = torch.ones(1, 1, 2, 2)
    with pytest.raises(ValueError, match=r"`depth` must be used outside .* tracing"):
        unproject(fake, CAMERA)


def test_functional_call(session: opencl.Session) -> None:
    class Scene(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.features = torch.nn.Parameter(values["features"])

        def forward(self) -> torch.Tensor:
            return splatted(values | {"features": self.features})

    values = cloud()
    module = Scene()
    called = torch.func.functional_call(module, {"features": values["features"] + 1}, ())
    assert torch.equal(called, splatted(values | {"features": values["features"] + 1}))


def raster_of(values: dict[str, torch.Tensor]) -> Raster[torch.Tensor]:
    return rasterize(*(values[name] for name in ("points_uv", "z", "radii", "opacities")), 6, 5)


@pytest.mark.parametrize(
    "duplicate",
    [copy.deepcopy, pickle.dumps, lambda raster: torch.save(raster, io.BytesIO()), lambda r: copy.deepcopy({"r": [r]})],
    ids=["deepcopy", "pickle", "torch.save", "inside"],
)
def test_a_raster_is_not_duplicated(session: opencl.Session, duplicate: Callable[[Any], Any]) -> None:
    with pytest.raises(TypeError, match=r"a Raster can't be deep-copied or pickled.* call vestcl.rasterize again"):
        duplicate(raster_of(cloud()))


def test_a_shallow_copy_of_a_raster_is_the_raster(session: opencl.Session) -> None:
    values = cloud()
    raster = raster_of(values)
    wanted = composite(raster, values["features"])
    for one, other in zip(composite(copy.copy(raster), values["features"]), wanted, strict=True):
        assert torch.equal(one, other)


def set_row(output: torch.Tensor) -> torch.Tensor:
    output[0, 0, 1] = 0.5
    return output


def add(output: torch.Tensor) -> torch.Tensor:
    output += 1
    return output


#: In place, and the same out of place.
CHANGES: Final[dict[str, tuple[Callable[[torch.Tensor], Any], Callable[[torch.Tensor], torch.Tensor]]]] = {
    "clamp_": (lambda x: x.clamp_(0.2, 0.6), lambda x: x.clamp(0.2, 0.6)),
    "+=": (add, lambda x: x + 1),
    "[...] =": (set_row, lambda x: set_row(x.clone())),
    "exp_": (lambda x: x.exp_(), lambda x: x.exp()),
    "zero_ of a view": (lambda x: x.transpose(2, 3).zero_(), lambda x: x * 0),
    "copy_": (lambda x: x.copy_(torch.ones_like(x)), lambda x: torch.ones_like(x) + x * 0),
}


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("change", CHANGES)
def test_outputs_of_splat_change_in_place(mapped_session: opencl.Session, change: str, which: int) -> None:
    """Image, coverage or both: the right values and the right gradients."""
    in_place, out_of_place = CHANGES[change]
    values = cloud()
    leaves = {name: values[name].requires_grad_() for name in (*POINTS, "features", "backgrounds")}

    def grads(function: Callable[[torch.Tensor], Any], returns: bool) -> list[torch.Tensor]:
        outputs = list(splat(**values, height=6, width=5))
        for index in (which,) if which < 2 else (0, 1):
            changed = function(outputs[index])
            outputs[index] = changed if returns else outputs[index]
        loss = sum((output * torch.linspace(0, 1, output.numel()).reshape(output.shape)).sum() for output in outputs)
        return [*(output.detach() for output in outputs), *torch.autograd.grad(loss, list(leaves.values()))]

    for got, wanted in zip(grads(in_place, False), grads(out_of_place, True), strict=True):
        assert torch.equal(got, wanted)


@pytest.mark.parametrize("name", ["unproject", "rigid_flow", "displace"])
def test_other_outputs_change_in_place(session: opencl.Session, name: str) -> None:
    function, value = of_one(name, TAKES[name][0])
    value.requires_grad_()
    got, wanted = (
        torch.autograd.grad(change(function(value)).square().sum(), value)[0]
        for change in (lambda x: x.clamp_(max=1), lambda x: x.clamp(max=1))
    )
    assert torch.equal(got, wanted)


def test_numpy_outputs_change_in_place(session: opencl.Session) -> None:
    arrays = {name: value.numpy() for name, value in cloud().items()}
    image, coverage = splat(**arrays, height=6, width=5)
    image += 1
    again = splat(**arrays, height=6, width=5)
    assert np.array_equal(image, again[0] + 1) and np.array_equal(coverage, again[1])


@pytest.mark.parametrize("name", POINTS)
def test_a_geometry_that_was_changed_in_place_is_refused(session: opencl.Session, name: str) -> None:
    """The raster shows the old numbers: sent on through the new ones, its gradient would be another's."""
    values = cloud()
    leaf = values[name].requires_grad_()
    values[name] = leaf * 1
    raster = raster_of(values)
    values[name].mul_(2)
    with pytest.raises(ValueError, match=rf"`raster.{name}` must be what `rasterize` got, got it changed in place"):
        composite(raster, values["features"])
    with torch.no_grad():
        composite(raster, values["features"])


def test_a_geometry_that_changes_without_a_graph_keeps_its_gradient(session: opencl.Session) -> None:
    values = cloud()
    leaves = [values[name].requires_grad_() for name in POINTS]
    truth = torch.autograd.grad(reference.splat(**values, height=6, width=5)[0].sum(), leaves)
    raster = raster_of(values)
    with torch.no_grad():
        for leaf in leaves:
            leaf.mul_(3)
    grads = torch.autograd.grad(composite(raster, values["features"], values["backgrounds"])[0].sum(), leaves)
    torch.testing.assert_close(grads, truth)
