"""`vestcl bench forecast`: truth formulas by construction, means on known numbers, and whole runs on tiny streets."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx_files import write_mix
from st_lpips_weights import public_state

from vestcl.bench.forecast import bench
from vestcl.bench.forecast.bench import HELD_OUT, ForecastBench
from vestcl.bench.forecast.windows import chosen_windows, clips_of, groups_of
from vestcl.cli import main as cli
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample
from vestcl.evaluation import metrics, perceptual, scores, tables
from vestcl.evaluation.compare import FLOW, REPEAT
from vestcl.evaluation.methods import TRUE_POSES
from vestcl.evaluation.scores import GEOMETRIC, ORACLE, SOURCE, Prediction, Record, Truth
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting import peer
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

SIZE = 64, 208
TINY: dict[str, Any] = {
    "street_size": SIZE, "height": 64, "width": 208, "steps": 2, "horizons": (1, 2), "street_frames": 6, "samples": 1
}  # fmt: skip
SOURCE_VIEW = View(SOURCE, np.eye(4))


def clip_of_street(seed: int = 3, frames: int = 6, samples: int = 1) -> Clip:
    return street_clip(Street.generate(seed), frames, *SIZE, samples=samples)


def rendered(image: np.ndarray, motion: np.ndarray | None = None, depth: np.ndarray | None = None) -> Rendered:
    plane = np.ones((1, *image.shape[1:]), np.float32)
    step = np.zeros_like(image) if motion is None else motion
    return Rendered(image, plane if depth is None else depth, plane, step)


# ---------------------------------------------------------------- scores and means


def test_scores_of_known_errors() -> None:
    """Truth + 0.1 is 20 dB; the same image, infinitely good."""
    clip = clip_of_street()
    images = [clip[i].read_image() for i in (2, 3)]
    grey = [np.clip(image, 0, 0.8).astype(np.float32) for image in images]
    arrays = tuple(Sample.from_arrays(str(i), image, np.eye(3)) for i, image in enumerate([grey[0], *grey]))
    truth = Truth(Clip("grey", "arrays", arrays), SIZE, None)
    off = [image + np.float32(26 / 255) for image in grey]
    predictions = {SOURCE: {"off": Prediction(off, 1.5), "equal": Prediction(grey, 0.0)}}
    forecast = Forecast("", [], [{SOURCE: rendered(image)} for image in off])
    bad, good = scores.score(truth, 0, [SOURCE_VIEW], predictions, forecast)
    assert (bad.method, bad.view, bad.index, bad.seconds) == ("off", SOURCE, 0, 1.5)
    np.testing.assert_allclose(bad.scores["psnr"], -20 * np.log10(26 / 255), atol=1e-3)
    np.testing.assert_allclose(bad.scores["psnr_seen"], bad.scores["psnr"], atol=1e-4)
    assert good.scores["psnr"] == [np.inf, np.inf] and good.scores["ssim"] == pytest.approx([1, 1])
    assert "ms_ssim" not in good.scores and "squeeze" not in good.scores


def test_the_distance_of_kept_maps_is_the_squeeze_distance() -> None:
    torch.manual_seed(0)
    trunk = Trunk("squeezenet1_0").requires_grad_(False).eval()
    pictures = [np.random.default_rng(seed).random((3, *SIZE)).astype(np.float32) for seed in (0, 1)]
    first, second = scores.look(pictures, SIZE, trunk)
    batch = [metrics.quantise(torch.from_numpy(picture)[None]) for picture in pictures]
    wanted = perceptual.squeeze_distance(batch[0], batch[1], trunk)
    torch.testing.assert_close(scores.distance(first.maps, second.maps), wanted, rtol=1e-4, atol=1e-6)


def record(method: str, index: int, psnr: list[float], view: str = SOURCE) -> Record:
    return Record("clip", str(index), index, view, method, 2.0 * index, {"psnr": psnr})


def test_means_by_hand() -> None:
    records = [record("a", 1, [10.0, 20.0]), record("a", 2, [14.0, np.nan]), record("b", 1, [np.nan, np.nan])]
    told = tables.summarise(records)[SOURCE]
    assert told["a"]["windows"] == 2 and told["a"]["seconds"] == 3.0
    assert told["a"]["by_horizon"] == {"psnr": [12.0, 20.0]}
    assert told["a"]["running_mean"]["psnr"] == pytest.approx([12.0, 16.0])
    assert np.isnan(told["b"]["by_horizon"]["psnr"]).all()
    assert tables.finite(told)["b"]["by_horizon"]["psnr"] == [None, None]


def test_tables_by_hand() -> None:
    records = [record("a", 1, [10.0, 20.0]), record("a", 2, [14.0, 30.0]), record("b", 1, [np.nan, 5.0])]
    (grid,) = tables.picture_grids("clip", records, (2,))
    assert grid.heading == ("", "PSNR t+2", "s")
    assert grid.rows == (("a", "25.00", "3.00"), ("b", "5.00", "2.00"))
    assert grid.title == "clip, view source, mean over 2 windows"
    lines = tables.to_markdown(grid).splitlines()
    assert lines[2:5] == ["|  | PSNR t+2 | s |", "| --- | ---: | ---: |", "| a | 25.00 | 3.00 |"]
    assert bench.fact_grids("clip", [], (1,)) == []
    assert ForecastBench(("x",), horizons=(3, 1, 3)).shown == (3, 1) and ForecastBench(("x",), steps=3).shown == (1, 3)


# ---------------------------------------------------------------- whole runs


def test_windows_have_a_frame_before_and_steps_after() -> None:
    clip = clip_of_street(frames=6)
    assert list(chosen_windows(clip, ForecastBench(("x",), steps=2))) == [1, 2, 3]
    assert list(chosen_windows(clip, ForecastBench(("x",), steps=1, first=2, every=2))) == [2, 4]
    assert list(chosen_windows(clip, ForecastBench(("x",), steps=1, last=2))) == [1, 2]


def test_inputs() -> None:
    config = ForecastBench(("x",), **TINY)
    names = [clip.name for clip in clips_of("street:4-6", config)]
    assert names == ["street 4", "street 5", "street 6"]
    assert [clip.name for clip in clips_of("street:7", config)] == ["street 7"]
    assert [clip.name for clip in clips_of("street:", config)] == [f"street {seed}" for seed in HELD_OUT]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "`steps`"),
        ({"horizons": (1, 3)}, "`horizons` must be steps, 1 ... 2"),
        ({"views": ()}, "`views`"),
        ({"inputs": ()}, "`inputs`"),
        ({"inputs": ("street:5-4",)}, "lower to a higher seed"),
        ({"inputs": ("street:5-999999999999",)}, "1,000 streets or fewer"),
        ({"street_frames": 3}, "must have 4 frames"),
        ({"first": 9}, "must have 12 frames"),
    ],
)
def test_what_cannot_be_is_told(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        bench.main(ForecastBench(**({"inputs": ("street:4",)} | TINY | settings)))


def test_a_run_prints_and_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, markdown = tmp_path / "new" / "scores.json", tmp_path / "new" / "scores.md"
    torch.save(public_state(), tmp_path / "st.pth")
    VoxelFlowNetwork(blocks=[(4, 8), (1, 4)]).save(tmp_path / "peer.safetensors")
    weights = {"st_lpips": tmp_path / "st.pth", "peer": tmp_path / "peer.safetensors"}
    bench.main(ForecastBench(("street:4",), **TINY, **weights, out=out, markdown=markdown))
    printed, results = capsys.readouterr().out, json.loads(out.read_text(encoding="utf-8"))
    assert {"vestcl", "device", "torch"} <= set(results["machine"])
    (told,) = results["inputs"]
    assert set(told["views"]) == {"source", "right"}
    assert set(told["views"]["source"]) == {REPEAT, FLOW, GEOMETRIC, TRUE_POSES, peer.METHOD}
    assert ORACLE in told["views"]["right"]
    assert len(told["windows"]) == 3 * (5 + 6) and len(told["window_facts"]) == 3
    own = [w["scores"]["psnr"] for w in told["windows"] if (w["view"], w["method"]) == ("source", GEOMETRIC)]
    found = told["views"]["source"][GEOMETRIC]["by_horizon"]["psnr"]
    np.testing.assert_allclose(found, np.mean(own, axis=0))
    best = {method: of["by_horizon"]["psnr"][0] for method, of in told["views"]["source"].items()}
    assert best[TRUE_POSES] > best[REPEAT] and best[GEOMETRIC] > best[REPEAT]
    assert set(told["facts"]) >= {"rotation_deg", "motion_m", "splatter_loss_db"}
    assert told["facts"]["splatter_loss_db"][0] < 3
    assert told["views"]["source"][GEOMETRIC]["by_horizon"]["st_lpips"][0] > 0
    assert "DMVFN shape: images by 2D voxel flow" in printed
    assert "ST-LPIPS" in printed and "without --st-lpips" not in printed
    assert "without --squeeze" in printed and "mean over 3 windows" in printed and "wrote" in printed
    assert f"| {TRUE_POSES} |" in markdown.read_text(encoding="utf-8")


def test_the_command_line_reaches_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "forecast", "street:4", "--steps", "0"]) == 2
    assert "--steps must be 1 or more" in capsys.readouterr().err


def test_pooled_inputs_share_a_table() -> None:
    config = ForecastBench(("street:4", "street:5"), **TINY, pool=True)
    (group,) = groups_of(config)
    assert [clip.name for clip, _ in group.clips] == ["street 4", "street 5"]


def test_a_network_gives_depth(tmp_path: Path) -> None:
    network = write_mix(tmp_path / "network.onnx", [[0.0] * 3], bias=[7.0], metres=1)
    config = ForecastBench(("street:1100",), street_size=(48, 96), street_frames=4, depth_model=str(network), steps=1)
    ((clip, chosen),) = groups_of(config)[0].clips
    assert chosen == [1, 2] and np.allclose(clip[1].read_depth(), 7, rtol=1e-5)
    with pytest.raises(ValueError, match=r"nothing\.onnx"):
        groups_of(dataclasses.replace(config, depth_model=str(tmp_path / "nothing.onnx")))
