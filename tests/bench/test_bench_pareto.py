"""`vestcl bench pareto`: that it measures, marks and writes what it says. No time is judged."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from forecaster_scenes import SMALL, stir

from vestcl.bench.common.results import load
from vestcl.bench.common.timing import Spread
from vestcl.bench.pareto import bench as pareto
from vestcl.bench.pareto import plots
from vestcl.bench.pareto.bench import ParetoBench
from vestcl.bench.pareto.knobs import EXACT, combinations, describe, options_of, setting_of
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
def tables(folder: Path) -> dict[str, pd.DataFrame]:
    (result,) = load(folder / "new" / "p.json")
    assert result.bench == "pareto" and result.config["seeds"] == [1100] and result.machine["device"]
    return plots.tables(result)


@pytest.fixture(scope="module")
def knobs(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """Points by knob."""
    return {title.partition(":")[0]: plots.points(frame) for title, frame in tables.items() if ":" in title}


def test_every_knob_is_measured(knobs: dict[str, pd.DataFrame]) -> None:
    names = {"skipping", "min_transmittance", "splat_scale", "precision", "image size", "paint_scale", "blocks"}
    assert set(knobs) == names | {"margin"}
    for found in knobs.values():
        exact = found.iloc[0]
        assert found.index.is_unique and len(found) > 1 and exact["loss"] == 0 and exact["rms"] < 1e-4
        assert exact["is"].startswith("default") and found["is"].str.contains("knee").sum() == 1
        assert (
            (found["low"] > 0).all()
            and (found["low"] <= found["time"]).all()
            and (found["time"] <= found["high"]).all()
        )
        assert (found["rms"] >= 0).all() and found["PSNR"].between(5, 60).all()
        assert np.allclose(exact["PSNR"] - found["PSNR"], found["loss"], atol=1e-5)


def test_what_is_exact_stays_near_float64(knobs: dict[str, pd.DataFrame]) -> None:
    assert (knobs["skipping"]["rms"] < 1e-4).all()
    rms = [*knobs["min_transmittance"]["rms"]]
    assert rms == sorted(rms) and rms[-1] > 1e-3


def test_the_front_holds_the_named_qualities(tables: dict[str, pd.DataFrame]) -> None:
    found = plots.points(next(frame for title, frame in tables.items() if title.startswith(plots.COMBINATIONS)))
    assert all(found["is"].str.contains(level).sum() == 1 for level in quality.LEVELS) and "exact" in found.index
    for _, one in found[found["is"].str.startswith("front")].iterrows():
        assert not ((found["loss"] < one["loss"]) & (found["time"] < one["time"])).any()


def test_several_steps(tables: dict[str, pd.DataFrame]) -> None:
    found = plots.points(tables[plots.STEPS])
    assert set(found.index) == {f"{mode} to t+{steps}" for mode in ("compose", "feedback") for steps in (1, 3, 5)}
    psnr = found["PSNR"]
    assert psnr["compose to t+1"] == psnr["feedback to t+1"] and psnr["compose to t+5"] < psnr["compose to t+1"]


def test_files(folder: Path, knobs: dict[str, pd.DataFrame]) -> None:
    markdown = (folder / "p.md").read_text(encoding="utf-8")
    assert all(f"**{name}" in markdown for name in knobs) and "bfloat16" in markdown
    drawn = {path.stem for path in (folder / "plots").glob("*.png")}
    assert drawn == {"front", "recursion", *(name.replace(" ", "-").replace("_", "-") for name in knobs)}
    (result,) = load(folder / "new" / "p.json")
    names = [*result.figures["name"]]
    assert len(set(names)) == len(names) and {"precision bfloat16, time", "blocks all, PSNR"} <= set(names)


def test_figures_show_what_there_is(tables: dict[str, pd.DataFrame]) -> None:
    (title,) = (title for title in tables if title.startswith("precision"))
    left, right = plots.draw(tables[title], title).axes
    assert {text.get_text() for text in left.texts} == {"float32", "bfloat16"}
    assert right.get_xlabel() == "ms/step" and right.get_ylabel() == "PSNR drop, dB"
    (title,) = (title for title in tables if title.startswith(plots.COMBINATIONS))
    (axes,) = plots.draw(tables[title], title).axes
    assert {text.get_text() for text in axes.texts if text.get_text()} == set(quality.LEVELS)


def test_files_of_earlier_versions_are_drawn() -> None:
    (result,) = load(Path(__file__).parents[2] / "docs" / "time_against_error" / "pareto.json")
    tables = plots.tables(result)
    assert len(tables) == len(result.details["knobs"]) + 2
    for title, frame in tables.items():
        assert plots.draw(frame, title).axes
    blocks = plots.points(tables["blocks: the first of 6 blocks of object motion"])
    assert blocks["loss"].to_dict() == {p["value"]: p["loss"] for p in result.details["knobs"]["blocks"]["points"]}


def point(value: str, seconds: float, loss: float, noise: float = 0.0) -> Point:
    one = Spread(1, 1, 1, 1)
    return Point(value, Spread(seconds, seconds - noise, seconds + noise, 3), one, one, one, loss, loss)


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
    assert setting_of(given) == {"margin": 3, "blocks": 2, "autocast": "bfloat16"}
    assert setting_of(InferenceOptions()) == EXACT
    nothing = InferenceOptions().without_skips()
    assert options_of(setting_of(nothing)) == nothing and options_of({"size": 0.5}) == InferenceOptions()
    (both,) = combinations([[{"blocks": 2}], [{"margin": 0}], [{"paint_scale": 0.5}]])
    assert both == {"blocks": 2, "paint_scale": 0.5, "margin": 0}
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
