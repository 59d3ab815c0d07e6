"""train.evaluation.windows: what one window is given, and how it is scored."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from evaluated_inputs import known_of
from forecaster_scenes import TINY, stir
from st_lpips_weights import public_state

from train.evaluation.inputs import PAIR
from train.evaluation.protocols import NOW, PROTOCOLS
from train.evaluation.windows import CAMERA, Setup, forecast, perceptions_of, prepared, presenters, views_of, window
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.evaluation.perceptual import LPIPS_SCALING, Lpips, StLpips, squeeze_distance
from vestcl.evaluation.scores import GEOMETRIC, SOURCE, Truth
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting import peer
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_view
from vestcl.models.config import configuration
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

SIZE = 48, 160
SOURCE_VIEW = View(SOURCE, np.eye(4))


def street(frames: int = 5, seed: int = 3) -> Clip:
    return street_clip(Street.generate(seed), frames, *SIZE, samples=1)


def setup(**changes: Any) -> Setup:
    wanted: dict[str, Any] = {"protocol": PROTOCOLS["street"], "size": SIZE, "steps": 1, "models": {}}
    return Setup(**(wanted | changes))


def eight_bit(image: np.ndarray) -> torch.Tensor:
    return metrics.quantise(torch.from_numpy(np.ascontiguousarray(image))[None])


def decibels(got: np.ndarray, wanted: np.ndarray) -> float:
    return float(metrics.psnr(eight_bit(got), eight_bit(wanted)))


def test_scores_are_those_of_the_metrics(tmp_path: Path) -> None:
    """Of the geometric forecast's image at t+1; LPIPS, ST-LPIPS and squeeze distance with random weights."""
    torch.manual_seed(0)
    trunk = Trunk("squeezenet1_0").requires_grad_(False).eval()
    alex = Trunk("alexnet", LPIPS_SCALING).requires_grad_(False).eval()
    lpips = Lpips(alex, [torch.rand(channels) for channels in alex.channels])
    torch.save(public_state(), tmp_path / "st.pth")
    st_lpips = StLpips.load(tmp_path / "st.pth")
    clip, networks = street(), {"trunk": trunk, "lpips": lpips, "st_lpips": st_lpips}
    records = window(Perception(clip), Truth(clip, SIZE, **networks), 2, setup(**networks))
    (found,) = [record for record in records if (record.view, record.method) == (SOURCE, GEOMETRIC)]
    made = forecast_frames(Perception(clip), 2, 1, [SOURCE_VIEW])
    pair = eight_bit(made.frames[0][SOURCE].image), eight_bit(clip[3].read_image())
    wanted = {
        "psnr": metrics.psnr(*pair),
        "ssim": metrics.ssim(*pair),
        "lpips": lpips(*pair),
        "st_lpips": st_lpips(*pair),
        "squeeze": squeeze_distance(*pair, trunk),
    }
    for name, value in wanted.items():
        assert found.scores[name] == [pytest.approx(float(value), rel=1e-4)], name


def test_every_window_reports_how_the_camera_moved() -> None:
    clip = street()
    model = stir(Forecaster(TINY)).eval()
    records = window(Perception(clip), Truth(clip, SIZE), 2, setup(models={"tiny": model}))
    by_method = {record.method: record.scores for record in records if record.view == CAMERA}
    assert list(by_method) == ["constant velocity", "tiny"]
    poses = clip[2].world_from_cam, clip[3].world_from_cam
    assert poses[0] is not None and poses[1] is not None
    truth = np.linalg.inv(poses[1]) @ poses[0]
    made = forecast_frames(Perception(clip), 2, 1, [SOURCE_VIEW]).future_from_cur[0]
    path = 100 * np.linalg.norm(made[:3, 3] - truth[:3, 3]) / np.linalg.norm(truth[:3, 3])
    assert by_method["constant velocity"]["translation_percent"] == [pytest.approx(path, rel=1e-6)]
    bare = tuple(dataclasses.replace(sample, world_from_cam=None) for sample in clip)
    clip = dataclasses.replace(clip, samples=bare)
    assert not [r for r in window(Perception(clip), Truth(clip, SIZE), 2, setup()) if r.view == CAMERA]


def test_the_peer_is_a_baseline_without_a_camera_motion() -> None:
    clip, flow = street(), VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).eval()
    records = window(Perception(clip), Truth(clip, SIZE), 2, setup(peer=flow))
    own = {record.view: record for record in records if record.method == peer.METHOD}
    assert set(own) == {SOURCE, "right"}
    made = peer.forecast_frames(Perception(clip), flow, 2, 1, views_of(clip, setup()))
    right = clip[3].right
    assert right is not None
    for name, truth in ((SOURCE, clip[3].read_image()), ("right", right.read_image())):
        assert own[name].scores["psnr"] == [pytest.approx(decibels(made.frames[0][name].image, truth), abs=1e-3)]
    plain = next(record for record in records if (record.view, record.method) == (SOURCE, GEOMETRIC))
    source_only = forecast(Perception(clip), 2, [SOURCE_VIEW], setup(peer=flow))
    assert own["right"].seconds > source_only[peer.METHOD].seconds and plain.seconds > 0


def test_models_are_charged_for_what_was_seen_before_them() -> None:
    clip = street()
    made = forecast(Perception(clip), 2, [SOURCE_VIEW], setup(models={"tiny": Forecaster(TINY).eval()}))
    assert list(made) == [GEOMETRIC, "tiny"]
    plain = made[GEOMETRIC]
    assert made["tiny"].seconds > plain.seconds - plain.forecast.seconds["render"] > 0


@pytest.mark.parametrize("method", [GEOMETRIC, "model"])
def test_the_present_is_what_is_seen(method: str) -> None:
    """From the source camera frame t itself; from the right one closer to what that sees than the source is."""
    clip = street()
    right = dataclasses.replace(parse_view("right", clip), name=NOW)
    model = Forecaster(configuration("vest-s")).eval()  # untrained, it shows the splatted colour
    shown = presenters(setup(models={"model": model}))[method](Perception(clip), 2, [SOURCE_VIEW, right])
    current, camera = clip[2].read_image(), clip[2].right
    assert camera is not None
    assert decibels(shown[SOURCE].image, current) > 30
    assert decibels(shown[NOW].image, camera.read_image()) > decibels(current, camera.read_image()) + 3


def test_clips_as_they_are_evaluated() -> None:
    clip = street()
    half = prepared(clip, setup(size=(24, 80)))
    assert (half[0].height, half[0].width) == (24, 80) and half[0].depth is not None
    np.testing.assert_allclose(half[0].K[:2], clip[0].K[:2] / 2)
    assert list(perceptions_of(clip, setup(stereo=True))) == ["", PAIR]
    pairs = perceptions_of(clip, setup(stereo=True))[PAIR].clip
    assert pairs[0].depth is None and pairs[0].world_from_cam is not None
    assert known_of(clip) == "Depth is from the street itself, true, masks are from labels."
    assert known_of(pairs, ("pair",)) == (
        'Depth is from the stereo pair at t-1 and t (rows ending in "stereo pair"), masks are from labels.'
    )
    blind = [dataclasses.replace(s, depth=None, right=None, labels=None if i else s.labels) for i, s in enumerate(clip)]
    mono = dataclasses.replace(clip, samples=tuple(blind))
    assert known_of(mono, ("motion",)) == "Depth is from motion, masks are from motion."  # labels of one frame only


def test_views_that_a_clip_has() -> None:
    clip = street()
    assert [view.name for view in views_of(clip, setup())] == ["source", "right"]
    mono = dataclasses.replace(clip, samples=tuple(dataclasses.replace(s, right=None) for s in clip))
    assert [view.name for view in views_of(mono, setup())] == ["source"]
    with pytest.raises(ValueError, match="must have a right camera"):
        views_of(mono, setup(protocol=PROTOCOLS["kitti-space-time"]))
