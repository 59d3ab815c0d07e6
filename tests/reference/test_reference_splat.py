"""vestcl.reference.splat, the specification of the splatter, on cases computed by hand and by plain loops."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from vestcl.reference import splat

Cloud = dict[str, torch.Tensor]
DIFFERENTIABLE = ("points_uv", "radii", "opacities", "features", "backgrounds")


def cloud(uv: list[list[float]], z: list[float], r: list[float], o: list[float], f: list[list[float]]) -> Cloud:
    """One cloud [1, N, ...] in float64."""
    values = {"points_uv": uv, "z": z, "radii": r, "opacities": o, "features": f}
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def random_clouds(batch: int, count: int, channels: int) -> Cloud:
    """Points on and around an image of 6 x 8, a third of them opaque, some at equal depth, some behind the camera."""
    kinds = {"dtype": torch.float64}
    opacities = torch.rand(batch, count, **kinds)
    return {
        "points_uv": torch.rand(batch, count, 2, **kinds) * torch.tensor([12, 10]) - 2,
        "z": torch.randint(-1, 6, (batch, count)).double(),
        "radii": torch.rand(batch, count, **kinds) * 3 + 0.2,
        "opacities": torch.where(torch.rand(batch, count) < 1 / 3, 1, opacities),
        "features": torch.randn(batch, count, channels, **kinds),
        "backgrounds": torch.randn(batch, channels, **kinds),
    }


def by_loops(
    points_uv: torch.Tensor,
    z: torch.Tensor,
    radii: torch.Tensor,
    opacities: torch.Tensor,
    features: torch.Tensor,
    backgrounds: torch.Tensor,
    y: int,
    x: int,
    min_transmittance: float,
) -> tuple[torch.Tensor, float]:
    """The formula, one cloud, one pixel, fragment after fragment: colour [C] and coverage."""
    colour, t = torch.zeros_like(backgrounds), 1.0
    for i in sorted(range(len(z)), key=lambda i: (float(z[i]), i)):
        d2 = (x + 0.5 - float(points_uv[i, 0])) ** 2 + (y + 0.5 - float(points_uv[i, 1])) ** 2
        if d2 < float(radii[i]) ** 2 and float(z[i]) >= 0.1:
            if t < min_transmittance:
                break
            alpha = float(opacities[i]) * (1 - d2 / float(radii[i]) ** 2)
            colour = colour + alpha * t * features[i]
            t *= 1 - alpha
    return colour + t * backgrounds, 1 - t


def test_oracle() -> None:
    """o = 1, r = 1.5: 1 at the own pixel, 5/9 at the 4-neighbours, 1/9 at the diagonals, nothing further out."""
    image, coverage = splat(**cloud([[2.5, 2.5]], [1], [1.5], [1], [[2]]), height=5, width=5)
    wanted = torch.zeros(5, 5, dtype=torch.float64)
    wanted[1:4, 1:4] = torch.tensor([[1, 5, 1], [5, 9, 5], [1, 5, 1]]) / 9
    torch.testing.assert_close(coverage[0, 0], wanted)
    torch.testing.assert_close(image[0, 0], 2 * wanted)


def test_two_layers_by_hand() -> None:
    """The far one comes first in memory. Own pixel: a = 0.5 in front of 0.8; right neighbour: 5/18 in front of 4/9."""
    points = cloud([[0.5, 0.5], [0.5, 0.5]], [4, 2], [1.5, 1.5], [0.8, 0.5], [[10], [20]])
    image, coverage = splat(**points, height=1, width=2, backgrounds=torch.tensor([[100.0]]).double())
    near, far = 5 / 18, 4 / 9
    right = near * 20 + (1 - near) * (far * 10 + (1 - far) * 100)
    assert image[0, 0, 0].tolist() == pytest.approx([0.5 * 20 + 0.5 * (0.8 * 10 + 0.2 * 100), right])
    assert coverage[0, 0, 0].tolist() == pytest.approx([0.9, 1 - (1 - near) * (1 - far)])


def test_gradients_by_hand_behind_an_opaque_point() -> None:
    """dL/da_1 = f_1 - f_2 and dL/da_2 = 0, for two opaque points on one pixel: 1 - a = 0 divides nothing."""
    points = cloud([[0.5, 0.5], [0.5, 0.5]], [1, 2], [1, 1], [1, 1], [[3], [5]])
    opacities = points["opacities"].requires_grad_()
    splat(**points, height=1, width=1)[0].sum().backward()
    assert opacities.grad is not None and opacities.grad.tolist() == [[3 - 5, 0]]


@pytest.mark.parametrize("min_transmittance", [0.0, 0.05, 0.4])
def test_like_plain_loops(min_transmittance: float) -> None:
    clouds = random_clouds(2, 40, 3)
    image, coverage = splat(**clouds, height=6, width=8, min_transmittance=min_transmittance)
    assert image.shape == (2, 3, 6, 8) and coverage.shape == (2, 1, 6, 8)
    for b in range(2):
        one = {name: value[b] for name, value in clouds.items()}
        for y in range(6):
            for x in range(8):
                colour, covered = by_loops(**one, y=y, x=x, min_transmittance=min_transmittance)
                torch.testing.assert_close(image[b, :, y, x], colour)
                assert float(coverage[b, 0, y, x]) == pytest.approx(covered, abs=1e-12)


@pytest.mark.parametrize("min_transmittance", [0.0, 0.4])
def test_gradcheck(min_transmittance: float) -> None:
    clouds = random_clouds(2, 12, 2)
    inputs = tuple(clouds[name].requires_grad_() for name in DIFFERENTIABLE)

    def outputs(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        changed = dict(zip(DIFFERENTIABLE, values, strict=True))
        return splat(**(clouds | changed), height=6, width=8, min_transmittance=min_transmittance)

    assert gradcheck(outputs, inputs)


def test_gradcheck_on_a_pile_of_opaque_points() -> None:
    """Every point on the pixel's centre with alpha exactly 1 and the same depth."""
    clouds = random_clouds(1, 5, 2)
    opacities, features = torch.ones(1, 5).double().requires_grad_(), clouds["features"].requires_grad_()
    pile = {"points_uv": torch.full((1, 5, 2), 0.5).double(), "z": torch.ones(1, 5), "radii": torch.ones(1, 5).double()}
    assert gradcheck(lambda o, f: splat(**pile, opacities=o, features=f, height=1, width=1), (opacities, features))


def test_min_transmittance_by_hand() -> None:
    """T is 1, 0.5, 0.25, ...: with 0.5 two points are taken, for 0.5 is not below 0.5; with 0.6 one."""
    points = cloud([[0.5, 0.5]] * 4, [1, 2, 3, 4], [1] * 4, [0.5] * 4, [[1], [10], [100], [1000]])
    for limit, wanted, covered in [(0.0, 78.0, 0.9375), (0.5, 3.0, 0.75), (0.6, 0.5, 0.5), (1.0, 0.5, 0.5)]:
        image, coverage = splat(**points, height=1, width=1, min_transmittance=limit)
        assert (image.item(), coverage.item()) == (pytest.approx(wanted), covered)


def test_equal_depths_are_composited_by_index() -> None:
    points = cloud([[0.5, 0.5]] * 3, [1, 1, 1], [1] * 3, [1] * 3, [[1], [2], [3]])
    assert splat(**points, height=1, width=1)[0].item() == 1


def test_order_in_memory_is_irrelevant_at_distinct_depths() -> None:
    clouds = random_clouds(1, 40, 3)
    clouds["z"] = torch.rand(1, 40) + 1
    order = torch.randperm(40)
    shuffled = {name: value if name == "backgrounds" else value[:, order] for name, value in clouds.items()}
    torch.testing.assert_close(splat(**clouds, height=6, width=8), splat(**shuffled, height=6, width=8))


@pytest.mark.parametrize("name", ["points_uv", "z", "radii", "opacities", "features"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_points_that_are_not_finite_are_skipped(name: str, bad: float) -> None:
    clouds = random_clouds(1, 20, 3)
    clouds[name][0, 7] = bad
    without = {key: v if key == "backgrounds" else torch.cat([v[:, :7], v[:, 8:]], dim=1) for key, v in clouds.items()}
    inputs = [clouds[key].requires_grad_() for key in DIFFERENTIABLE]
    image, coverage = splat(**clouds, height=6, width=8)
    torch.testing.assert_close((image, coverage), splat(**without, height=6, width=8), rtol=0, atol=0)
    for key, grad in zip(DIFFERENTIABLE, torch.autograd.grad(image.sum() + coverage.sum(), inputs), strict=True):
        assert grad.isfinite().all()
        assert key == "backgrounds" or not grad[0, 7].any()


@pytest.mark.parametrize(("z", "visible"), [(0.1, True), (0.0999, False), (0.0, False), (-1.0, False)])
def test_near_plane(z: float, visible: bool) -> None:
    _, coverage = splat(**cloud([[0.5, 0.5]], [z], [1], [1], [[1]]), height=1, width=1)
    assert coverage.item() == visible


def test_radius_larger_than_the_image_and_no_radius() -> None:
    _, coverage = splat(**cloud([[-50.0, 2]], [1], [1000], [1], [[1]]), height=3, width=4)
    d2 = (torch.arange(4) + 50.5) ** 2 + ((torch.arange(3) - 1.5) ** 2)[:, None]
    torch.testing.assert_close(coverage[0, 0], (1 - d2 / 1000**2).double())
    assert not splat(**cloud([[0.5, 0.5]] * 2, [1, 1], [0, -1], [1, 1], [[1]] * 2), height=1, width=1)[1].any()


@pytest.mark.parametrize("empty", ["no clouds", "no points", "all behind the camera"])
def test_nothing_to_draw(empty: str) -> None:
    clouds = random_clouds(2, 5, 3)
    if empty == "no clouds":
        clouds = {name: value[:0] for name, value in clouds.items()}
    elif empty == "no points":
        clouds = {name: value if name == "backgrounds" else value[:, :0] for name, value in clouds.items()}
    else:
        clouds["z"] = -clouds["z"].abs()
    inputs = [clouds[name].requires_grad_() for name in DIFFERENTIABLE]
    image, coverage = splat(**clouds, height=6, width=8)
    assert torch.equal(image, clouds["backgrounds"][:, :, None, None].expand(-1, 3, 6, 8))
    assert coverage.shape == (len(image), 1, 6, 8) and not coverage.any()
    if empty != "no clouds":
        assert not any(grad.any() for grad in torch.autograd.grad(image.sum(), inputs)[:-1])


def test_packed_clouds_are_the_same_clouds() -> None:
    clouds = random_clouds(3, 10, 2)
    image, coverage = splat(**clouds, height=6, width=8)
    packed = {name: value if name == "backgrounds" else value.flatten(0, 1) for name, value in clouds.items()}
    starts = torch.tensor([0, 10, 20, 30])
    torch.testing.assert_close(splat(**packed, height=6, width=8, cloud_starts=starts), (image, coverage))

    _, empty_first = splat(**packed, height=6, width=8, cloud_starts=torch.tensor([0, 0, 10, 30]))
    assert not empty_first[0].any()
    torch.testing.assert_close(empty_first[1], coverage[0])


def test_no_gradient_to_z() -> None:
    clouds = random_clouds(1, 10, 2)
    z, features = clouds["z"].requires_grad_(), clouds["features"].requires_grad_()
    splat(**clouds, height=6, width=8)[0].sum().backward()
    assert z.grad is None and features.grad is not None
