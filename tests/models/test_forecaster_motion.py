"""The forecaster: clouds, motion and views by hand."""

import itertools

import torch
from forecaster_scenes import ABLATIONS, FOCAL, SHARP, TINY, camera, drive, frame, pair_of, push, sides_of, wall

from vestcl.constants import SKY_DEPTH
from vestcl.models import EgoMotion, ObjectMotion
from vestcl.models.config import FIXED_DEPTH, LEAST_COVERAGE, LOG_DEPTH_FAR
from vestcl.models.forecaster import Forecaster
from vestcl.models.steps.frames import grid_depth, grid_mean
from vestcl.models.steps.render import Side, compose_view

# ---------------------------------------------------------------- by hand


def test_at_rest_the_image_stays() -> None:
    model, pair, K = Forecaster(SHARP), pair_of(2, 33, 50, foreground=False), camera(2, 33, 50)
    step, sides = sides_of(model, *pair, K)
    for side, source in zip(sides, pair, strict=True):
        assert side.coverage.min() > 0.999
        assert torch.allclose(side.colour / side.coverage, source.image, atol=1e-4)
        assert torch.allclose(side.coverage / side.inverse_depth, source.depth, rtol=1e-4)
    view = step.views[0]
    assert torch.allclose(view.colour / view.coverage, pair[1].image, atol=1e-3)
    assert torch.allclose(view.depth, pair[1].depth, rtol=1e-3)
    assert torch.equal(step.motion.flow0, torch.zeros_like(step.motion.flow0))
    assert view.background.min() > 0.999 and view.motion_xyz.abs().max() < 1e-4


def test_each_frame_goes_to_the_next_directly() -> None:
    """On a wall 10 m away with f = 30 px, a metre is 3 px."""
    model = drive(Forecaster(SHARP), prev=(2.0, 0, 0), cur=(1.0, 0, 0))
    prev, cur = wall(32, 48, 10.0), wall(32, 48, 10.0)
    step, (first, second) = sides_of(model, prev, cur, camera(1, 32, 48))
    assert torch.allclose(first.colour[..., 6:], prev.image[..., :-6], atol=1e-3)
    assert torch.allclose(second.colour[..., 3:], cur.image[..., :-3], atol=1e-3)
    assert second.coverage[..., :3].max() < 1e-3
    motion_xyz = step.views[0].motion_xyz
    assert torch.allclose(motion_xyz[..., 6:], torch.tensor([1.0, 0, 0])[:, None, None], atol=1e-3)
    assert torch.allclose(step.future_from_cur[0, :3, 3], torch.tensor([1.0, 0, 0]))


def test_the_radius_grows_with_what_comes_nearer() -> None:
    """A wall at 10 m seen from 5 m further on: each point covers 2 x 2 pixels, and the image stays closed."""
    model = drive(Forecaster(SHARP), prev=(0, 0, -5.0), cur=(0, 0, -5.0))
    step, sides = sides_of(model, wall(32, 48, 10.0), wall(32, 48, 10.0), camera(1, 32, 48))
    for side in sides:
        assert side.coverage.min() > 0.8
        assert torch.allclose(side.coverage / side.inverse_depth, torch.tensor(5.0), rtol=1e-4)
    assert torch.allclose(step.views[0].depth, torch.tensor(5.0), rtol=1e-4)


def test_the_radius_grows_with_the_focal_length() -> None:
    model, K = Forecaster(SHARP), camera(1, 32, 48)
    closer = K * torch.tensor([2.0, 2.0, 1.0])[:, None]
    closer[:, :2, 2] = K[:, :2, 2]
    pair = wall(32, 48, 10.0), wall(32, 48, 10.0)
    assert model(*pair, K, [(torch.eye(4)[None], closer)]).views[0].coverage.min() > 0.8


def test_the_sky_only_turns() -> None:
    model, sky = Forecaster(SHARP), wall(32, 48, SKY_DEPTH)
    still = model(sky, sky, camera(1, 32, 48)).views[0].colour
    driving = drive(model, prev=(0.5, 0, -4.0), cur=(0.2, 0, -2.0))(sky, sky, camera(1, 32, 48)).views[0].colour
    assert torch.allclose(still, driving, atol=0.01)


def test_inpainted_points_follow_the_camera_only() -> None:
    model, K = drive(push(Forecaster(TINY), *(5.0,) * 6), (2.0, 0, 0), (1.0, 0, 0)), camera(1, 32, 48)
    prev, cur = (model.encode(frame(1, 32, 48)) for _ in range(2))
    first, second = model.lift(prev, cur, model.move(prev, cur, K), K)
    for cloud, metres, step in ((first, 2.0, 2.5), (second, 1.0, 5.0)):
        pixels, behind = cloud.displacement_xyz.split([32 * 48, 8])
        assert torch.allclose(pixels, torch.tensor([metres + 5, 5, 5]), atol=1e-5)
        assert torch.allclose(behind, torch.tensor([metres, 0, 0]), atol=1e-5)
        assert torch.allclose(cloud.step_xyz[: 32 * 48], torch.tensor(step), atol=1e-5)
        assert not cloud.step_xyz[32 * 48 :].any()


def test_object_motion_never_sees_the_skys_flow() -> None:
    """Turning by 0.1 rad moves what is 10 km away by 1 km; the network is shown what would be LOG_DEPTH_FAR away."""
    model, sky, K = Forecaster(TINY), wall(32, 48, SKY_DEPTH), camera(1, 32, 48)
    assert isinstance(model.ego_motion, EgoMotion) and isinstance(model.object_motion, ObjectMotion)
    with torch.no_grad():
        model.ego_motion.motion.bias[7 + 2] = 0.05
        model.ego_motion.motion.bias[7 + 4] = 3.0
    seen: list[torch.Tensor] = []
    model.object_motion.register_forward_hook(lambda _module, inputs, _output: seen.append(inputs[6]))
    motion = model(sky, sky, K).motion
    assert motion.flow0.abs().max() > 900 and 90 < seen[0].abs().max() < 0.12 * LOG_DEPTH_FAR
    middle = seen[0][0, 3:, 16, 24]
    rigid = motion.rigid[0]
    ray = torch.tensor([0.5 / FOCAL, 0.5 / FOCAL, 1.0]) * LOG_DEPTH_FAR
    assert torch.allclose(middle, rigid[:3, :3] @ ray + rigid[:3, 3] - ray, atol=0.01)
    for flow in (motion.objects.flow, *motion.objects.candidates):
        assert torch.allclose(flow, motion.flow0, atol=1e-3)


def test_fixed_depth_reaches_everything() -> None:
    """And the background stays 1 % behind what hides it."""
    layers = frame(1, 32, 48)
    seen = Forecaster(ABLATIONS["fixed depth"]).encode(layers).layers
    assert seen.depth.unique().tolist() == [FIXED_DEPTH]
    assert torch.equal(seen.background_depth, torch.where(layers.mask == 0, 1.01 * FIXED_DEPTH, FIXED_DEPTH))


def test_the_grid_by_hand() -> None:
    depth = torch.tensor([[2.0, 2, 4, 4, 8], [2, 2, 4, 4, 8]])[None, None]
    assert torch.allclose(grid_depth(depth), torch.tensor([[1 / 0.375, 8.0]]))
    assert torch.allclose(grid_mean(depth), torch.tensor([[3.0, 8.0]]))
    for height, width in itertools.product((1, 4, 9), (3, 6)):
        assert grid_mean(torch.ones(1, 1, height, width)).shape[2:] == (-(-height // 4), -(-width // 4))


def test_a_view_of_two_sides_by_hand() -> None:
    """The current frame covers half, the previous one is behind it."""

    def side(cover: float, colour: float, depth: float, background: float, motion: float) -> Side:
        known = [colour] * 3 + [1 / depth, background] + [motion / depth] * 3
        whole = torch.full((1, 1, 1, 1), cover)
        return Side(torch.zeros(1, 4, 1, 1), cover * torch.tensor(known)[None, :, None, None], whole)

    image = torch.rand(1, 3, 1, 1)
    view = compose_view([side(0.8, 1.0, 4.0, 1.0, 2.0), side(0.5, 0.0, 2.0, 0.0, 1.0)], image)
    assert view.image is image
    assert torch.allclose(view.colour, torch.tensor(0.4)) and torch.allclose(view.coverage, torch.tensor(0.9))
    assert torch.allclose(view.depth, torch.tensor(0.9 / (0.25 + 0.1)))
    assert torch.allclose(view.background, torch.tensor(0.4 / 0.9))
    assert torch.allclose(view.motion_xyz, torch.tensor((0.25 * 1 + 0.1 * 2) / (0.25 + 0.1)))
    empty = compose_view([side(LEAST_COVERAGE / 2, 1.0, 4.0, 0.0, 2.0)], image)
    assert not empty.depth.any() and not empty.motion_xyz.any() and empty.background.item() == 1
