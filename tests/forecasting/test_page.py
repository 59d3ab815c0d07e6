"""vestcl.forecasting.page: a page whose images all exist and which loads nothing else, and one video of all views."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from test_forecast_files import make_clip, make_forecast

from vestcl.forecasting.files import Details, write_forecast
from vestcl.forecasting.page import HELD_SECONDS, PAGE, VIDEO, write_page
from vestcl.forecasting.views import parse_views
from vestcl.io.video.reading import Video

SCORES = {"source": {"forecast": [{"psnr": 20.125, "ssim": 0.5}], "<b>flow</b>": [{"psnr": 19.0, "ssim": 0.25}]}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    clip = make_clip(frames=7)
    views, forecast = parse_views(["source", "right"], clip), make_forecast(parse_views(["source", "right"], clip))
    write_forecast(tmp_path, forecast, clip, 5, views, Details(""))
    truth = {"source": [np.zeros_like(forecast.frames[0]["source"].image)]}
    assert write_page(tmp_path, forecast, clip, 5, views, truths=truth, scores=SCORES) == tmp_path / PAGE
    return tmp_path


def entries(folder: Path) -> list[dict]:
    text = (folder / PAGE).read_text()
    found = re.search(r"const views = (.*);\n", text)
    assert found
    return json.loads(found[1])


def test_every_image_exists_and_nothing_is_loaded_from_elsewhere(folder: Path) -> None:
    source, right = entries(folder)
    assert [set(files) for files in source["files"]] == [{"forecast", "truth", "error", "depth"}, {"forecast", "depth"}]
    assert [set(files) for files in right["files"]] == [{"forecast", "depth"}] * 2
    for view in (source, right):
        assert all((folder / path).is_file() for files in view["files"] for path in files.values())
    assert "http" not in (folder / PAGE).read_text()


def test_scores_are_a_table_of_the_step(folder: Path) -> None:
    source, right = entries(folder)
    assert "<td>forecast</td><td>20.12</td><td>0.500</td>" in source["tables"][0]
    assert "&lt;b&gt;flow&lt;/b&gt;" in source["tables"][0] and source["tables"][1] == right["tables"][0] == ""


def test_the_video_shows_what_was_seen_then_the_forecast_and_holds_it(folder: Path) -> None:
    video = Video(folder / VIDEO)
    assert video.fps == 20 and len(video) == 4 + 2 + round(HELD_SECONDS * 20)
    bars = [video[i][18:24].reshape(-1, 3).mean(0) for i in (3, 4)] if video[0].shape[0] > 24 else []
    for (red, _, blue), seen in zip(bars, (True, False), strict=False):
        assert (blue > red) == seen
    assert np.abs(video[5].astype(float) - video[len(video) - 1]).mean() < 2
