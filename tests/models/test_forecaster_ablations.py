"""The ablations of the paper, and what motion networks see: moved points, tokens, inputs."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from forecaster_scenes import (
    ABLATIONS,
    OBJECTS,
    SMALL,
    TINY,
    camera,
    change,
    drive,
    frame,
    measured,
    pair_of,
    plain,
    push,
    stir,
    turning,
    wall,
)
from safetensors.torch import save_file

from vestcl.models import EgoMotion, ModelConfig, ObjectMotion
from vestcl.models.checkpoint import KEY
from vestcl.models.config import FIXED_DEPTH
from vestcl.models.forecaster import Forecaster, Step
from vestcl.models.steps.clouds import in_plane
from vestcl.scene.layers import LayerBatch

HEIGHT, WIDTH = 32, 48

# ---------------------------------------------------------------- files written before


@pytest.mark.parametrize(("config", "mode"), [(TINY, "feedback"), (SMALL, "compose")])
def test_files_without_the_newer_fields_load(config: ModelConfig, mode: str, tmp_path: Path) -> None:
    """What these fields mean by default is what models did before them."""
    model = stir(Forecaster(config)).eval()
    about = dataclasses.asdict(config)
    assert about.pop("mode") is None and about["object_motion"].pop("inpainted") is False
    tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
    save_file(tensors, tmp_path / "old.safetensors", metadata={KEY: json.dumps(about)})
    loaded = Forecaster.load(tmp_path / "old.safetensors")
    assert loaded.config == config and loaded.config.default_mode == mode


# ---------------------------------------------------------------- B: without EMF


@pytest.mark.parametrize("inpainted", ["own", "last"])
def test_without_emf_inpainted_points_move_as_object_motion_says_at_their_pixel(inpainted: str) -> None:
    render = dataclasses.replace(TINY.render, inpainted=inpainted)
    model = push(Forecaster(change(ego_motion=None, render=render)), 2.0, 0.4, -1.0, 1.0, 0.2, -0.5)
    prev, cur = (model.encode(frame(1, HEIGHT, WIDTH)) for _ in range(2))
    K = camera(1, HEIGHT, WIDTH)
    first, second = model.lift(prev, cur, model.move(prev, cur, K), K)
    both = ((first, 2, 1 if inpainted == "last" else 2), (second, 1, 1))
    for cloud, intervals, hidden in both:
        pixels, behind = cloud.displacement_xyz.split([HEIGHT * WIDTH, len(cloud.depth) - HEIGHT * WIDTH])
        assert torch.allclose(pixels, intervals * torch.tensor([1.0, 0.2, -0.5]), atol=1e-5)
        assert torch.allclose(behind, hidden * torch.tensor([1.0, 0.2, -0.5]), atol=1e-5)
        assert torch.allclose(cloud.step_xyz, torch.tensor([1.0, 0.2, -0.5]), atol=1e-5)
    assert first.inpainted.any()


def test_each_inpainted_point_takes_the_motion_at_its_own_pixel() -> None:
    model, K = Forecaster(change(ego_motion=None)), camera(2, HEIGHT, WIDTH)
    prev, cur = (model.encode(layers) for layers in pair_of(2, HEIGHT, WIDTH))
    motion, flow, span = model.move(prev, cur, K), torch.rand(2, 6, HEIGHT, WIDTH), torch.tensor([1.5, 3.0])
    motion = motion._replace(objects=motion.objects._replace(flow=flow), spans=(span[:, None, None, None], 1.0))
    for cloud, own, spans, encoded in zip(
        model.lift(prev, cur, motion, K), flow.split(3, dim=1), (span, torch.ones(2)), (prev, cur), strict=True
    ):
        hidden = encoded.layers.mask[:, 0] < 0.5
        image = hidden.nonzero()[:, 0]
        moved, step = (each[cloud.inpainted] for each in (cloud.displacement_xyz, cloud.step_xyz))
        assert torch.equal(moved, own.permute(0, 2, 3, 1)[hidden])
        assert torch.allclose(step, moved / spans[image][:, None])


# ---------------------------------------------------------------- A: fixed depth


def test_motion_in_a_plane_by_hand() -> None:
    """What comes 2 m nearer from 10 m moves outwards by a quarter, and keeps its depth."""
    points, moved = torch.tensor([[4.0, -8, 10]]), torch.tensor([[0.0, 0, -2]])
    assert torch.allclose(in_plane(points, moved), torch.tensor([[1.0, -2, 0]]))
    assert torch.allclose(in_plane(points, torch.tensor([[1.0, 2, 0]])), torch.tensor([[1.0, 2, 0]]))
    assert in_plane(points, torch.tensor([[0.0, 0, -10]])).isfinite().all()


@pytest.mark.parametrize("mode", ["compose", "feedback"])
@pytest.mark.parametrize("start", ["rest", "prior"])
def test_at_a_fixed_depth_motion_is_a_2d_flow(start: str, mode: str) -> None:
    """Of the camera, of objects and of inpainted points, over all steps; so nothing changes its order."""
    torch.manual_seed(0)
    config = dataclasses.replace(TINY if start == "rest" else SMALL, fixed_depth=FIXED_DEPTH)
    model = push(stir(Forecaster(config)).eval(), *(0.3, -0.2, 1.5) * 2)
    lifted, original = [], model.splat

    def splat(clouds, *others):  # type: ignore[no-untyped-def]
        lifted.extend(clouds)
        return original(clouds, *others)

    model.splat = splat  # type: ignore[method-assign]
    prior = None if start == "rest" else turning(1, HEIGHT, WIDTH)
    with torch.no_grad():
        steps = model.forecast(
            *pair_of(1, HEIGHT, WIDTH), camera(1, HEIGHT, WIDTH), 3, None, mode, plain, prior=prior,  # type: ignore[arg-type]
        )  # fmt: skip
    assert len(lifted) == 6 and any(cloud.inpainted.any() for cloud in lifted)
    for cloud in lifted:
        assert not cloud.displacement_xyz[:, 2].any() and cloud.displacement_xyz[:, :2].any()
        assert torch.equal(cloud.points_xyz[:, 2], cloud.depth)
        assert torch.allclose(cloud.depth[cloud.inpainted], torch.tensor(1.01 * FIXED_DEPTH))
    for step in steps:
        for flow in (step.motion.flow0, step.motion.start, step.motion.objects.flow):
            assert not flow[:, 2].any() and not flow[:, 5].any()
        assert step.views[0].motion_xyz[:, 2].abs().max() < 1e-4


def test_the_cameras_flow_is_that_of_a_plane() -> None:
    """On the image, points of a wall at that depth move as they would in 3D: what is left out is z."""
    scene, K, places = wall(HEIGHT, WIDTH, FIXED_DEPTH), camera(1, HEIGHT, WIDTH), []
    for config in (TINY, change(fixed_depth=FIXED_DEPTH)):
        model = drive(Forecaster(config), (1.0, 0, -4.0), (0.5, 0, -2.0))
        encoded = model.encode(scene)
        clouds = model.lift(encoded, encoded, model.move(encoded, encoded, K), K)
        moved = torch.stack([cloud.points_xyz + cloud.displacement_xyz for cloud in clouds])
        places.append(moved[..., :2] / moved[..., 2:])
    assert torch.allclose(*places, atol=1e-5)


def test_hidden_points_stay_behind_after_any_motion() -> None:
    """5 mm nearer brought 91 % of them in front, when all were at one depth."""
    model = push(Forecaster(ABLATIONS["fixed depth"]), *(0.0, 0, 0.005) * 2).eval()
    prev, cur = (model.encode(layers) for layers in pair_of(1, HEIGHT, WIDTH))
    K = camera(1, HEIGHT, WIDTH)
    for cloud in model.lift(prev, cur, model.move(prev, cur, K), K):
        z = cloud.points_xyz[:, 2] + cloud.displacement_xyz[:, 2]
        assert z[cloud.inpainted].min() > z[~cloud.inpainted].max()


# ---------------------------------------------------------------- object motion sees the inpainted layers


def test_object_motion_sees_inpainted_layers() -> None:
    """Their colours and depths change the flow of the variant, and not that of the paper's equation."""
    prev, cur = pair_of(1, HEIGHT, WIDTH)
    hidden = cur.mask == 0
    others = {
        "image": cur._replace(background_image=torch.where(hidden, torch.rand_like(cur.image), cur.background_image)),
        "depth": cur._replace(background_depth=torch.where(hidden, 3 * cur.depth, cur.background_depth)),
    }
    for inpainted in (False, True):
        torch.manual_seed(0)
        objects = dataclasses.replace(OBJECTS, inpainted=inpainted)
        model = stir(Forecaster(change(object_motion=objects))).eval()
        assert isinstance(model.ego_motion, EgoMotion)
        torch.nn.init.zeros_(model.ego_motion.motion.weight)  # the camera's motion does not change

        def flow(layers: LayerBatch, model: Forecaster = model) -> torch.Tensor:
            with torch.no_grad():
                return model(prev, layers, camera(1, HEIGHT, WIDTH)).motion.objects.flow

        for other in others.values():
            assert torch.equal(flow(cur), flow(other)) != inpainted


def test_its_channels_and_what_it_refuses() -> None:
    objects = dataclasses.replace(OBJECTS, inpainted=True)
    plain_, both = ObjectMotion(OBJECTS, 4), ObjectMotion(objects, 4)
    extra = [block.shrunk_in.in_channels for block in both.blocks]  # type: ignore[union-attr]
    assert extra == [block.shrunk_in.in_channels + 2 * (4 + 1) for block in plain_.blocks]  # type: ignore[union-attr]
    features, depth = torch.rand(1, 4, 16, 16), torch.rand(1, 1, 16, 16) + 5
    seen = features, features, depth, depth, torch.ones_like(depth), torch.ones_like(depth), torch.rand(1, 6, 16, 16)
    with pytest.raises(ValueError, match="`backgrounds` must be F_bg, F_bg, D_bg, D_bg for this"):
        both(*seen)
    with pytest.raises(ValueError, match="`backgrounds` must be empty for this configuration, got 4 tensors"):
        plain_(*seen, backgrounds=[features, features, depth, depth])
    with pytest.raises(ValueError, match=r"`depth_cur` must be \[1, 1, 16, 16\], got \[1, 1, 16, 8\]"):
        both(*seen, backgrounds=[features, features, depth, depth[..., :8]])


# ---------------------------------------------------------------- the recording car


def bonnet(batch: int) -> torch.Tensor:
    own = torch.zeros(batch, 1, HEIGHT, WIDTH)
    own[:, :, -16:] = 1
    return own


@pytest.mark.parametrize("start", ["rest", "prior"])
def test_ego_motion_does_not_look_at_the_recording_car(start: str) -> None:
    """Whatever shines on the bonnet, the camera's motion is the same; the two tokens' rows above are all that counts.

    Convolutions reach beyond their token, so the features of the tokens themselves are changed.
    """
    torch.manual_seed(0)
    model = stir(Forecaster(TINY if start == "rest" else SMALL)).eval()
    prior = None if start == "rest" else measured(1, HEIGHT, WIDTH, cur=(0, 0, -1.0))
    prev, cur = (model.encode(layers) for layers in pair_of(1, HEIGHT, WIDTH, foreground=False))
    assert cur.camera_grid is not None and cur.camera_grid.shape[2:] == (2, 3)
    shiny = cur.camera_grid.clone()
    shiny[:, :, 1:] += 5 * torch.rand_like(shiny[:, :, 1:])
    other = cur._replace(camera_grid=shiny)
    with torch.no_grad():
        masked = [model.move_camera(prev, each, prior, bonnet(1))[1] for each in (cur, other)]
        seen = [model.move_camera(prev, each, prior)[1] for each in (cur, other)]
    assert all(torch.equal(*pair) for pair in zip(*masked, strict=True))
    assert not torch.equal(seen[0].translation, seen[1].translation)
    assert not torch.equal(seen[0].translation, masked[0].translation)


@pytest.mark.parametrize("mode", ["compose", "feedback"])
def test_every_way_into_the_model_takes_it(mode: str) -> None:
    """Forward, forecast over all steps, and the present; a mask of nothing is none."""
    torch.manual_seed(0)
    model, K, pair = stir(Forecaster(TINY)).eval(), camera(2, HEIGHT, WIDTH), pair_of(2, HEIGHT, WIDTH)

    def poses(own: torch.Tensor | None) -> list[torch.Tensor]:
        with torch.no_grad():
            steps: list[Step] = model.forecast(*pair, K, 2, None, mode, plain, own=own)  # type: ignore[arg-type]
            view = model.present(*pair, K, [(torch.eye(4).repeat(2, 1, 1), K)], None, own)[0]
            return [*(step.future_from_cur for step in steps), model(*pair, K, own=own).future_from_cur, view.image]

    without = poses(None)
    assert all(map(torch.equal, poses(torch.zeros(2, 1, HEIGHT, WIDTH)), without))
    assert not any(map(torch.equal, poses(bonnet(2)), without))
    with pytest.raises(ValueError, match=r"`own` must be \[2, 1, 32, 48\], got \[1, 1, 32, 48\]"):
        model(*pair, K, own=bonnet(1))
