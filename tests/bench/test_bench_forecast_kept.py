"""`vestcl bench forecast`: runs that were stopped, lists of windows, networks' rows, and where the error is."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vestcl.bench.forecast import bench
from vestcl.bench.forecast import run as running
from vestcl.bench.forecast.bench import ForecastBench
from vestcl.bench.forecast.run import SUFFIX, Kept
from vestcl.bench.forecast.windows import Facts, groups_of, read_list
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.evaluation.regions import REGIONS, error_shares
from vestcl.evaluation.scores import SOURCE, Record, Truth
from vestcl.forecasting.result import Forecast, Rendered, View

SIZE = 64, 208
TINY: dict[str, Any] = {
    "street_size": SIZE, "height": 64, "width": 208, "steps": 1, "street_frames": 5, "samples": 1, "views": (SOURCE,)
}  # fmt: skip


def window(index: int, psnr: float = 20.0) -> tuple[list[Record], list[Facts]]:
    scores = {"psnr": [psnr, float("inf")], "psnr_seen": [float("nan"), 1.0]}
    return [Record("c", str(index), index, SOURCE, "m", 0.5, scores)], [Facts("c", str(index), index, {"a": [1.0]})]


# ---------------------------------------------------------------- kept windows


def test_windows_are_kept_with_their_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "new" / "scores.windows.jsonl"
    for index in (1, 2):
        Kept(path, {"steps": 2}).add("c", index, window(index, 20.0 + 1e-15))
    again = Kept(path, {"steps": 2})
    assert len(again) == 2 and repr(again.get("c", 2)) == repr(window(2, 20.0 + 1e-15))
    assert again.get("c", 3) is None and again.get("d", 1) is None


def test_other_settings_are_measured_again(tmp_path: Path) -> None:
    path = tmp_path / "scores.windows.jsonl"
    Kept(path, {"steps": 2}).add("c", 1, window(1))
    other = Kept(path, {"steps": 3})
    assert len(other) == 0
    other.add("c", 7, window(7))
    assert len(Kept(path, {"steps": 2})) == 0 and Kept(path, {"steps": 3}).get("c", 7) is not None


@pytest.mark.parametrize("cut", range(1, 200, 13))
def test_a_torn_line_costs_one_window(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "scores.windows.jsonl"
    kept = Kept(path, {})
    for index in (1, 2):
        kept.add("c", index, window(index))
    path.write_bytes(path.read_bytes()[:-cut])
    again = Kept(path, {})
    assert again.get("c", 1) is not None
    again.add("c", 3, window(3))
    last = Kept(path, {})
    assert last.get("c", 1) is not None and last.get("c", 3) is not None


def test_a_stopped_run_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, measured = tmp_path / "scores.json", []
    config = ForecastBench(("street:4",), **TINY, out=out)
    whole = running.forecasts_of

    def stops(*args: Any) -> Any:
        if args[1] == 3:
            raise KeyboardInterrupt
        measured.append(args[1])
        return whole(*args)

    monkeypatch.setattr(running, "forecasts_of", stops)
    with pytest.raises(KeyboardInterrupt):
        bench.main(config)
    assert measured == [1, 2] and not out.exists()
    monkeypatch.setattr(running, "forecasts_of", lambda *args: measured.append(args[1]) or whole(*args))
    bench.main(config)
    assert measured == [1, 2, 3]
    (told,) = json.loads(out.read_text(encoding="utf-8"))["inputs"]
    assert sorted({each["index"] for each in told["windows"]}) == [1, 2, 3] and told["facts"]["rotation_deg"]
    assert not out.with_name(out.name + SUFFIX).exists()


# ---------------------------------------------------------------- lists of windows


def listed(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "windows.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_listed_windows_are_measured(tmp_path: Path) -> None:
    path = listed(tmp_path, {"street 4": {"use": "checked", "frames": [3, 1]}})
    config = ForecastBench(("street:4",), **TINY, windows=path)
    (group,) = groups_of(config)
    assert group.clips[0][1] == [1, 3] and group.use == "checked"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"street 5": {"use": "checked", "frames": [1]}}, "has no windows of street 4, only of street 5"),
        ({"street 4": {"use": "checked", "frames": [1, 4]}}, r"street 4 must have .*, got \[4\]"),
        ({"street 4": {"use": "seen", "frames": [1]}}, "`use` must be tuned or checked, got 'seen'"),
        ({"street 4": {"use": "tuned", "frames": [0]}}, "`frames` must be one or more frames, 1 or later"),
        ({"street 4": {"frames": [1]}}, "must have `use` and `frames`"),
        ([], "must be an object, by clip, got list"),
    ],
)
def test_wrong_lists(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        groups_of(ForecastBench(("street:4",), **TINY, windows=listed(tmp_path, content)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"windows": Path("w.json"), "every": 2}, "can't be combined with first, last or every"),
        ({"quality": "fast"}, "`quality` is of networks"),
        ({"windows": Path("missing.json")}, "missing.json: no such file"),
    ],
)
def test_options_that_do_not_fit(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        bench.main(ForecastBench(("street:4",), **TINY, **settings))


def test_the_repository_lists_windows_of_real_clips() -> None:
    clips = read_list(Path(__file__).parents[2] / "docs" / "windows.json")
    assert len(clips) >= 7 and {each.use for each in clips.values()} == {"tuned", "checked"}


# ---------------------------------------------------------------- rows and regions


def test_networks_and_several_clips_share_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scores.json"
    settings = TINY | {"street_frames": 3}
    bench.main(ForecastBench(("street:4", "street:5"), **settings, model=("vest-s",), quality="fast", out=out))
    printed, results = capsys.readouterr().out, json.loads(out.read_text(encoding="utf-8"))
    assert [each["input"] for each in results["inputs"]] == ["street:4", "street:5"]
    assert all("vest-s" in each["views"][SOURCE] for each in results["inputs"])
    assert "all inputs, view source" in printed and "street:5: vest-s" in printed
    assert "share of squared error, holes" in printed


def test_error_shares_by_construction() -> None:
    """Five columns of a picture, one a region: the camera moves 1 m ahead, objects 1 m more."""
    width, K = 50, np.array([[40.0, 0, 25], [0, 40, 10], [0, 0, 1]])
    truth_image = np.full((3, 20, width), 102 / 255, np.float32)
    samples = [Sample.from_arrays(str(i), truth_image, K) for i in range(2)]
    truth = Truth(Clip("c", "arrays", tuple(samples)), (20, width))
    image, depth = truth_image.copy(), np.full((1, 20, width), 10.0, np.float32)
    image[..., 0:10] += np.float32(51 / 255)  # a hole, a fifth of white
    image[..., 20:30] -= np.float32(51 / 255)  # an object
    coverage = np.ones_like(depth)
    coverage[..., :10] = 0
    depth[..., 10:20], depth[..., 40:] = 10_000, 50
    motion = np.zeros((3, 20, width), np.float32)
    motion[2] = -1
    motion[2, :, 20:30] = 0
    ahead = np.eye(4)
    ahead[2, 3] = -1
    forecast = Forecast("", [ahead], [{SOURCE: Rendered(image, depth, coverage, motion)}])
    shares = error_shares(truth, forecast, 0, View(SOURCE, np.eye(4)))
    for name in REGIONS:
        assert shares[f"area_of_{name}"] == [pytest.approx(0.2)]
        assert shares[f"error_in_{name}"] == [pytest.approx(0.5 if name in ("holes", "objects") else 0, abs=1e-6)]


def test_regions_of_a_street_follow_the_camera() -> None:
    """Most of a street is at rest; sky, near and far ground are all there."""
    clip = street_clip(Street.generate(4), 5, *SIZE, samples=1)
    config = ForecastBench(("street:4",), **TINY)
    (_, facts) = next(running.run_clip(clip, [2], config))
    values = facts[0].values
    assert values["area_of_sky"][0] > 0.02 and values["area_of_near"][0] > 0.1 and values["area_of_objects"][0] < 0.4
    assert sum(values[f"area_of_{name}"][0] for name in REGIONS) == pytest.approx(1)
