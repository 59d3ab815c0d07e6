"""Training's losses: zero for the truth, by hand, safe gradients, and a sum that takes what the configuration says."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from data_files import real
from forecaster_scenes import OBJECTS, SMALL, TINY, camera, pair_of, stir, turning

from train.data.windows import Batch
from train.run.losses import NEAREST, build_perceptual, path_errors, pose_errors, residual_motion, ssim_loss, total_loss
from train.settings.config import LossConfig
from vestcl import geometry
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import VggLoss
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.models import EgoMotion, ObjectMotion, RigidMotion
from vestcl.models.config import RoutingConfig
from vestcl.models.forecaster import Forecaster, RenderedView, Step
from vestcl.models.steps.prior import MotionPrior

BATCH, HEIGHT, WIDTH = 2, 24, 32


def number(tensor: torch.Tensor) -> float:
    return float(tensor.detach())


def settings(**weights: Any) -> LossConfig:
    """Weights that are 0 but for those that are given."""
    return LossConfig(**{"perceptual": {"kind": "none"}, "l1": 0.0, **weights})


def batch_of(target: torch.Tensor, future_from_cur: torch.Tensor, known: list[bool]) -> Batch:
    """Frames of that many images, and this truth."""
    size = len(target)
    prev, cur = pair_of(size, *target.shape[2:])
    K, eye = camera(size, *target.shape[2:]), torch.eye(4).repeat(size, 1, 1)
    rest = RigidMotion(torch.tensor([[1.0, 0, 0, 0]]).repeat(size, 1), torch.zeros(size, 3))
    still = MotionPrior(rest, rest, rest, torch.zeros_like(target), torch.zeros_like(target))
    clips = tuple(f"clip/{number}" for number in range(size))
    path_from_cur = future_from_cur[:, None]
    return Batch(prev, cur, K, still, 1, target, eye, K, future_from_cur, path_from_cur, torch.tensor(known), clips)


def forecast(moving: bool = False) -> tuple[Forecaster, RenderedView, Step, Batch]:
    """A tiny network's view, and a batch that is asked of it; the camera's true motion is 1 m ahead."""
    torch.manual_seed(0)
    model = Forecaster(TINY)
    if moving:
        stir(model)
    ahead = torch.eye(4).repeat(BATCH, 1, 1)
    ahead[:, 2, 3] = 1.0
    batch = batch_of(torch.rand(BATCH, 3, HEIGHT, WIDTH), ahead, [True, False])
    step = model(batch.frame_prev, batch.frame_cur, batch.K)
    return model, step.views[0], step, batch


def rigid(rotation_vector: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """[B, 4, 4] from rotation vectors [B, 3], smooth at zero."""
    skew = torch.zeros(len(rotation_vector), 3, 3, dtype=rotation_vector.dtype)
    x, y, z = rotation_vector.unbind(1)
    for (i, j), value in zip(((2, 1), (0, 2), (1, 0)), (x, y, z), strict=True):
        skew[:, i, j], skew[:, j, i] = value, -value
    top = torch.cat([torch.linalg.matrix_exp(skew), translation[:, :, None]], dim=2)
    last = torch.tensor([0, 0, 0, 1.0], dtype=top.dtype).expand(len(top), 1, 4)
    return torch.cat([top, last], dim=1)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 0.1, 90.0, 179.9])
def test_the_angle_is_the_angle(degrees: float) -> None:
    angle = math.radians(degrees)
    axis = torch.nn.functional.normalize(torch.tensor([[1.0, -2, 3]], dtype=torch.float64))
    truth = rigid(torch.tensor([[0.3, 0.2, -0.5]], dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64))
    moved = truth @ rigid(angle * axis, torch.zeros(1, 3, dtype=torch.float64))
    moved[:, :3, 3] = truth[:, :3, 3] + 2 * axis
    rotation, translation = pose_errors(moved, truth, torch.tensor([True]))
    assert number(rotation) == pytest.approx(angle, abs=1e-12) and number(translation) == pytest.approx(2)


def test_the_angle_in_float32_keeps_its_digits_near_zero() -> None:
    angle = torch.tensor([[0.0, 1e-4, 0.0]])
    moved, still = rigid(angle, torch.zeros(1, 3)), torch.eye(4)[None]
    assert number(pose_errors(moved, still, torch.tensor([True]))[0]) == pytest.approx(1e-4, rel=1e-5)


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.7, 3.0])
def test_gradients_of_the_pose_errors(size: float) -> None:
    """At zero both sides of the kink cancel in the numerical derivative, as they must in the analytic one."""
    truth = rigid(torch.tensor([[0.1, -0.4, 0.2]], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64))
    direction = torch.nn.functional.normalize(torch.tensor([[2.0, 1, -1]], dtype=torch.float64))
    vector, translation = (size * direction).requires_grad_(), (size * direction).requires_grad_()

    def errors(vector: torch.Tensor, translation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        between = rigid(vector, torch.zeros_like(translation))
        moved = truth.clone() @ between
        return pose_errors(torch.cat([moved[:, :, :3], rigid(vector, translation)[:, :, 3:]], dim=2), truth,
                           torch.tensor([True]))  # fmt: skip

    assert torch.autograd.gradcheck(errors, (vector, translation), eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, math.pi])
def test_gradients_of_a_quaternion_are_numbers_at_both_ends(angle: float) -> None:
    quaternion = torch.tensor([[math.cos(angle / 2), 0, math.sin(angle / 2), 0]]).requires_grad_()
    moved = geometry.compose_rigid(quaternion, torch.zeros(1, 3))
    sum(pose_errors(moved, torch.eye(4)[None], torch.tensor([True]))).backward()  # type: ignore[union-attr]
    assert quaternion.grad is not None and quaternion.grad.isfinite().all()


def test_unknown_poses_count_as_nothing_and_halves_average_to_the_whole() -> None:
    torch.manual_seed(0)
    moved, truth = rigid(torch.randn(4, 3), torch.randn(4, 3)), rigid(torch.randn(4, 3), torch.randn(4, 3))
    known = torch.tensor([True, False, True, True])
    whole = torch.stack(pose_errors(moved, truth, known))
    halves = [torch.stack(pose_errors(moved[s], truth[s], known[s])) for s in (slice(0, 2), slice(2, 4))]
    torch.testing.assert_close(torch.stack(halves).mean(dim=0), whole)
    assert not torch.stack(pose_errors(moved, truth, torch.zeros(4, dtype=torch.bool))).any()
    single = torch.stack(pose_errors(moved[:1], truth[:1], known[:1]))
    assert number(pose_errors(moved, truth, torch.tensor([True, False, False, False]))[0]) == pytest.approx(
        number(single[0]) / 4
    )


@pytest.mark.parametrize("further", ["forecast", "truth"])
def test_errors_of_a_path_are_means_over_the_intervals_that_both_have(further: str) -> None:
    torch.manual_seed(0)
    way, truth = (rigid(torch.randn(6, 3), torch.randn(6, 3)).unflatten(0, (2, 3)) for _ in range(2))
    short = {"forecast": (way, truth[:, :2]), "truth": (way[:, :2], truth)}[further]
    for known in (torch.tensor([True, True]), torch.tensor([False, True])):
        each = [torch.stack(pose_errors(way[:, i], truth[:, i], known)) for i in range(3)]
        torch.testing.assert_close(torch.stack(path_errors(way, truth, known)), torch.stack(each).mean(dim=0))
        got = torch.stack(path_errors(*short, known))
        torch.testing.assert_close(got, torch.stack(each[:2]).mean(dim=0))


def test_an_interval_learns_from_its_own_truth() -> None:
    """Of three that are forecast, two are known: they learn from both pose terms, and the third learns nothing."""
    torch.manual_seed(0)
    model, prior = Forecaster(SMALL), turning(BATCH, HEIGHT, WIDTH)
    assert isinstance(model.ego_motion, EgoMotion) and model.ego_motion.swayed is not None
    batch = batch_of(torch.rand(BATCH, 3, HEIGHT, WIDTH), torch.eye(4).repeat(BATCH, 1, 1), [True, True])
    batch = batch._replace(path_from_cur=torch.eye(4).repeat(BATCH, 2, 1, 1))
    step = model.forecast(batch.frame_prev, batch.frame_cur, batch.K, views=[], mode="compose", prior=prior)[0]
    assert step.path_from_cur.shape == (BATCH, 3, 4, 4)
    config = settings(pose={"rotation": 1.0, "translation": 1.0})
    total_loss(None, step, batch, config, None)[0].backward()
    for weight in (model.ego_motion.motion.weight, model.ego_motion.swayed.weight):
        assert weight.grad is not None
        assert [bool(grad.any()) for grad in weight.grad.split(6)] == [True, True, False]


@pytest.mark.parametrize(("side", "levels"), [(metrics.WINDOW, 1), (43, 2), (44, 3), (100, 4), (176, 5), (400, 5)])
def test_ssim_is_zero_for_equal_images_and_takes_the_levels_that_fit(side: int, levels: int) -> None:
    torch.manual_seed(0)
    image, other = torch.rand(1, 3, side, side + 20), torch.rand(1, 3, side, side + 20)
    assert number(ssim_loss(image, image)) == pytest.approx(0, abs=1e-6)
    weights, wanted, pair = metrics.LEVEL_WEIGHTS[:levels], 1.0, [image, other]
    for weight in weights:
        wanted -= weight / sum(weights) * number(metrics.ssim(pair[0], pair[1]).mean())
        pair = [torch.nn.functional.avg_pool2d(x, 2) for x in pair]
    assert number(ssim_loss(image, other)) == pytest.approx(wanted, abs=1e-6)


def test_ssim_has_a_gradient_where_ms_ssim_has_none() -> None:
    """Inverted images have negative structure, which MS-SSIM's powers can't take."""
    torch.manual_seed(0)
    target = torch.rand(1, 3, 64, 64)
    image = (1 - target).requires_grad_()
    ssim_loss(image, target).backward()
    assert image.grad is not None and image.grad.isfinite().all() and image.grad.any()
    with pytest.raises(ValueError, match="11 or more"):
        ssim_loss(target[..., :10], target[..., :10])


def test_residual_motion_by_hand() -> None:
    _, _, step, batch = forecast()
    assert number(residual_motion(step, batch)) == 0
    flow = step.motion.start.clone()
    flow[:, 0] += 3.0  # previous frame's x
    flow[:, 2] += 4.0  # and z: 5 m together; the current frame stays
    near = batch.frame_prev.depth.clone()
    near[0] = NEAREST / 10
    moved = step._replace(motion=step.motion._replace(objects=step.motion.objects._replace(flow=flow)))
    changed = batch._replace(frame_prev=batch.frame_prev._replace(depth=near))
    wanted = 5 / near.clamp(min=NEAREST)
    assert number(residual_motion(moved, changed)) == pytest.approx(number(wanted.mean()) / 2, rel=1e-5)


def test_the_sum_is_of_the_weighted_terms() -> None:
    _, view, step, batch = forecast(moving=True)
    config = settings(l1=2.0, ssim=0.5, pose={"rotation": 3.0, "translation": 0.25}, residual_motion=7.0)
    total, terms = total_loss(view, step, batch, config, None)
    weights = {"l1": 2.0, "ssim": 0.5, "rotation": 3.0, "translation": 0.25, "residual_motion": 7.0}
    assert terms.keys() == weights.keys() and not any(term.requires_grad for term in terms.values())
    assert all(number(term) > 0 for term in terms.values())
    assert number(total) == pytest.approx(sum(weights[name] * number(term) for name, term in terms.items()), rel=1e-5)
    assert number(terms["l1"]) == pytest.approx(number((view.image - batch.target).abs().mean()))
    rigid_error = metrics.ego_motion_error(step.future_from_cur, batch.future_from_cur)
    assert number(terms["translation"]) == pytest.approx(number(rigid_error.translation_percent[0]) / 100 / BATCH)


def test_the_truth_costs_nothing() -> None:
    _, view, step, batch = forecast()
    batch = batch._replace(target=view.image.detach(), path_from_cur=step.path_from_cur.detach())
    config = settings(l1=1.0, ssim=1.0, pose={"rotation": 1.0, "translation": 1.0}, residual_motion=1.0)
    assert number(total_loss(view, step, batch, config, None)[0]) == pytest.approx(0, abs=1e-5)


def test_each_term_reaches_the_networks_it_is_about() -> None:
    reached = {}
    losses: dict[str, dict[str, Any]] = {
        "image": {"l1": 1.0}, "structure": {"ssim": 1.0}, "pose": {"pose": {"rotation": 1.0, "translation": 1.0}},
        "residual": {"residual_motion": 1.0},
    }  # fmt: skip
    for name, weights in losses.items():
        model, view, step, batch = forecast(moving=True)
        total_loss(view, step, batch, settings(**weights), None)[0].backward()
        parts = ("encoder", "ego_motion", "object_motion", "refine")
        grads = {part: [p.grad for p in model.get_submodule(part).parameters() if p.grad is not None] for part in parts}
        assert all(grad.isfinite().all() for some in grads.values() for grad in some)
        reached[name] = {part for part, some in grads.items() if any(grad.any() for grad in some)}
    everything = {"encoder", "ego_motion", "object_motion", "refine"}
    assert reached["image"] == reached["structure"] == everything
    assert reached["pose"] == {"encoder", "ego_motion"}
    assert {"object_motion", "encoder"} <= reached["residual"] and "refine" not in reached["residual"]


def test_images_beyond_the_range_are_pulled_back() -> None:
    _, view, step, batch = forecast()
    image = torch.full_like(view.image, 1.5).requires_grad_()
    total, _ = total_loss(view._replace(image=image), step, batch, settings(l1=1.0), None)
    total.backward()
    assert image.grad is not None and (image.grad > 0).all()


def test_no_terms_at_all_is_zero() -> None:
    _, view, step, batch = forecast()
    assert number(total_loss(view, step, batch, settings(), None)[0]) == 0


def test_vgg_from_a_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    path = tmp_path / "vgg19.pth"
    torch.save(Trunk("vgg19").state_dict(), path)
    config = settings(perceptual={"kind": "vgg19", "weights": path, "weight": 0.5})
    perceptual = build_perceptual(config)
    assert isinstance(perceptual, VggLoss) and not any(p.requires_grad for p in perceptual.parameters())
    _, view, step, batch = forecast()
    image = view.image.detach().requires_grad_()
    total, terms = total_loss(view._replace(image=image), step, batch, config, perceptual)
    assert number(total) == pytest.approx(0.5 * number(terms["perceptual"])) and number(total) > 0
    total.backward()
    assert image.grad is not None and image.grad.any()
    same = batch._replace(target=view.image.detach())
    assert number(total_loss(view, step, same, config, perceptual)[0]) == 0
    with pytest.raises(ValueError, match="`perceptual` must be"):
        total_loss(view, step, batch, config, None)


def test_squeeze_with_the_public_weights_grows_with_noise() -> None:
    path = real("squeezenet/squeezenet_v1.0.npz")
    perceptual = build_perceptual(settings(perceptual={"kind": "squeeze", "weights": path}))
    assert perceptual is not None
    torch.manual_seed(0)
    image = torch.rand(1, 3, 32, 48)
    near, far = (perceptual(image + size * torch.rand_like(image), image) for size in (0.05, 0.5))
    assert 0 < number(near) < number(far) and number(perceptual(image, image)) == 0


def test_none_and_weight_zero_need_no_file(tmp_path: Path) -> None:
    assert build_perceptual(settings()) is None
    assert build_perceptual(settings(perceptual={"kind": "squeeze", "weight": 0.0})) is None
    with pytest.raises(FileNotFoundError, match="no squeezenet1_0 weights"):
        build_perceptual(settings(perceptual={"kind": "squeeze", "weights": tmp_path / "none.npz"}))


def test_shapes_are_checked() -> None:
    _, view, step, batch = forecast()
    with pytest.raises(ValueError, match="`target` must be"):
        total_loss(view, step, batch._replace(target=batch.target[..., 1:]), settings(l1=1.0), None)
    with pytest.raises(ValueError, match="`known` must be"):
        pose_errors(step.future_from_cur, batch.future_from_cur, batch.pose_known[:1])


def test_routing_is_held_to_its_budget() -> None:
    """By the formula, in stages that render; models that run all blocks have no such term."""
    torch.manual_seed(0)
    routed = dataclasses.replace(TINY, object_motion=dataclasses.replace(OBJECTS, routing=RoutingConfig(4, budget=1.0)))
    model, batch = (
        Forecaster(routed),
        batch_of(torch.rand(2, 3, HEIGHT, WIDTH), torch.eye(4).repeat(2, 1, 1), [True] * 2),
    )
    assert isinstance(model.object_motion, ObjectMotion) and model.object_motion.routing is not None
    torch.nn.init.constant_(model.object_motion.routing.choose.bias, 1.0)
    step = model(batch.frame_prev, batch.frame_cur, batch.K)
    probabilities = step.motion.objects.probabilities
    assert probabilities is not None
    wanted = ((probabilities.sum(dim=1).mean() - 1.0) / 2) ** 2
    loss, terms = total_loss(step.views[0], step, batch, settings(routing=0.5), None, 1.0)
    assert number(terms["routing"]) == pytest.approx(number(wanted)) and number(loss) == pytest.approx(
        number(wanted) / 2
    )
    loss.backward()
    assert model.object_motion.routing.choose.bias.grad is not None
    assert (model.object_motion.routing.choose.bias.grad > 0).all()
    for view, budget in ((None, 1.0), (step.views[0], None)):
        assert "routing" not in total_loss(view, step, batch, settings(), None, budget)[1]
