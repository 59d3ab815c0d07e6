"""The forecaster: shapes, gradients, ablations, batches, files, errors."""

from pathlib import Path

import pytest
import torch
from forecaster_scenes import ABLATIONS, TINY, camera, change, drive, frame, measured, pair_of, sides_of, stir, wall
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional

from vestcl.models import configuration
from vestcl.models.config import LEAST_COVERAGE, RenderConfig
from vestcl.models.forecaster import Camera, Forecaster
from vestcl.models.steps import render as _render
from vestcl.models.steps.clouds import Cloud
from vestcl.models.steps.render import splat_cloud
from vestcl.scene.layers import LayerBatch

# ---------------------------------------------------------------- shapes


@pytest.mark.parametrize(("height", "width"), [(32, 64), (33, 50), (39, 61)])
def test_shapes_for_any_size(height: int, width: int) -> None:
    pair, K = pair_of(2, height, width), camera(2, height, width)
    step = stir(Forecaster(TINY))(*pair, K)
    (view,) = step.views
    channels = {"image": 3, "colour": 3, "coverage": 1, "depth": 1, "background": 1, "motion_xyz": 3}
    for name, count in channels.items():
        tensor = getattr(view, name)
        assert tensor.shape == (2, count, height, width) and tensor.isfinite().all(), name
    assert view.image.min() >= 0 and view.image.max() <= 1
    assert view.coverage.min() >= 0 and view.coverage.max() <= 1 + 1e-6
    assert step.motion.flow0.shape == step.motion.objects.flow.shape == (2, 6, height, width)
    assert [quaternion.shape for quaternion in step.motion.next_from_cur] == [(2, 4), (2, 3)]
    assert len(step.motion.objects.candidates) == 2 and step.motion.objects.ran.shape == (2, 2)
    assert step.future_from_cur.shape == (2, 4, 4)


@pytest.mark.parametrize("name", ["vest-s", "vest-s+routing+joint"])
def test_named_models(name: str) -> None:
    pair, K = pair_of(1, 32, 48), camera(1, 32, 48)
    step = Forecaster(configuration(name))(*pair, K, prior=measured(1, 32, 48))
    assert step.views[0].image.shape == (1, 3, 32, 48)
    assert (step.motion.objects.probabilities is not None) == ("routing" in name)


@pytest.mark.parametrize("name", ABLATIONS)
def test_what_refinement_sees(name: str) -> None:
    """As many channels as the configuration counts: for each side features, colour, coverage, inverse depth."""
    model, seen = Forecaster(ABLATIONS[name]), []
    model.refine.register_forward_hook(lambda _module, inputs, _output: seen.append(inputs[0]))
    pair, K = pair_of(1, 32, 48), camera(1, 32, 48)
    _, sides = sides_of(model, *pair, K)
    render, (rendered,) = ABLATIONS[name].render, seen
    assert rendered.shape[1] == render.channels(4) == (1 if render.joint else 2) * (9 if render.colour else 4)
    assert len(sides) == (1 if render.joint else 2)
    wanted = []
    for side in sides:
        planes = [side.features] + [side.colour, side.coverage, side.inverse_depth] * render.colour
        if render.normalised:
            per = side.coverage.clamp(min=LEAST_COVERAGE)
            planes = [plane if plane is side.coverage else plane / per for plane in planes]
        wanted += planes
    assert torch.allclose(rendered, torch.cat(wanted, dim=1), rtol=1e-6)


def test_a_point_a_pixel_and_one_behind_each_of_the_foreground() -> None:
    model, K = Forecaster(TINY), camera(2, 32, 48)
    prev, cur = (model.encode(frame(2, 32, 48, foreground)) for foreground in (False, True))
    clouds = model.lift(prev, cur, model.move(prev, cur, K), K)
    pixels = 32 * 48
    assert clouds[0].starts.tolist() == [0, pixels, 2 * pixels]
    assert clouds[1].starts.tolist() == [0, pixels + 8, 2 * pixels + 8 + 12]
    assert torch.equal(clouds[1].depth[pixels : pixels + 8], cur.layers.background_depth[0, 0, 6:8, 8:12].flatten())
    assert clouds[1].background[pixels:].min() == 0 and clouds[1].background[pixels : pixels + 8].min() == 1


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("name", ["whole", "joint", "routing", "paper"])
def test_a_gradient_for_every_tensor(name: str) -> None:
    """The image's error reaches encoder, both motions and refinement; those of motion through the splatter only."""
    model, pair, K = stir(Forecaster(ABLATIONS[name])), pair_of(2, 32, 48), camera(2, 32, 48)
    if model.object_motion is not None and model.object_motion.routing is not None:
        nn.init.constant_(model.object_motion.routing.choose.bias, 3.0)
    torch.manual_seed(1)
    view = model(*pair, K).views[0]
    functional.l1_loss(view.image, pair[1].image).backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all() and parameter.grad.abs().max() > 0, parameter_name


def test_motion_learns_from_the_splatted_colour() -> None:
    """Refinement left out: forward and backward as the splatter gives them, down to a smooth image's shift."""
    model, K = drive(Forecaster(change(object_motion=None)), (0.6, 0, 0), (0.3, 0, 0)), camera(1, 32, 48)
    assert model.ego_motion is not None
    scene = wall(32, 48, 10.0)
    smooth = (torch.arange(48) / 48).expand(1, 3, 32, 48).contiguous()
    scene = scene._replace(image=smooth, background_image=smooth)
    side = sides_of(model, scene, scene, K)[1][1]
    inner = (side.colour / side.coverage.clamp(min=LEAST_COVERAGE))[..., 4:-4]
    functional.mse_loss(inner, smooth[..., 4:-4]).backward()
    grad = model.ego_motion.motion.bias.grad
    assert grad is not None and grad[7 + 4] > 1e-4  # too far to the right


def test_the_radius_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """rho z_src / z_tgt px times the ratio of focal lengths, not below half a pixel and not above half a tile."""
    z = torch.tensor([10.0, 5.0, 0.5, 100.0])
    one, none, starts = torch.ones(4, 1), torch.zeros(4, dtype=torch.bool), torch.tensor([0, 4])
    points, moved = torch.tensor([[0.0, 0, 10]]).repeat(4, 1), torch.stack([0 * z, 0 * z, z - 10], dim=1)
    cloud = Cloud(points, moved, 0 * moved, points[:, 2], one, one.expand(4, 3), one, none, (), starts)
    seen: list[torch.Tensor] = []

    def rasterize(points_uv, z, radii, *others, **named):  # type: ignore[no-untyped-def]
        seen.append(radii)
        return original(points_uv, z, radii, *others, **named)

    original = _render.rasterize
    monkeypatch.setattr(_render, "rasterize", rasterize)
    still, K = torch.eye(4)[None], camera(1, 9, 9)
    for zoom in (1.0, 2.0):
        target = K * torch.tensor([zoom, zoom, 1.0])[:, None]
        splat_cloud(cloud, Camera(still, target), K, still, RenderConfig(), 9, 9)
    assert torch.allclose(seen[0], torch.tensor([1.5, 3, 8, 0.5]))
    assert torch.allclose(seen[1], torch.tensor([3.0, 6, 8, 0.5]))


def test_the_radius_has_a_gradient() -> None:
    """A point on the optical axis: coming nearer changes nothing but its size, and so what it covers."""
    points, one = torch.tensor([[0.0, 0.0, 10.0]]), torch.ones(1, 1)
    displacement = torch.tensor([[0.0, 0.0, -2.0]], requires_grad=True)
    seen, starts = torch.zeros(1, dtype=torch.bool), torch.tensor([0, 1])
    size, white = torch.tensor([10.0]), torch.ones(1, 3)
    cloud = Cloud(points, displacement, torch.zeros(1, 3), size, one, white, one, seen, (), starts)
    still, K = torch.eye(4)[None], camera(1, 9, 9)
    splat_cloud(cloud, Camera(still, K), K, still, RenderConfig(rho=1.5), 9, 9).coverage.sum().backward()
    assert displacement.grad is not None
    assert displacement.grad[0, 2] < -0.1 and displacement.grad[0, :2].abs().max() < 1e-4


def test_the_encoder_learns_from_the_cameras_motion() -> None:
    model = stir(Forecaster(TINY))
    prev, cur = (model.encode(one) for one in pair_of(1, 32, 48))
    model.move_camera(prev, cur)[1].translation.sum().backward()
    for name, parameter in model.encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_goes_back_and_forth(name: str) -> None:
    """Refinement learns; the others' steps on a random image are no sure gain, but all have a finite gradient."""
    model, pair, K = Forecaster(ABLATIONS[name]), pair_of(1, 32, 48), camera(1, 32, 48)
    optimiser = torch.optim.SGD(model.refine.parameters(), 1e-3)
    truth, losses = torch.rand(1, 3, 32, 48), []
    for _ in range(2):
        model.zero_grad()
        loss = functional.l1_loss(model(*pair, K).views[0].image, truth)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[1] < losses[0]
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


# ---------------------------------------------------------------- batches, determinism


@pytest.mark.parametrize("joint", [False, True])
def test_a_batch_is_its_images(joint: bool) -> None:
    """Clouds of 8 and of 12 inpainted points, together and separately."""
    model = stir(Forecaster(change(render=RenderConfig(joint=joint)))).eval()
    pair, K = pair_of(2, 33, 50), camera(2, 33, 50)
    K[1, :2, :2] *= 1.1
    views = [(torch.eye(4).repeat(2, 1, 1), K), (torch.eye(4).repeat(2, 1, 1), 0.9 * K)]
    views[1][0][:, 0, 3] = torch.tensor([0.3, -0.6])
    views[1][1][:, 2, 2] = 1
    with torch.no_grad():
        together = model(*pair, K, views)
        for b in range(2):
            one = slice(b, b + 1)
            single = [LayerBatch(*(tensor[one] for tensor in layers)) for layers in pair]
            step = model(*single, K[one], [(pose[one], cameras[one]) for pose, cameras in views])
            for view, whole in zip(step.views, together.views, strict=True):
                for name in view._fields:
                    got, wanted = getattr(view, name), getattr(whole, name)[one]
                    assert (got - wanted).abs().mean() < 1e-4, name


def test_the_same_bits_twice() -> None:
    model, pair, K = stir(Forecaster(TINY)), pair_of(2, 33, 50), camera(2, 33, 50)
    images, grads = [], []
    for _ in range(2):
        model.zero_grad()
        image = model(*pair, K).views[0].image
        image.square().mean().backward()
        images.append(image.detach())
        grads.append([p.grad.clone() for p in model.parameters() if p.grad is not None])
    assert torch.equal(*images) and grads[0]
    assert all(torch.equal(one, other) for one, other in zip(*grads, strict=True))


# ---------------------------------------------------------------- files and errors


@pytest.mark.parametrize("name", ABLATIONS)
def test_a_file_gives_the_model_back(tmp_path: Path, name: str) -> None:
    model, path = Forecaster(ABLATIONS[name]), tmp_path / "new" / "model.safetensors"
    for parameter in model.parameters():
        nn.init.normal_(parameter)
    model.save(path)
    again = Forecaster.load(path)
    assert again.config == model.config and not again.training
    assert [file.name for file in path.parent.iterdir()] == ["model.safetensors"]
    for (key, wanted), (key_again, got) in zip(model.state_dict().items(), again.state_dict().items(), strict=True):
        assert key == key_again and torch.equal(wanted, got)


def test_refuses_files(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    with pytest.raises(FileNotFoundError, match=r"no model at .*model\.safetensors"):
        Forecaster.load(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="`path` must be a safetensors file"):
        Forecaster.load(path)
    save_file({"x": torch.ones(1)}, path)
    with pytest.raises(ValueError, match="`path` must hold a configuration"):
        Forecaster.load(path)
    for metadata in ('{"name": "x", "colour": 1}', "[]", "{", '{"name": "x", "encoder": 3}'):
        save_file({"x": torch.ones(1)}, path, {"vestcl.config": metadata})
        with pytest.raises(ValueError, match="`path` must hold a configuration of this version"):
            Forecaster.load(path)
    save_file({"x": torch.ones(1)}, path, {"vestcl.config": '{"name": "x"}'})
    with pytest.raises(ValueError, match="`path` must hold the weights of x"):
        Forecaster.load(path)


def test_refuses_arguments() -> None:
    model, pair, K = Forecaster(TINY), pair_of(2, 32, 48), camera(2, 32, 48)
    with pytest.raises(ValueError, match=r"`frame_cur.image` must be \[2, 3, 32, 48\], got \[2, 3, 32, 40\]"):
        model(pair[0], frame(2, 32, 40), K)
    with pytest.raises(ValueError, match=r"`K` must be \[2, 3, 3\], got \[1, 3, 3\]"):
        model(*pair, K[:1])
    with pytest.raises(ValueError, match=r"`tgt_from_next` must be \[2, 4, 4\], got \[2, 3, 3\]"):
        model(*pair, K, [Camera(K, K)])
    with pytest.raises(ValueError, match=r"`frame_prev.depth` must be finite and above 0 m, got 0"):
        model(pair[0]._replace(depth=torch.zeros_like(pair[0].depth)), pair[1], K)
    with pytest.raises(ValueError, match="`steps` must be >= 1"):
        model.forecast(*pair, K, steps=0)
    with pytest.raises(ValueError, match='`mode` "feedback" or "compose", got 1 and \'dream\''):
        model.forecast(*pair, K, mode="dream")  # type: ignore[arg-type]


def test_what_is_seen_is_never_hidden_by_what_is_inpainted() -> None:
    """A car drives away from the road that was painted 1 % behind it: it stays in front unless only depth decides."""
    red, green = torch.tensor([[1.0, 0, 0, 1.0]]), torch.tensor([[0, 1.0, 0, 1.0]])
    xyz, moved = torch.tensor([[0, 0, 10.0], [0, 0, 10.1]]), torch.tensor([[0, 0, 2.0], [0, 0, 0]])
    features, colour = torch.cat([red, green]).split([1, 3], dim=1)
    one, inpainted, starts = torch.ones(2, 1), torch.tensor([False, True]), torch.tensor([0, 2])
    cloud = Cloud(xyz, moved, 0 * moved, xyz[:, 2], features, colour, one, inpainted, (), starts)
    still, K = torch.eye(4)[None], camera(1, 9, 9)
    for rule, wanted in (("last", red), ("own", green)):
        config = RenderConfig(rho=1.5, inpainted=rule)  # type: ignore[arg-type]
        side = splat_cloud(cloud, Camera(still, K), K, still, config, 9, 9)
        middle = torch.cat([side.features, side.colour], dim=1)[0, :, 4, 4]
        assert torch.allclose(middle, wanted[0], atol=0.2) and side.coverage[0, 0, 4, 4] > 0.8


@pytest.mark.parametrize("stretched", [False, True])
def test_points_that_pass_the_camera_do_not_become_balls(stretched: bool) -> None:
    """Of 10 m and of 0.5 m in front of it: at half the distance a point counts, at a twentieth it does not."""
    K, still, one = camera(1, 9, 9), torch.eye(4)[None], torch.ones(1, 1)
    config, covered = RenderConfig(rho=1.0, stretched=stretched), []
    for distance in (5.0, 0.5):
        points, white, starts = torch.tensor([[0, 0, distance]]), torch.ones(1, 3), torch.tensor([0, 1])
        size, seen = torch.tensor([10.0]), torch.zeros(1, dtype=torch.bool)
        cloud = Cloud(points, torch.zeros(1, 3), torch.zeros(1, 3), size, one, white, one, seen, (), starts)
        side = splat_cloud(cloud, Camera(still, K), K, still, config, 9, 9)
        covered.append(float(side.coverage[0, 0, 4, 4]))
    assert covered[0] > 0.8 and covered[1] == 0


def test_a_longer_focal_length_leaves_out_no_point() -> None:
    """Ten times the focal length shows a point with the largest radius, as the geometric renderer does."""
    still, one, starts = torch.eye(4)[None], torch.ones(1, 1), torch.tensor([0, 1])
    K = camera(1, 9, 9)
    points, size = torch.tensor([[0.0, 0, 10]]), torch.tensor([10.0])
    cloud = Cloud(points, 0 * points, 0 * points, size, one, torch.ones(1, 3), one, torch.zeros(1).bool(), (), starts)
    longer = K * torch.tensor([[10.0, 10, 1]] * 2 + [[1, 1, 1]])
    side = splat_cloud(cloud, Camera(still, longer), K, still, RenderConfig(rho=1.0), 9, 9)
    assert float(side.coverage[0, 0, 4, 4]) > 0.8
