"""The forecaster, further on: what is encoded, what comes back in, what is composed."""

from typing import Any

import pytest
import torch
from forecaster_scenes import ABLATIONS, SHARP, TINY, camera, drive, frame, pair_of, plain, push, stir, wall
from torch.nn import functional

from vestcl import geometry
from vestcl.constants import SKY_DEPTH
from vestcl.models.forecaster import Forecaster
from vestcl.models.steps.clouds import Cloud, advance
from vestcl.models.steps.perceive import perceive_forecast
from vestcl.scene.layers import LayerBatch

# ---------------------------------------------------------------- further on


def count_encoded(model: Forecaster) -> list[int]:
    """Images that the encoder is given, call by call."""
    sizes: list[int] = []
    model.encoder.register_forward_hook(lambda _module, _inputs, output: sizes.append(len(output)))
    return sizes


@pytest.mark.parametrize("foreground", [False, True])
def test_each_frame_is_encoded_once(foreground: bool) -> None:
    model, K = Forecaster(TINY).eval(), camera(2, 32, 48)
    pair = pair_of(2, 32, 48, foreground)
    sizes = count_encoded(model)
    with torch.no_grad():
        model.forecast(*pair, K, steps=3, perceive=lambda i, d, m: plain(i, d, torch.ones_like(m)))
    assert sizes == [4 if foreground else 2] * 2 + [2, 2]
    sizes.clear()
    with torch.no_grad():
        model.forecast(*pair, K, steps=3, mode="compose")
    assert len(sizes) == 2


def test_only_backgrounds_behind_foreground_are_encoded() -> None:
    model, mixed = Forecaster(TINY), frame(2, 32, 48)
    mixed.mask[0] = 1
    sizes = count_encoded(model)
    encoded = model.encode(mixed)
    assert sizes == [3]
    assert torch.equal(encoded.background_features[0], encoded.features[0])
    assert torch.allclose(encoded.background_grid[1], model.encoder(mixed.background_image)[1], atol=1e-5)


def test_the_forecast_frame_comes_back_in() -> None:
    """A wall that comes 2 m nearer a step: its depth is what the next step is given."""
    model, seen = drive(Forecaster(SHARP), prev=(0, 0, -4.0), cur=(0, 0, -2.0)).eval(), []

    def perceive(image: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> LayerBatch:
        seen.append((image, depth, mask))
        return plain(image, depth, mask)

    with torch.no_grad():
        steps = model.forecast(wall(32, 48, 12.0), wall(32, 48, 10.0), camera(1, 32, 48), steps=3, perceive=perceive)
    assert len(steps) == 3 and len(seen) == 2
    for (image, depth, mask), step, metres in zip(seen, steps, (8.0, 6.0), strict=False):
        assert torch.equal(image, step.views[0].image) and not image.requires_grad
        assert torch.allclose(depth, torch.tensor(metres), rtol=1e-3) and mask.min() == 1
    assert [round(step.future_from_cur[0, 2, 3].item(), 4) for step in steps] == [-2, -4, -6]


def test_foreground_stays_foreground() -> None:
    model, masks = Forecaster(SHARP).eval(), []
    cur = frame(1, 32, 48)
    cur.depth[cur.mask == 0] = 4.0

    def perceive(image: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor) -> LayerBatch:
        masks.append(mask)
        return plain(image, depth, mask)

    with torch.no_grad():
        model.forecast(cur, cur, camera(1, 32, 48), steps=2, perceive=perceive)
    assert torch.equal(masks[0], cur.mask)


@pytest.mark.parametrize("mode", ["feedback", "compose"])
@pytest.mark.parametrize("name", ["whole", "joint"])
def test_the_source_camera_is_a_view_like_any_other(mode: Any, name: str) -> None:
    """Asked for, not asked for, or among others: the recursion is the same."""
    model, K = stir(Forecaster(ABLATIONS[name])).eval(), camera(2, 32, 48)
    pair = pair_of(2, 32, 48)
    straight, offset = torch.eye(4).repeat(2, 1, 1), torch.eye(4).repeat(2, 1, 1)
    offset[:, 0, 3] = -0.5
    with torch.no_grad():
        single, both, other = (
            model.forecast(*pair, K, steps=3, views=views, mode=mode, perceive=plain)
            for views in (None, [(offset, K), (straight, K)], [(offset, K)])
        )
    assert len(single) == len(both) == len(other) == 3
    for one, two, three in zip(single, both, other, strict=True):
        assert [len(step.views) for step in (one, two, three)] == [1, 2, 1]
        for name_ in one.views[0]._fields:
            assert torch.equal(getattr(one.views[0], name_), getattr(two.views[1], name_)), name_
            assert torch.equal(getattr(two.views[0], name_), getattr(three.views[0], name_)), name_
        assert not torch.equal(two.views[0].image, two.views[1].image)


def test_composed_motion_repeats_the_camera_and_the_objects() -> None:
    """1 m a step of the camera and 0.5 m of everything else, at 10 m: 4.5 px per step."""
    model = push(drive(Forecaster(SHARP), (2.0, 0, 0), (1.0, 0, 0)), 1.0, 0, 0, 0.5, 0, 0).eval()
    scene = wall(32, 64, 10.0)
    with torch.no_grad():
        steps = model.forecast(scene, scene, camera(1, 32, 64), steps=4, mode="compose")
    assert [round(step.future_from_cur[0, 0, 3].item(), 4) for step in steps] == [1, 2, 3, 4]
    for step, shift in ((steps[1], 9), (steps[3], 18)):
        view = step.views[0]
        assert torch.allclose(view.colour[..., shift + 6 :], scene.image[..., 6:-shift], atol=2e-3)
        assert torch.allclose(view.motion_xyz[..., shift + 6 :], torch.tensor([1.5, 0, 0])[:, None, None], atol=1e-3)


def test_what_moves_keeps_its_velocity_in_the_world() -> None:
    """Against points of constant velocity in the world, seen from a camera that moves otherwise in each interval."""
    generator = torch.Generator().manual_seed(0)
    turns, shifts = (size * torch.randn(4, 2, 3, generator=generator).double() for size in (0.05, 1.0))
    motions = geometry.compose_rigid(
        functional.pad(turns, (1, 0), value=1.0).flatten(0, 1), shifts.flatten(0, 1)
    ).unflatten(0, (4, 2))
    points, velocity = (torch.randn(2, 5, 3, generator=generator).double() for _ in range(2))

    def at(k: int) -> torch.Tensor:
        """In the camera of t + k; the world is the camera at t."""
        pose = torch.eye(4).double().repeat(2, 1, 1)
        for motion in motions[:k]:
            pose = motion @ pose
        return geometry.transform_points(pose, points + k * velocity)

    def packed(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.flatten(0, 1)

    own = at(1) - geometry.transform_points(motions[0], points)
    ones = torch.ones(10, 1).double()
    moved, seen, starts = (packed(at(1) - points), packed(own)), ones[:, 0] < 0, torch.tensor([0, 5, 10])
    cloud = Cloud(packed(points), *moved, ones[:, 0], ones, ones.expand(-1, 3), ones, seen, (), starts)
    for k in range(2, 5):
        cloud = advance(cloud, motions[k - 1])
        assert torch.allclose(cloud.points_xyz, packed(at(k - 1)))
        assert torch.allclose(cloud.points_xyz + cloud.displacement_xyz, packed(at(k)))


def test_perceiving_a_forecast_frame() -> None:
    """Unknown depth comes from the nearest pixel; behind the foreground there is background."""
    image, depth = torch.rand(2, 3, 32, 48), torch.full((2, 1, 32, 48), 12.0)
    mask = torch.ones_like(depth)
    mask[:, :, 10:20, 20:30], depth[:, :, 10:20, 20:30] = 0, 5.0
    depth[:, :, :4] = SKY_DEPTH * 0.98
    holes = depth.clone()
    holes[:, :, 25:, :9], holes[:, :, 13:15, 24:26] = 0, 0
    layers = perceive_forecast(image, holes, mask)
    assert torch.equal(layers.image, image) and torch.equal(layers.mask, mask)
    assert torch.equal(layers.depth[:, :, 4:], depth[:, :, 4:])
    assert (layers.depth[:, :, :4] == SKY_DEPTH).all()
    hidden = mask == 0
    assert (layers.background_depth[hidden] > 6).all()
    with pytest.raises(ValueError, match="`depth` must be known"):
        perceive_forecast(image, torch.zeros_like(depth), mask)


def test_no_point_between_two_surfaces_comes_back_in() -> None:
    """A splat's edge has a mean depth; the nearer surface in ratio has it. A slanted surface keeps its own."""
    near, far = torch.full((1, 1, 12, 7), 5.0), torch.full((1, 1, 12, 7), 20.0)
    edges = torch.tensor([8.0, 12.0]).repeat_interleave(6)[:, None].expand(1, 1, 12, 1)
    slope = 20 * 1.02 ** torch.arange(8.0).expand(1, 1, 12, 8)
    depth, wanted = (torch.cat([near, edge, far, slope], dim=3) for edge in (edges, edges.lt(10) * -15.0 + 20))
    layers = perceive_forecast(torch.rand(1, 3, 12, 23), depth, torch.ones_like(depth))
    assert torch.equal(layers.depth, wanted)
    sky = torch.cat([far, torch.full((1, 1, 12, 1), 60.0), torch.full((1, 1, 12, 7), SKY_DEPTH)], dim=3)
    layers = perceive_forecast(torch.rand(1, 3, 12, 15), sky, torch.ones_like(sky))
    assert (layers.depth[..., :8] == 20).all() and (layers.depth[..., 8:] == SKY_DEPTH).all()


def test_feedback_by_default() -> None:
    model, pair, K = stir(Forecaster(TINY)).eval(), pair_of(1, 32, 48), camera(1, 32, 48)
    with torch.no_grad():
        steps = model.forecast(*pair, K, steps=2)
    assert len(steps) == 2 and steps[1].views[0].image.isfinite().all()
