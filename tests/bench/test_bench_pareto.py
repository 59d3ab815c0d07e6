"""`vestcl bench pareto`: that it measures, marks and writes what it says. No time is judged."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import SMALL, stir

from vestcl.bench.common.results import load
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto import bench as pareto
from vestcl.bench.pareto import plots
from vestcl.bench.pareto.bench import ParetoBench
from vestcl.bench.pareto.knobs import EXACT, combinations, combined, describe, setting_of
from vestcl.bench.pareto.measure import PRICE, Point, front, knee
from vestcl.bench.pareto.scenes import double, scene, shrunk
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.options import InferenceOptions

#: Of vest-s, all that can be turned.
TURNED = dataclasses.replace(
    SMALL,
    encoder=dataclasses.replace(SMALL.encoder, background="frame"),
    render=dataclasses.replace(SMALL.render, inpainted="last", previous="uncovered"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the results of a tiny run."""
    folder = tmp_path_factory.mktemp("pareto")
    torch.manual_seed(0)
    stir(Forecaster(TURNED)).save(folder / "tiny.safetensors")
    files = {"json": folder / "new" / "p.json", "markdown": folder / "p.md", "plots": folder / "plots"}
    pareto.main(ParetoBench(str(folder / "tiny.safetensors"), (1100,), 32, 64, runs=1, threads=1, **files))
    return folder


@pytest.fixture(scope="module")
def details(folder: Path) -> dict[str, Any]:
    (result,) = load(folder / "new" / "p.json")
    assert result.bench == "pareto" and result.config["seeds"] == [1100] and result.machine["device"]
    return result.details


def test_every_knob_is_measured(details: dict[str, Any]) -> None:
    names = {"skipping", "min_transmittance", "splat_scale", "precision", "image size", "paint_scale", "blocks"}
    assert set(details["knobs"]) == names | {"margin"}
    for knob in details["knobs"].values():
        exact = knob["points"][0]
        values = [point["value"] for point in knob["points"]]
        assert len(set(values)) == len(values) > 1 and knob["default"] == values[0] and knob["knee"] in values
        assert exact["setting"] == {} and exact["loss"] == 0 and exact["rms"]["median"] < 1e-4
        for point in knob["points"]:
            assert 0 < point["seconds"]["low"] <= point["seconds"]["median"] <= point["seconds"]["high"]
            assert point["rms"]["median"] >= 0 and 5 < point["psnr"]["median"] < 60 and point["loss"] <= point["worst"]
            assert exact["psnr"]["median"] - point["psnr"]["median"] == pytest.approx(point["loss"], abs=1e-5)


def test_what_is_exact_stays_near_float64(details: dict[str, Any]) -> None:
    for point in details["knobs"]["skipping"]["points"]:
        assert point["rms"]["median"] < 1e-4
    rms = [point["rms"]["median"] for point in details["knobs"]["min_transmittance"]["points"]]
    assert rms == sorted(rms) and rms[-1] > 1e-3


def test_the_front_holds_the_named_qualities(details: dict[str, Any]) -> None:
    together = details["front"]
    points = {point["value"]: point for point in together["points"]}
    assert set(together["qualities"].values()) | {together["knee"], "exact"} <= set(points)
    for value in together["best"]:
        other = points[value]
        assert not any(
            point["loss"] < other["loss"] and point["seconds"]["median"] < other["seconds"]["median"]
            for point in points.values()
        )


def test_several_steps(details: dict[str, Any]) -> None:
    rows = {(row["mode"], row["steps"]): row for row in details["recursion"]}
    assert set(rows) == {(mode, steps) for mode in ("compose", "feedback") for steps in (1, 3, 5)}
    assert rows["compose", 1]["psnr"] == rows["feedback", 1]["psnr"]
    assert rows["compose", 5]["psnr"]["median"] < rows["compose", 1]["psnr"]["median"]


def test_files(folder: Path, details: dict[str, Any]) -> None:
    markdown = (folder / "p.md").read_text(encoding="utf-8")
    assert all(f"**{name}" in markdown for name in details["knobs"]) and "bfloat16" in markdown
    drawn = {path.stem for path in (folder / "plots").glob("*.png")}
    assert drawn == {
        "front",
        "recursion",
        *(name.replace(" ", "-").replace("_", "-") for name in details["knobs"]),
    }
    measures = json.loads((folder / "new" / "p.json").read_text(encoding="utf-8"))["devices"][0]["measures"]
    names = [measure["name"] for measure in measures]
    assert len(set(names)) == len(names) and {"precision bfloat16, time", "blocks all, PSNR"} <= set(names)


def test_figures_show_what_there_is(details: dict[str, Any]) -> None:
    figure = plots.knob_figure("precision", details["knobs"]["precision"])
    left, right = figure.axes
    assert {text.get_text() for text in left.texts} == {"float32", "bfloat16"}
    assert right.get_xlabel() == "ms/step" and right.get_legend() is not None
    (axes,) = plots.front_figure(details["front"]).axes
    assert {text.get_text() for text in axes.texts if text.get_text()} == set(quality.LEVELS)


def point(value: str, seconds: float, loss: float, noise: float = 0.0) -> Point:
    one = Spread(1, 1, 1, 1)
    return Point(value, {}, Spread(seconds, seconds - noise, seconds + noise, 3), one, one, one, loss, loss)


def test_front_and_knee_by_hand() -> None:
    exact, half, quarter = point("exact", 4, 0), point("half", 2, PRICE / 2), point("quarter", 1, 2 * PRICE + 0.01)
    slow, worse = point("slow", 5, 0), point("worse", 2, PRICE)
    assert front([exact, half, quarter, slow, worse]) == [exact, half, quarter]
    assert knee([exact, half, quarter, slow, worse]) == half
    assert knee([exact, quarter]) == exact
    assert knee([point("exact", 4, 0, noise=1.5), point("noise", 3.9, 0, noise=1.5)]).value == "exact"
    with pytest.raises(ValueError, match="`points` must be one or more"):
        knee([])


def test_settings_are_combined_and_described() -> None:
    given = InferenceOptions(margin=3, blocks=2, autocast="bfloat16")
    assert setting_of(given) == {"skip": {"margin": 3}, "effort": {"blocks": 2}, "autocast": "bfloat16"}
    assert setting_of(InferenceOptions()) == EXACT
    nothing = InferenceOptions().without_skips()
    assert InferenceOptions.from_dict(setting_of(nothing)) == nothing
    both = combined([{"effort": {"blocks": 2}}, {"skip": {"margin": 0}}, {"effort": {"paint_scale": 0.5}}])
    assert both == {"effort": {"blocks": 2, "paint_scale": 0.5}, "skip": {"margin": 0}}
    assert describe(both) == "margin 0, blocks 2, paint_scale 0.5" and describe(EXACT) == "exact"
    every = combinations([[EXACT, {"size": 0.5}], [EXACT, {"autocast": "bfloat16"}]])
    assert len(every) == 4 and every[0] == EXACT and every[-1] == {"autocast": "bfloat16", "size": 0.5}


def test_a_smaller_scene_is_the_same_view() -> None:
    whole = scene(1100, 32, 64, 1)
    half = shrunk(whole.given, 0.5)
    assert shrunk(whole.given, 1.0) is whole.given
    assert half.frame_cur.image.shape == (1, 3, 16, 32) and half.prior.velocity_cur.shape == (1, 3, 16, 32)
    assert torch.allclose(half.frame_cur.image.mean(), whole.given.frame_cur.image.mean(), atol=1e-6)
    assert set(half.frame_cur.depth.unique().tolist()) <= set(whole.given.frame_cur.depth.unique().tolist())
    assert torch.allclose(half.K[0, :2] * 2, whole.given.K[0, :2])
    assert double(half).prior.next_from_cur.quaternion.dtype == torch.float64
    assert np.array_equal(double(half).frame_cur.image.float(), half.frame_cur.image)


@pytest.mark.parametrize("change", [{"height": 0}, {"runs": 0}, {"threads": -1}])
def test_refuses(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(change))}` must be positive"):
        pareto.main(ParetoBench(**change))
    with pytest.raises(ValueError, match="`seeds` must be one or more"):
        pareto.main(ParetoBench(seeds=()))
    with pytest.raises(ValueError, match="no-such"):
        pareto.main(ParetoBench("no-such"))
