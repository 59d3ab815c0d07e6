"""train.data.windows: the camera's forecast path and the time between frames reach the model, in batches of several
rates."""

import dataclasses
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, stir
from geometric_scenes import turned
from numpy.typing import NDArray
from test_network_input import prepared
from test_train_data import FakeClip
from torch import nn
from train_scenes import MODELS, configured, street

from train.card import tables as card_tables
from train.data import augment
from train.data.windows import Draw, WindowSet, loader
from train.fit import window_set, with_intervals
from train.run.ranks import Ranks
from train.run.trainer import Trainer, build_model
from vestcl import geometry
from vestcl.forecasting.network.input import camera_path, last_motions, network_input
from vestcl.models import config
from vestcl.models.config import EgoMotionConfig
from vestcl.models.forecaster import Forecaster
from vestcl.prepare.prepared import PreparedClip
from vestcl.scene.inputs import Inputs
from vestcl.scene.motion.camera_forecast import forecast_camera
from vestcl.scene.perceived import PerceivedFrame

BOUNDED = dataclasses.replace(
    SMALL,
    name="bounded",
    prior="forecast",
    ego_motion=EgoMotionConfig(widths=(8, 8, 8, 8), blocks=1, heads=2, path=3, correction="bounded"),
)


class Driving(FakeClip):
    """A bend that is driven faster and faster; motions are asked for one by one."""

    right_camera = None

    def __init__(self, interval: float | None, frames: int = 9, by_flow: bool = False) -> None:
        super().__init__(frames, name="driving")
        self.interval, self.read = interval, list[int]()
        self.inputs = Inputs("motion", "motion", "optical flow" + ("" if by_flow else " and depth"), "regions")

    def elapsed(self, index: int) -> float:
        return 1.0

    def motion(self, index: int) -> NDArray[np.float64]:
        """cur_from_prev."""
        return turned(0.001 * index, 0.004 * index, 0.0, (0.01, 0.0, -0.5 - 0.05 * index))

    def prev_from_cur(self, index: int) -> NDArray[np.float64]:
        self.read.append(index)
        return np.asarray(np.linalg.inv(self.motion(index)), np.float64)

    def frame(self, index: int) -> PerceivedFrame:
        return prepared(index, self.motion(index) if index else None)


def windows(*clips: Driving, **settings: Any) -> WindowSet:
    settings = {"horizons": (0.5, 0.0, 0.5), "prior": "forecast"} | settings
    return WindowSet(cast(list[PreparedClip], list(clips)), **settings)


def test_the_prior_is_the_forecast_path() -> None:
    """Of the last four motions, per clip's own interval: to each of the horizons."""
    for interval in (1 / 30, 0.125):
        clip = Driving(interval)
        prior = windows(clip).batch([Draw(0, 5, 1, False, (0,))]).prior
        motions = [clip.motion(i) for i in (2, 3, 4, 5)]
        wanted = forecast_camera(motions, [interval] * 4, [interval * k for k in (1, 2, 3)])
        got = np.eye(4)
        for k in range(3):
            got = _matrix(prior.camera.interval(k)) @ got
            np.testing.assert_allclose(got, wanted[k], atol=1e-5)
        assert prior.seconds is not None and prior.seconds.item() == pytest.approx(interval)
        assert prior.measured is not None
        speeds = prior.measured[0, :, 5]
        assert speeds.tolist() == pytest.approx([motion[2, 3] / interval for motion in motions], rel=1e-5)


def _matrix(motion: Any) -> NDArray[np.float64]:
    return np.asarray(geometry.compose_rigid(*motion)[0].double().numpy())


def test_a_batch_of_8_and_30_hertz_has_each_samples_interval() -> None:
    """And each clip's last two frames only have two motions: constant velocity with what is known."""
    clips = Driving(1 / 30), Driving(1 / 8), Driving(None)
    draws = [Draw(0, 5, 3, False, (0,)), Draw(1, 1, 3, False, (1,)), Draw(2, 2, 3, False, (2,))]
    prior = windows(*clips).batch(draws).prior
    assert prior.seconds is not None and prior.seconds.tolist() == pytest.approx([1 / 30, 1 / 8, 0.1])
    assert prior.measured is not None and prior.measured[:, :, -1].sum(dim=1).tolist() == [4, 1, 2]
    assert prior.later is not None and prior.later.translation.shape == (3, 2, 3)
    steady = prior.camera
    for k in (0, 1, 2):  # of one motion: its yaw and its translation
        shift = steady.interval(k).translation[1]
        torch.testing.assert_close(shift, torch.from_numpy(clips[1].motion(1)[:3, 3]).float(), atol=1e-5, rtol=0)


def test_no_motion_comes_from_frames_that_are_left_out() -> None:
    """Of frames 4 ... 8 only: the motion into frame 4 rests on the one before, as all that was measured in it."""
    clip = Driving(0.1)
    windows(clip, horizons=(1.0,), frames=(4, 8)).batch([Draw(0, 5, 1, False, (0,))])
    assert sorted(set(clip.read)) == [4, 5]


def test_without_depth_rotations_count_as_from_flow() -> None:
    paths = [windows(Driving(0.1, by_flow=by_flow)).batch([Draw(0, 5, 1, False, (0,))]).prior for by_flow in (0, 1)]
    assert not torch.equal(paths[0].next_from_cur.quaternion, paths[1].next_from_cur.quaternion)


def test_the_mirrored_path() -> None:
    """As if the mirrored motions had been forecast, rates included."""
    clip = Driving(0.1)
    window = windows(clip).window(Draw(0, 5, 1, False, (0,)))
    assert window.path is not None
    mirrored = augment.flip(window).path
    assert mirrored is not None
    mirror = np.diag([-1.0, 1, 1, 1])
    wanted = camera_path([mirror @ clip.motion(i) @ mirror for i in (2, 3, 4, 5)], [1.0] * 4, 0.1, 3)
    for got, pose in zip(mirrored.future_from_cur, wanted.future_from_cur, strict=True):
        np.testing.assert_allclose(got, pose, atol=1e-7)
    np.testing.assert_allclose(mirrored.measured, wanted.measured, atol=1e-5)


def test_models_of_constant_velocity_see_what_they_saw() -> None:
    clip = Driving(0.1)
    prior = windows(clip, prior="velocity").batch([Draw(0, 5, 1, False, (0,))]).prior
    assert prior.camera.intervals == 1
    wanted = network_input(clip.frame(4), clip.frame(5), last_motions(clip.frame(4), clip.frame(5))).prior
    for got, motion in zip(prior.next_from_cur, wanted.next_from_cur, strict=True):
        assert torch.equal(got, motion)


def test_the_configuration_has_the_intervals_of_all_stages() -> None:
    """A range only where EMF knows the time; what it did not learn at is not corrected."""
    fast, slow = windows(Driving(1 / 30), Driving(1 / 25)), windows(Driving(0.125))
    learned = with_intervals(with_intervals(BOUNDED, fast), slow)
    assert learned.intervals_s == pytest.approx((1 / 30, 0.125), abs=1e-6) and learned.interval_s == 0.125
    assert learned.knows(0.1) and learned.knows(1 / 30) and not learned.knows(0.2) and not learned.knows(0.02)
    assert learned.learned_at == "0.0333 to 0.125 s"
    assert with_intervals(SMALL, fast).intervals_s is None
    assert with_intervals(BOUNDED, slow).learned_at == "0.125 s"


# ---------------------------------------------------------------- training


@pytest.fixture(autouse=True)
def _models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "CONFIGS", {**MODELS, "bounded": BOUNDED})


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street(tmp_path_factory)


def test_an_update_opens_the_gate(cache: Path, tmp_path: Path) -> None:
    """From a real cache, by the loss of poses; all of EMF learns from the second step on."""
    stage = {"name": "pose", "steps": 4, "batch": 2, "learning_rate": 1e-2, "train": ["ego_motion"], "render": False}
    settings = configured(
        cache, tmp_path, model="bounded", stages=[stage], loss={"pose": {"rotation": 10.0, "translation": 1.0}}
    )
    data = window_set(settings.data, BOUNDED.prior)
    batches = list(loader(data, 0, 2, range(3)))
    assert all(batch.prior.later is not None for batch in batches)
    model = build_model(settings)
    assert model.ego_motion is not None and model.ego_motion.bounded is not None
    before = {name: parameter.clone() for name, parameter in model.ego_motion.named_parameters()}
    trainer = Trainer(settings, settings.stages[0], model, None, Ranks())
    for batch in batches:
        trainer.update(batch)
    assert not model.ego_motion.bounded.changes_nothing
    assert all(not torch.equal(before[name], parameter) for name, parameter in model.ego_motion.named_parameters())


def test_old_weights_start_a_network_of_the_new_kind(cache: Path, tmp_path: Path) -> None:
    """All that fits is taken; the last layers of EMF are new, with closed gates. The file says of which kind it is."""
    old = stir(Forecaster(dataclasses.replace(SMALL, name="bounded")))
    nn.init.normal_(old.refine.out.weight, std=0.05)
    old.save(tmp_path / "old.safetensors")
    model = build_model(configured(cache, tmp_path, model="bounded", init=str(tmp_path / "old.safetensors")))
    assert model.ego_motion is not None and model.ego_motion.bounded is not None and old.ego_motion is not None
    assert model.ego_motion.bounded.changes_nothing
    assert torch.equal(model.ego_motion.frame[0].weight, old.ego_motion.frame[0].weight)
    assert torch.equal(model.refine.out.weight, old.refine.out.weight)
    model.config = with_intervals(model.config, windows(Driving(1 / 30), Driving(0.125)))
    model.save(tmp_path / "new.safetensors")
    for name, kind in (("old", ("velocity", "linear")), ("new", ("forecast", "bounded"))):
        loaded = Forecaster.load(tmp_path / f"{name}.safetensors").config
        assert loaded.ego_motion is not None and (loaded.prior, loaded.ego_motion.correction) == kind
        assert (loaded.intervals_s is None) == (name == "old")


def test_a_card_says_what_the_camera_starts_from() -> None:
    assert card_tables._camera(SMALL) == card_tables._camera(MODELS["small-painting"]) == ""
    learned = dataclasses.replace(BOUNDED, intervals_s=(1 / 30, 0.125))
    wanted = " and the camera's forecast path, corrected by what a car can do in 0.0333 to 0.125 s between frames"
    assert card_tables._camera(learned) == wanted
