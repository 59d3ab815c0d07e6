"""Forecasts whose scores are known: the truth itself, and a static street."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from vestcl.data.calibration import translation
from vestcl.data.resize import resize_image
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import ImageArray
from vestcl.evaluation import metrics
from vestcl.evaluation.compare import FLOW, FORECAST, ORACLE, OTHER_CAMERA, REPEAT, compare, comparison_sheet
from vestcl.evaluation.perceptual import squeeze_distance
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.forecasting.views import parse_views

HEIGHT, WIDTH = 32, 48
K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((3, HEIGHT, WIDTH), np.float32)


def make_clip(frames: int = 4, still: bool = False) -> Clip:
    """Left frame i is noise of seed i, the right one of seed 100 + i."""
    samples = []
    for i in range(frames):
        left, right = (noise(side + (0 if still else i)) for side in (0, 100))
        camera = RightCamera(ImageArray(right), K, translation((-0.5, 0, 0)))
        samples.append(replace(Sample.from_arrays(f"{i:04}", left, K), right=camera))
    return Clip("clip", "arrays", tuple(samples))


def make_forecast(views: list[View], images: list[np.ndarray]) -> Forecast:
    empty = np.zeros((1, HEIGHT, WIDTH), np.float32)
    frames = [{view.name: Rendered(image, empty, empty, empty.repeat(3, 0)) for view in views} for image in images]
    return Forecast("made up", [np.eye(4)] * len(images), frames)


def test_each_view_is_held_against_its_own_camera() -> None:
    clip = make_clip()
    views = parse_views(["source", "0,0,1", "right"], clip)
    source, right = compare(make_forecast(views, [noise(102), noise(103)]), clip, 1, views)
    assert (source.view, right.view) == ("source", "right")
    assert (source.stereo, right.stereo) == (False, True)
    for step in (0, 1):
        assert np.array_equal(source.truth[step], noise(2 + step))
        assert np.array_equal(right.truth[step], noise(102 + step))
        assert right.scores[FORECAST][step] == {"psnr": float("inf"), "ssim": pytest.approx(1)}
        for method, image in ((FORECAST, noise(102 + step)), (REPEAT, noise(1))):
            pair = (metrics.quantise(torch.from_numpy(array)[None]) for array in (image, noise(2 + step)))
            assert source.scores[method][step]["psnr"] == pytest.approx(float(metrics.psnr(*pair)))
        assert np.array_equal(right.images[REPEAT + OTHER_CAMERA][step], noise(1))
    assert list(right.images) == [FORECAST, REPEAT + OTHER_CAMERA, FLOW + OTHER_CAMERA, ORACLE]
    assert list(source.scores) == [FORECAST, REPEAT, FLOW]


def test_the_oracle_has_the_right_cameras_past() -> None:
    """A static rig: of the right camera's image its own last frame is right, the left one's is not."""
    clip = make_clip(still=True)
    (right,) = compare(make_forecast(views := parse_views(["right"], clip), [noise(9)]), clip, 1, views)
    assert right.scores[ORACLE][0]["psnr"] > 40 and right.scores[FLOW + OTHER_CAMERA][0]["psnr"] < 10


def test_scores_are_taken_at_the_size_asked_for() -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    (comparison,) = compare(make_forecast(views, [noise(1)]), clip, 1, views, size=(16, 24))
    pair = [metrics.quantise(torch.from_numpy(resize_image(noise(seed), 16, 24))[None]) for seed in (1, 2)]
    assert comparison.scores[FORECAST][0]["psnr"] == pytest.approx(float(metrics.psnr(*pair)))
    assert comparison.images[FORECAST][0].shape == comparison.truth[0].shape == (3, HEIGHT, WIDTH)


def test_a_static_street_is_repeated() -> None:
    clip = make_clip(still=True)
    views = parse_views(["source"], clip)
    (comparison,) = compare(make_forecast(views, [noise(9)]), clip, 2, views)
    assert comparison.scores[REPEAT][0]["psnr"] == float("inf")
    assert comparison.scores[FLOW][0]["psnr"] > 40
    assert comparison.scores[FORECAST][0]["psnr"] < 10


def test_the_clip_may_end_before_the_forecast() -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    (comparison,) = compare(make_forecast(views, [noise(3), noise(4), noise(5)]), clip, 2, views)
    assert len(comparison.truth) == 1
    assert {len(steps) for steps in comparison.scores.values()} == {1}


def test_metrics_are_those_that_the_size_allows() -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    side = metrics.MS_SSIM_SIDE
    big = clip.resized(side, side)
    forecast = make_forecast(views, [big[2].read_image()])
    (comparison,) = compare(forecast, big, 1, views)
    assert comparison.scores[FORECAST][0] == {"psnr": float("inf"), "ssim": pytest.approx(1), "ms_ssim": 1}


def test_squeeze_distance() -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    trunk = Trunk("squeezenet1_0").eval()
    (comparison,) = compare(make_forecast(views, [noise(2)]), clip, 1, views, trunk)
    assert comparison.scores[FORECAST][0]["squeeze"] == pytest.approx(0, abs=1e-9)
    last, truth = (metrics.quantise(torch.from_numpy(noise(seed))[None]) for seed in (1, 2))
    wanted = float(squeeze_distance(last, truth, trunk).detach())
    assert wanted > 0
    assert comparison.scores[REPEAT][0]["squeeze"] == pytest.approx(wanted, rel=1e-4)


def test_report_rises_to_one() -> None:
    clip = make_clip()
    views = parse_views(["source", "right"], clip)
    shares: list[float] = []
    compare(make_forecast(views, [noise(2), noise(3)]), clip, 1, views, report=shares.append)
    assert shares == [0.5, 1]


def test_sheet_has_a_row_a_step_and_a_black_error_where_all_is_right() -> None:
    clip = make_clip().resized(64, 600)
    views = parse_views(["source"], clip)
    (comparison,) = compare(make_forecast(views, [clip[2].read_image(), clip[2].read_image()]), clip, 1, views)
    made_sheet = comparison_sheet(comparison)
    width, height, line, gap = 500, round(64 * 500 / 600), 24, 6
    assert made_sheet.shape == (2 * (line + height) + gap + line + gap, 5 * width + 4 * gap, 3)
    left = 2 * (width + gap)
    right_one = made_sheet[line : line + height, left : left + width]
    wrong_one = made_sheet[2 * line + height + gap : 2 * (line + height) + gap, left : left + width]
    assert right_one.max() < 16  # inferno's darkest colour
    assert wrong_one.mean() > 64
    titled = comparison_sheet(comparison, "clip, view source")
    assert titled.shape[0] == made_sheet.shape[0] + line


def test_mistakes_are_reported() -> None:
    clip = make_clip()
    views = parse_views(["source", "0,0,1"], clip)
    forecast = make_forecast(views, [noise(2)])
    for index in (0, 3):
        with pytest.raises(
            ValueError, match=rf"`index` must have a frame before and after it, 1 \.\.\. 2, got {index}"
        ):
            compare(forecast, clip, index, views)
    with pytest.raises(ValueError, match="`views` must have one with a truth"):
        compare(forecast, clip, 1, views[1:])
    lonely = replace(clip, samples=(*clip.samples[:3], replace(clip[3], right=None)))
    right = parse_views(["right"], clip)
    with pytest.raises(ValueError, match="clip: frame 0003 has no image from right"):
        compare(make_forecast(right, [noise(2), noise(3)]), lonely, 1, right)
