"""vestcl.open and vestcl.forecast: clips, futures as arrays and files, networks by name, folder and repository."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL

import vestcl
from vestcl.forecasting import geometric
from vestcl.forecasting.future import Future
from vestcl.forecasting.result import View
from vestcl.forecasting.views import parse_views
from vestcl.io.ply import read_ply, write_ply
from vestcl.io.video.reading import Video

SIZE = {"height": 48, "width": 160}


@pytest.fixture(scope="module")
def clip() -> vestcl.Clip:
    return vestcl.open("street:3", frames=5, **SIZE)


@pytest.fixture(scope="module")
def future(clip: vestcl.Clip) -> Future:
    return vestcl.forecast(clip, 3, steps=2, views=["source", "0.5,0,0,name=aside"])


def test_a_street_is_a_clip(clip: vestcl.Clip) -> None:
    assert len(clip) == 5 and (clip[0].height, clip[0].width) == (48, 160)
    assert repr(clip) == "Clip(street 3, procedural street, 5 frames of 48 x 160 px at 10 Hz)"
    assert len(vestcl.open("street:3?drive=road,fps=20", frames=2, **SIZE)) == 2
    assert clip[0].right is not None and vestcl.open("street:3?depth=motion", frames=2, **SIZE)[0].right is None
    with pytest.raises(ValueError, match="is a street, which takes height, width, frames, not fov"):
        vestcl.open("street:3", fov=60)


def test_a_folder_in_proportion(tmp_path: Path) -> None:
    from vestcl.io.images import write_image

    for name in "ab":
        write_image(tmp_path / f"{name}.png", np.zeros((3, 40, 100), np.float32))
    clip = vestcl.open(tmp_path, fov=60, width=50)
    assert (clip[0].height, clip[0].width) == (20, 50)
    with pytest.raises(ValueError, match="`frames` is of streets"):
        vestcl.open(tmp_path, fov=60, frames=2)


def test_it_is_the_geometric_forecast(clip: vestcl.Clip, future: Future) -> None:
    views = parse_views(["source", "0.5,0,0,name=aside"], clip[3])
    wanted = geometric.forecast_clip(clip, 3, 2, views)
    assert list(future) == ["source", "aside"] and future.steps == len(future["source"]) == 2
    for name in future:
        for step, frame in enumerate(future[name], start=1):
            one = wanted.frames[step - 1][name]
            assert frame.step == step and future[name][step].image is frame.image
            for got, expected in zip(
                (frame.image, frame.depth, frame.coverage, frame.motion),
                (one.image, one.depth, one.coverage, one.motion_xyz),
                strict=True,
            ):
                np.testing.assert_array_equal(got, expected)
    aside = future["aside"][2]
    np.testing.assert_array_equal(aside.K, clip[3].K)
    np.testing.assert_allclose(aside.tgt_from_cur, views[1].tgt_from_next @ wanted.future_from_cur[1])


def test_steps_count_from_one(future: Future) -> None:
    view = future["source"]
    for step in (0, 3, -1):
        with pytest.raises(IndexError, match=f"`step` must be 1 ... 2, got {step}"):
            view[step]
    assert [frame.step for frame in view[1:]] == [1, 2] and [frame.step for frame in view[2:3]] == [2]
    with pytest.raises(KeyError, match="must be one of source, aside"):
        future["left"]
    assert repr(future) == "Future(street 3, frame 0000000003, geometric, 2 steps, views source, aside)"
    assert repr(view[2]).startswith("FutureFrame(t+2, 48 x 160 px, coverage ")


def test_a_notebook_shows_the_sheet(future: Future) -> None:
    assert future._repr_png_().startswith(b"\x89PNG")
    assert future.sheet("aside").ndim == 3


def test_files(future: Future, tmp_path: Path) -> None:
    about = json.loads(future.save(tmp_path / "out", exr=False).read_text())
    assert about["steps"] == 2 and set(about["views"]) == {"source", "aside"}
    assert (tmp_path / "out" / "aside" / "000002.png").is_file() and (
        tmp_path / "out" / "source" / "sheet.png"
    ).is_file()
    video = Video(future.video(tmp_path / "seen.mp4"))
    assert len(video) == 6, "four frames up to t, and two to come"
    assert len(Video(future.video(tmp_path / "aside.mp4", "aside"))) == 2


def test_points(future: Future, tmp_path: Path) -> None:
    points, colours = read_ply(future.to_ply(tmp_path / "t2.ply", step=2))
    frame = future["source"][2]
    known = frame.depth[0] > 0
    assert len(points) == known.sum() and np.array_equal(points[:, 2], frame.depth[0][known])
    uv = points @ frame.K.T
    v, u = np.nonzero(known)
    np.testing.assert_allclose(uv[:, :2] / uv[:, 2:], np.stack([u, v], 1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(colours, frame.image[:, known].T.clip(0, 1), atol=0.5 / 255 + 1e-6)


def test_ply_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`colours` must be \[N, 3\] with N = 2, got \[1, 3\]"):
        write_ply(tmp_path / "a.ply", np.zeros((2, 3)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="`points_xyz` must be finite"):
        write_ply(tmp_path / "a.ply", np.full((1, 3), np.nan), np.zeros((1, 3)))
    write_ply(tmp_path / "a.ply", np.zeros((2, 3)), np.ones((2, 3)))
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(whole[:-1])
    with pytest.raises(ValueError, match="must have 2 points"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame": 0}, "`frame` must be 1 ... 4, to have a frame before it, got 0"),
        ({"frame": 5}, "`frame` must be 1 ... 4"),
        ({"views": []}, "`views` must be one camera or more, got none"),
        ({"views": ["above"]}, "above"),
        ({"views": [View("source", np.eye(4)), "source"]}, "`views` must have different names"),
        ({"model": "vest-xl"}, "vest-xl: is not a model"),
    ],
)
def test_mistakes(clip: vestcl.Clip, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vestcl.forecast(clip, **changes)


def test_a_clip_of_one_frame(clip: vestcl.Clip) -> None:
    with pytest.raises(ValueError, match=r"`frame` must be 1 \.\.\. 0, to have a frame before it, got 1 frames"):
        vestcl.forecast(clip[:1])


# ---------------------------------------------------------------- networks


@pytest.fixture
def model() -> vestcl.Forecaster:
    torch.manual_seed(0)
    return vestcl.Forecaster(SMALL).eval()


def same(one: vestcl.Forecaster, other: vestcl.Forecaster) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return one.config == other.config and all(torch.equal(first, second) for first, second in pairs)


def test_a_network_forecasts(clip: vestcl.Clip, model: vestcl.Forecaster) -> None:
    future = vestcl.forecast(clip, 3, steps=1, model=model, learned="all")
    assert future.method == SMALL.name and future["source"][1].image.shape == (3, 48, 160)


def test_saved_and_loaded(model: vestcl.Forecaster, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path / "mine")
    assert {file.name for file in (tmp_path / "mine").iterdir()} == {"README.md", "config.json", "model.safetensors"}
    assert "license: apache-2.0" in (tmp_path / "mine" / "README.md").read_text()
    for name in (tmp_path / "mine", str(tmp_path / "mine"), tmp_path / "mine" / "model.safetensors"):
        assert same(vestcl.Forecaster.from_pretrained(name), model)
    assert vestcl.Forecaster.from_pretrained("vest-s").config.name == "vest-s"


def test_a_repository(model: vestcl.Forecaster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a stub of the hub: what is asked for, and that its file is loaded."""
    import huggingface_hub

    from vestcl.models import forecaster

    model.save_pretrained(tmp_path)
    asked = []

    def download(repo_id: str, filename: str, **options: Any) -> str:
        asked.append((repo_id, filename, options.get("revision")))
        if repo_id != "someone/net":
            raise huggingface_hub.errors.EntryNotFoundError("404 Not Found")
        return str(tmp_path / filename)

    monkeypatch.setattr(forecaster, "hf_hub_download", download)
    assert same(vestcl.Forecaster.from_pretrained("someone/net", revision="v1"), model)
    assert asked == [("someone/net", "model.safetensors", "v1")]
    with pytest.raises(
        ValueError, match="someone/else: is not a file here, and not available on the hub: 404 Not Found"
    ):
        vestcl.Forecaster.from_pretrained("someone/else")


def test_pushed(model: vestcl.Forecaster, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder that is uploaded has weights, configuration and card."""
    from types import SimpleNamespace

    from huggingface_hub import hub_mixin

    uploaded = {}

    class Api:
        def __init__(self, token: Any = None, **_: Any) -> None: ...

        def create_repo(self, repo_id: str, **_: Any) -> Any:
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, repo_id: str, folder_path: Any, **_: Any) -> str:
            uploaded[repo_id] = {file.name for file in Path(folder_path).iterdir()}
            return "commit"

    monkeypatch.setattr(hub_mixin, "HfApi", Api)
    assert model.push_to_hub("someone/net") == "commit"
    assert uploaded == {"someone/net": {"README.md", "config.json", "model.safetensors"}}


def test_seconds_in_place_of_steps() -> None:
    """At 10 Hz 0.24 s are two steps; both, or the seconds of a clip without times, are refused."""
    clip = vestcl.open("street:3", height=48, width=96, frames=4)
    assert vestcl.forecast(clip, seconds=0.24).steps == 2
    with pytest.raises(ValueError, match="`steps` and `seconds` both say how far"):
        vestcl.forecast(clip, steps=2, seconds=0.2)
    bare = dataclasses.replace(clip, samples=tuple(dataclasses.replace(sample, timestamp=None) for sample in clip))
    with pytest.raises(ValueError, match="has no times"):
        vestcl.forecast(bare, seconds=0.2)


# ---------------------------------------------------------------- the package


def test_what_the_package_has() -> None:
    assert set(vestcl.__all__) == set(dir(vestcl)) and {"open", "forecast", "Forecaster", "splat"} <= set(dir(vestcl))
    assert all(getattr(vestcl, name).__doc__ for name in vestcl.__all__)
