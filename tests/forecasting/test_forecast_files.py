"""A forecast written and read back, file by file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vestcl import __version__, opencl
from vestcl.data.calibration import translation
from vestcl.data.sample import Clip, RightCamera, Sample
from vestcl.data.sources import ImageArray
from vestcl.forecasting.files import Details, machine, read_forecast, write_forecast
from vestcl.forecasting.result import Forecast, Rendered, SkippedWork, View
from vestcl.forecasting.views import parse_views
from vestcl.io.images import to_float
from vestcl.io.video.reading import Video

HEIGHT, WIDTH = 24, 40
K = np.array([[40.0, 0, 20], [0, 40, 12], [0, 0, 1]])


def make_clip(frames: int = 3, fps: float | None = 20.0) -> Clip:
    """Frame i is grey of level i / 10."""
    samples = []
    for i in range(frames):
        image = np.full((3, HEIGHT, WIDTH), i / 10, np.float32)
        sample = Sample.from_arrays(f"{i:04}", image, K, timestamp=None if fps is None else i / fps)
        samples.append(replace(sample, right=RightCamera(ImageArray(image), K, translation((-0.5, 0, 0)))))
    return Clip("clip", "arrays", tuple(samples))


def make_forecast(views: list[View], steps: int = 2) -> Forecast:
    """Noise, another in every image; colours of 8 bits, which PNG keeps."""
    rng = np.random.default_rng(0)

    def rendered() -> Rendered:
        image = to_float(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
        planes = [rng.random((channels, HEIGHT, WIDTH), np.float32) for channels in (1, 1, 3)]
        return Rendered(image, *planes)

    poses = [translation((0, 0, -0.5 * step)) for step in range(1, steps + 1)]
    frames = [{view.name: rendered() for view in views} for _ in range(steps)]
    return Forecast("noise", poses, frames, {"think": 1.5})


def test_round_trip(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source", "right", "0,0,1,yaw=90"], clip)
    forecast = make_forecast(views)
    sheet = np.full((9, 9, 3), 7, np.uint8)
    scores = {"right": {"forecast": [{"psnr": np.float32(20.5)}, {"psnr": float("inf")}]}}
    details = Details("some/clip", {"out": tmp_path, "view": ("right",)}, scores, {"right": sheet})
    path = write_forecast(tmp_path, forecast, clip, 2, views, details)
    saved = read_forecast(tmp_path)
    assert path == tmp_path / "forecast.json"
    for view, known in zip(saved.views, views, strict=True):
        assert view.name == known.name
        assert view.K is not None
        assert np.array_equal(view.tgt_from_next, known.tgt_from_next)
        assert np.array_equal(view.K, K)
        for step, frame in enumerate(forecast.frames, start=1):
            rendered, exr = frame[view.name], saved.frame(step, view.name)
            assert np.array_equal(saved.image(step, view.name), rendered.image)
            assert exr.image is not None
            assert np.allclose(exr.image, rendered.image, atol=1e-6)
            kept = ((exr.depth, rendered.depth), (exr.coverage, rendered.coverage), (exr.motion, rendered.motion_xyz))
            assert all(read is not None and np.array_equal(read, written) for read, written in kept)
    for got, wanted in zip(saved.future_from_cur, forecast.future_from_cur, strict=True):
        assert np.array_equal(got, wanted)
    about = saved.about
    assert about["input"] == "some/clip"
    assert about["clip"] == {"name": "clip", "kind": "arrays", "frames": 3}
    assert about["frame"] == {"index": 2, "name": "0002"}
    assert [about[name] for name in ("height", "width", "fps", "method", "steps")] == [HEIGHT, WIDTH, 20, "noise", 2]
    assert about["settings"] == {"out": str(tmp_path), "view": ["right"]}
    assert about["scores"] == {"right": {"forecast": [{"psnr": 20.5}, {"psnr": None}]}}
    assert about["seconds"]["think"] == 1.5
    assert about["seconds"]["write the files"] > 0
    with Image.open(tmp_path / about["views"]["right"]["sheet"]) as picture:
        assert np.array_equal(np.asarray(picture), sheet)


def test_what_a_network_skipped_is_reported(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    skipped = {"seen": SkippedWork(1, 2, "frames", 0.25), "covered": SkippedWork(9000, 10_000, "points", None)}
    forecast = replace(make_forecast(views), profile={"encode": 0.5}, skipped=skipped)
    write_forecast(tmp_path, forecast, clip, 1, views, Details(""))
    about = read_forecast(tmp_path).about
    assert about["profile"] == {"encode": 0.5}
    assert about["skipped"] == {
        "seen": {"skipped": 1, "of": 2, "unit": "frames", "saved_seconds": 0.25, "share": 0.5},
        "covered": {"skipped": 9000, "of": 10_000, "unit": "points", "saved_seconds": None, "share": 0.9},
    }
    reported = [str(SkippedWork(**{key: one[key] for key in SkippedWork._fields})) for one in about["skipped"].values()]
    assert reported == ["50 % of 2 frames, about 0.25 s", "90 % of 10,000 points"]
    write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details(""))
    assert not {"profile", "skipped"} & set(read_forecast(tmp_path).about)


def test_every_file_that_is_listed_exists_and_no_other(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source", "right"], clip)
    write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details(""), gif=True)
    reported = {"forecast.json"}
    for view in read_forecast(tmp_path).about["views"].values():
        reported |= {view["video"], view["gif"], *(file for frame in view["frames"] for file in frame.values())}
    there = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert there == reported
    assert len(there) == 1 + 2 * (1 + 1 + 4)


def test_a_matrix_row_is_a_line(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    text = write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details("")).read_text()
    assert "[40.0, 0.0, 20.0],\n" in text
    assert json.loads(text)["K"] == K.tolist()


def test_videos_of_the_source_begin_with_the_past(tmp_path: Path) -> None:
    clip = make_clip(frames=7)
    views = parse_views(["source", "right"], clip)
    write_forecast(tmp_path, make_forecast(views), clip, 5, views, Details(""), gif=True)
    about = read_forecast(tmp_path).about
    assert about["views"]["source"]["context_frames"] == 4
    assert about["views"]["right"]["context_frames"] == 0
    video = Video(tmp_path / "source" / "forecast.mp4")
    assert (len(video), video.fps) == (4 + 2, 20)
    levels = [float(video[i].mean()) for i in range(4)]
    assert np.allclose(levels, np.array([2, 3, 4, 5]) / 10 * 255, atol=6)  # the codec is lossy, but frames are 25 apart
    assert len(Video(tmp_path / "right" / "forecast.mp4")) == 2
    for name, frames in (("source", 6), ("right", 2)):
        with Image.open(tmp_path / name / "forecast.gif") as gif:
            assert gif.n_frames == frames  # type: ignore[attr-defined]
            assert gif.info["duration"] == 50


def test_ten_frames_per_second_where_the_clip_has_none(tmp_path: Path) -> None:
    clip = make_clip(fps=None)
    views = parse_views(["right"], clip)
    write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details(""))
    about = read_forecast(tmp_path).about
    assert (about["fps"], about["interval_s"], about["notes"]) == (10, None, [])
    assert Video(tmp_path / "right" / "forecast.mp4").fps == 10


def test_without_exr(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["right"], clip)
    forecast = make_forecast(views)
    write_forecast(tmp_path, forecast, clip, 1, views, Details(""), exr=False)
    saved = read_forecast(tmp_path)
    assert not list(tmp_path.rglob("*.exr"))
    assert np.array_equal(saved.image(2, "right"), forecast.frames[1]["right"].image)
    with pytest.raises(ValueError, match="was written without OpenEXR; `image` reads the colour"):
        saved.frame(1, "right")


def test_an_earlier_forecast_is_replaced_and_what_else_is_there_stays(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source", "right"], clip)
    long = make_forecast(views, steps=3)
    write_forecast(tmp_path, long, clip, 1, views, Details(""))
    (tmp_path / "notes.txt").write_text("mine")
    short = make_forecast(views[:1], steps=1)
    write_forecast(tmp_path, short, clip, 1, views[:1], Details(""))
    saved = read_forecast(tmp_path)
    assert [view.name for view in saved.views] == ["source"]
    assert np.array_equal(saved.image(1, "source"), short.frames[0]["source"].image)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "source" / "000003.png").is_file()
    assert (tmp_path / "right" / "000001.exr").is_file()


def test_what_was_not_finished_is_no_forecast(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    forecast = make_forecast(views)
    write_forecast(tmp_path, forecast, clip, 1, views, Details(""))
    damaged = replace(forecast.frames[1]["source"], image=np.full((3, HEIGHT, WIDTH), np.nan, np.float32))
    broken = replace(forecast, frames=[forecast.frames[0], {"source": damaged}])
    with pytest.raises(ValueError, match="`image` must not have NaN"):
        write_forecast(tmp_path, broken, clip, 1, views, Details(""))
    with pytest.raises(ValueError, match=r"forecast\.json: No such file"):
        read_forecast(tmp_path)


def test_report_rises_to_one(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source", "right"], clip)
    shares: list[float] = []
    write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details(""), report=shares.append)
    assert shares == [0.5, 1]


def test_machine_reports_what_is_in_use(session: opencl.Session) -> None:
    reported = machine()
    assert reported["versions"]["vestcl"] == __version__
    assert all(reported["versions"][name] for name in ("python", "numpy", "torch", "opencv", "pyopencl"))
    assert reported["device"]["name"] == session.info.name
    assert reported["device"]["driver"] == session.info.driver


def test_mistakes_are_reported(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source", "right"], clip)
    forecast = make_forecast(views)
    up = View("../up", np.eye(4))
    for changed, index, shown, message in (
        (forecast, 3, views, "`index` must be 0 ... 2, got 3"),
        (forecast, 1, [], "must have a frame and a view, got 2 and 0"),
        (replace(forecast, frames=[], future_from_cur=[]), 1, views, "must have a frame and a view, got 0 and 2"),
        (replace(forecast, future_from_cur=[np.eye(4)]), 1, views, "a pose for each of 2 frames, got 1"),
        (make_forecast(views[:1]), 1, views, r"must have view 'right' at t\+1, got source"),
        (forecast, 1, [up], r"got '\.\./up'"),
    ):
        with pytest.raises(ValueError, match=message):
            write_forecast(tmp_path / "out", changed, clip, index, shown, Details(""))
    assert not (tmp_path / "out").exists()


def test_reading_mistakes_are_reported(tmp_path: Path) -> None:
    clip = make_clip()
    views = parse_views(["source"], clip)
    write_forecast(tmp_path, make_forecast(views), clip, 1, views, Details(""))
    saved = read_forecast(tmp_path)
    with pytest.raises(ValueError, match="`view` must be one of source, got 'right'"):
        saved.image(1, "right")
    for step in (0, 3):
        with pytest.raises(ValueError, match=rf"`step` must be 1 \.\.\. 2, got {step}"):
            saved.frame(step, "source")
    (tmp_path / "forecast.json").write_text("{")
    with pytest.raises(ValueError, match=r"forecast\.json: is not JSON"):
        read_forecast(tmp_path)
    (tmp_path / "forecast.json").write_text('{"format": "vestcl forecast 0"}')
    with pytest.raises(ValueError, match="must have the format 'vestcl forecast 1'"):
        read_forecast(tmp_path)
