"""The named qualities keep what they promise: with the network that ships, and in the figures that are committed."""

from pathlib import Path

import pytest
import torch
from forecaster_scenes import PAINTING, SMALL, TINY

from vestcl.bench.common.results import load
from vestcl.bench.pareto import plots
from vestcl.bench.pareto.knobs import describe, setting_of
from vestcl.bench.pareto.measure import step
from vestcl.bench.pareto.scenes import Scene, scene
from vestcl.evaluation import metrics
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference import quality
from vestcl.models.inference.fast import computes_bfloat16
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.quality import LEVELS, LOSS, Quality

FIGURES = Path(__file__).parents[2] / "docs" / "time_against_error" / "pareto.json"

#: Streets of this test's own, in small.
SEEDS, SIZE = (1107, 1108), (64, 208)

#: Of an image's values, root of the mean square: what float32 and each level may differ from "exact" by.
DIFFERENCE: dict[Quality, float] = {"exact": 1e-6, "balanced": 0.02, "fast": 0.04}


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [scene(seed, *SIZE, 1) for seed in SEEDS]


@pytest.fixture(scope="module")
def exact(scenes: list[Scene]) -> list[torch.Tensor]:
    """As the shipped network forecasts the streets when it is loaded."""
    model = Forecaster.from_pretrained("vest-s")
    return [step(model, one.given) for one in scenes]


@pytest.mark.parametrize("level", LEVELS)
def test_the_shipped_network_keeps_the_bound(level: Quality, scenes: list[Scene], exact: list[torch.Tensor]) -> None:
    model = Forecaster.from_pretrained("vest-s")
    assert quality.apply(model, level) is model
    losses = []
    for one, before in zip(scenes, exact, strict=True):
        after = step(model, one.given)
        assert float((after - before).square().mean().sqrt()) <= DIFFERENCE[level]
        losses.append(float(metrics.psnr(before.clamp(0, 1), one.truth) - metrics.psnr(after.clamp(0, 1), one.truth)))
    assert sum(losses) / len(losses) <= LOSS[level] + 1e-4


def test_the_committed_figures_keep_the_bound() -> None:
    results = load(FIGURES)
    assert results
    for result in results:
        tables = plots.tables(result)
        points = plots.points(next(frame for title, frame in tables.items() if title.startswith(plots.COMBINATIONS)))
        seconds = []
        for level in LEVELS:
            (name,) = points.index[points["is"].str.contains(level)]
            assert name == describe(setting_of(quality.settings(level))), "measure again: `vestcl bench pareto`"
            assert points["loss"][name] <= LOSS[level]
            seconds.append(points["time"][name])
        assert seconds == sorted(seconds, reverse=True)


def test_exact_is_as_a_network_is_loaded() -> None:
    model, fresh = quality.apply(Forecaster(SMALL), "fast"), Forecaster(SMALL)
    assert model.options != fresh.options
    assert quality.settings("exact") == InferenceOptions()
    quality.apply(model, "exact")
    assert model.options == fresh.options


def test_bfloat16_where_the_processor_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert quality.settings("balanced").autocast == "bfloat16"
    wanted = "bfloat16" if computes_bfloat16() else None
    assert quality.apply(Forecaster(SMALL), "balanced").options.autocast == wanted
    monkeypatch.setattr(quality, "computes_bfloat16", lambda: False)
    assert quality.apply(Forecaster(SMALL), "balanced").options.autocast is None


@pytest.mark.parametrize("config", [TINY, PAINTING])
def test_networks_that_predict_rgb_run_at_full_size(config: type) -> None:
    assert quality.apply(Forecaster(config), "fast").options.paint_scale == 1


def test_what_files_contain() -> None:
    reported = quality.about("balanced")
    assert reported["quality"] == "balanced" and reported["skip"]["margin"] == quality.settings("balanced").margin
    assert set(reported) == {"quality", "skip", "effort", "autocast"} and "min_transmittance" in reported["effort"]


def test_refuses() -> None:
    with pytest.raises(ValueError, match="`quality` must be one of exact, balanced, fast, realtime, got 'best'"):
        quality.settings("best")  # type: ignore[arg-type]
