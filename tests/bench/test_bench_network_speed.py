"""The speed of networks: every choice is there, compared with the plain network, which stays as it is."""

import copy
import json
import math
import shutil
from typing import Any

import pytest
import torch
from forecaster_scenes import ABLATIONS, SMALL, TINY, camera, pair_of, stir, turning

from vestcl.bench.common import results as _results
from vestcl.bench.common import timing as _timing
from vestcl.bench.network.variants import PLAIN, Group, Section, network_speed
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.skipping import Skip

#: "equal" in tables, and what bfloat16 keeps of small networks with random weights.
EXACT, NEAR = 90, 20


def measured(config: Any = SMALL, **settings: Any) -> Section:
    torch.manual_seed(0)
    model = Forecaster(config).eval()
    if config.object_motion is not None:
        stir(model)
    prior = turning(1, 32, 48) if config.start == "prior" else None
    with _timing.torch_threads(1):
        return network_speed(model, pair_of(1, 32, 48), camera(1, 32, 48), prior, runs=1, **settings)


@pytest.fixture(scope="module")
def section() -> Section:
    return measured()


def names(group: Group) -> list[str]:
    return [choice.name for choice in group.choices]


def test_every_choice_beside_the_plain_network(section: Section) -> None:
    groups = {group.title: group for group in section.details["groups"]}
    assert list(groups) == ["forecast", "encoder", "object motion", "refinement"]
    assert names(groups["forecast"]) == [PLAIN, *(f"{n}memory kept" for n in ("", "accelerated, ", "bfloat16, "))]
    assert names(groups["encoder"]) == [PLAIN, "both frames in one pass", "weights channels-last", "bfloat16"]
    assert names(groups["object motion"]) == [PLAIN, "weights channels-last", "frames shared"]
    assert names(groups["refinement"]) == [PLAIN, "weights channels-last", "bfloat16"]
    for group in groups.values():
        assert group.choices[0].ratio.median == 1 and math.isinf(group.choices[0].psnr)
        for choice in group.choices:
            assert choice.seconds.median > 0 and choice.cpu_seconds.median > 0
            assert choice.psnr >= (NEAR if "bfloat16" in choice.name else EXACT), (group.title, choice.name)


def test_figures_and_tables_agree(section: Section, tmp_path: Any) -> None:
    by_name = {measure.name: measure for measure in section.measures}
    assert len(by_name) == len(section.measures)
    assert by_name["object motion, frames shared"].unit == "s"
    assert by_name["object motion, frames shared / plain"].unit == "1"
    for group, grid in zip(section.details["groups"], section.grids, strict=True):
        assert grid.title == group.title and [row[0] for row in grid.rows] == names(group)
        assert all(len(row) == len(grid.heading) for row in grid.rows)
        assert grid.rows[0][3:] == ("1.00", "1.00", "equal")
    results = _results.Results("network", {"device": "none"}, {}, section.measures, section.grids, section.details)
    _results.save([results], tmp_path / "speed.json", tmp_path / "speed.md")
    assert len(json.loads((tmp_path / "speed.json").read_text())["devices"][0]["measures"]) == len(by_name)


@pytest.mark.parametrize("name", ["no motion", "routing"])
def test_networks_that_are_not_there_are_left_out(name: str) -> None:
    section = measured(ABLATIONS[name])
    groups = {group.title: names(group) for group in section.details["groups"]}
    assert "frames shared" not in groups.get("object motion", [])
    assert ("object motion" in groups) == (name == "routing")


def test_the_model_is_untouched() -> None:
    torch.manual_seed(0)
    model = stir(Forecaster(TINY)).eval()
    before = copy.deepcopy(model.state_dict())
    with _timing.torch_threads(1):
        network_speed(model, pair_of(1, 32, 48), camera(1, 32, 48), None, runs=1)
    assert model.skip == Skip() and model.autocast is None and not model.encoder._forward_pre_hooks
    assert all(torch.equal(before[name], value) for name, value in model.state_dict().items())


def test_compilation_is_told_beside(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for the compiler, which takes a minute for nothing that is ours."""
    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr(torch, "compile", lambda network, **_: network)
    section = measured(compiled=True)
    for group, grid in zip(section.details["groups"][1:], section.grids[1:], strict=True):
        last = group.choices[-1]
        assert last.name == "torch.compile" and last.compile_seconds is not None and last.psnr >= EXACT
        assert grid.heading[-1] == "s to compile" and grid.rows[0][-1] == ""
    assert section.grids[0].heading[-1] == "dB to plain"


def test_mistakes_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    model, given = Forecaster(TINY), (pair_of(1, 32, 48), camera(1, 32, 48), None)
    with pytest.raises(ValueError, match="`runs` must be 1 or more, got 0"):
        network_speed(model, *given, runs=0)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=r"`compiled` must be False without a C\+\+ compiler, got none of g\+\+"):
        network_speed(model, *given, compiled=True)
