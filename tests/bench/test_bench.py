"""`vestcl bench splat`: that it runs, counts and writes what it should, and that its peers splat. Nothing is timed."""

import gc
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_close

from vestcl import reference
from vestcl.bench.common import results as _results
from vestcl.bench.common import table as _table
from vestcl.bench.common import timing as _timing
from vestcl.bench.splat import bench as splat
from vestcl.bench.splat import scenes as _scenes
from vestcl.bench.splat import torch_peer as _peer
from vestcl.bench.splat.kernels import facts_of

#: Nothing runs longer than its least number of rounds.
TINY: dict[str, Any] = {"height": 24, "width": 50, "seconds": 1e-3, "compile": False}


@pytest.fixture(scope="module")
def scene() -> _scenes.Scene:
    return _scenes.street(24, 50, 5, 1.7)


def by_reference(scene: _scenes.Scene) -> torch.Tensor:
    arrays = (scene.points_uv, scene.z, scene.radii, scene.opacities, scene.features)
    return reference.splat(*arrays, scene.height, scene.width)[0]


def assert_like_reference(scene: _scenes.Scene) -> None:
    """Image and gradients within the operator's own tolerance."""
    recording, exact = scene.requiring_grad(), scene.double().requiring_grad()
    image, truth = _peer.splat(recording), by_reference(exact)
    assert_close(image, truth, "image")
    grads = torch.autograd.grad(image, recording.leaves, recording.grad_image)
    truths = torch.autograd.grad(truth, exact.leaves, exact.grad_image)
    for name, grad, true in zip(_scenes.DIFFERENTIATED, grads, truths, strict=True):
        assert_close(grad, true, f"grad_{name}")


# ---------------------------------------------------------------- the command


def test_a_run_writes_and_prints_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(splat, "SIZES", ((8, 16), (16, 32)))
    monkeypatch.setattr(splat, "CHANNEL_SWEEP", (1, 3))
    monkeypatch.setattr(splat.pytorch3d, "is_installed", lambda: False)
    monkeypatch.setenv("COLUMNS", "200")
    path = tmp_path / "new folder" / "splat.json"
    splat.main(splat.SplatBench(**TINY, scaling=True, channels=True, json=path))
    assert [file.name for file in path.parent.iterdir()] == ["splat.json"]
    (result,), printed = _results.load(path), capsys.readouterr().out
    assert {"vestcl", "torch", "numpy", "pyopencl", "device", "driver", "processor", "cores", "date"} <= set(
        result.machine
    )
    assert result.config["radii"] == [1.0, 2.0]
    tables = dict(list(result.frame.groupby("table")))
    assert len(tables) == 5
    rows = {name: [*tables[name]["row"].unique()] for name in ("Splat", "Over size", "Over channels")}
    assert rows["Splat"] == [f"24x50, C = 32, radius {radius}" for radius in (1, 2)]
    sizes = [(size, radius) for radius in (1, 2) for size in ("8x16", "16x32")]
    assert rows["Over size"] == [f"{size}, C = 32, radius {radius}" for size, radius in sizes]
    assert rows["Over channels"] == [f"24x50, C = {count}, radius {radius}" for radius in (1, 2) for count in (1, 3)]
    for name in rows:
        for column in ("forward ms", "forward x copy", "both ms", "both x copy", "copy ms"):
            own = tables[name][tables[name]["column"] == column]
            assert (
                (own["low"] > 0).all() and (own["low"] <= own["median"]).all() and (own["median"] <= own["high"]).all()
            )
            assert (own["runs"] >= _timing.LEAST_ROUNDS).all() and len(own) == len(rows[name])
    names = [*result.figures["name"]]
    assert len(names) == len({*names}) and "splat forward, 24x50, C = 32, radius 1, x copy" in names
    assert {"scratch memory, radius 1", "sparse / splat forward + backward, 24x50, C = 32, radius 2"} <= {*names}
    errors = result.frame[result.frame["column"].str.startswith("error of")]
    assert set(errors["row"]) == {"vestcl", "sparse"} and (errors["median"] < 2e-6).all()
    assert "forward target" not in printed, "targets hold for 256x832"
    for text in ("forward x", "fragments", "sparse", "PyTorch3D is not installed", "scratch"):
        assert text in printed


@pytest.mark.parametrize(
    ("name", "value"), [("height", 0), ("seconds", -1.0), ("threads", 0), ("radii", ()), ("radii", (1.0, 0.0))]
)
def test_mistakes(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        splat.main(splat.SplatBench(**{**TINY, name: value}))


def test_without_a_compiler_the_peers_run_as_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise RuntimeError("no C++ compiler\nand a long story")

    monkeypatch.setattr(_peer, "compiled_expand", fail)
    assert splat._expanding(splat.SplatBench(), splat.Console()) is _peer.expand
    assert capsys.readouterr().out == "peers without torch.compile: no C++ compiler\n"


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "splat.json"
    _results.write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        _results.write_json(path, {"a": object()})
    assert json.loads(path.read_text(encoding="utf-8")) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------- peers


@pytest.mark.parametrize("double", [False, True], ids=["float32", "float64"])
def test_the_peer_agrees_with_the_reference(double: bool, scene: _scenes.Scene) -> None:
    assert_like_reference(scene.double() if double else scene)


def test_the_peer_shows_nothing_behind_an_opaque_point() -> None:
    centre = torch.tensor([[[2.5, 1.5], [2.5, 1.5], [0.5, 0.5]]])
    z, ones = torch.tensor([[2.0, 1.0, 0.05]]), torch.ones(1, 3)
    features = torch.tensor([[[5.0, 6.0], [7.0, 8.0], [9.0, 9.0]]])
    image = _peer.splat(_scenes.Scene(centre, z, ones, ones, features, torch.zeros(1, 2, 3, 4)))
    wanted = torch.zeros(1, 2, 3, 4)
    wanted[0, :, 1, 2] = torch.tensor([7.0, 8.0])
    assert torch.equal(image, wanted)


# ---------------------------------------------------------------- scenes, clocks and counts


def test_a_scene_follows_from_its_seed(scene: _scenes.Scene) -> None:
    again, other = _scenes.street(24, 50, 5, 1.7), _scenes.street(24, 50, 5, 1.7, seed=1)
    assert all(torch.equal(value, getattr(again, name)) for name, value in vars(scene).items())
    assert not torch.equal(scene.points_uv, other.points_uv)
    assert scene.grad_image.is_contiguous(memory_format=torch.channels_last)
    assert float(scene.opacities.min()) >= 0.6


def test_facts(scene: _scenes.Scene) -> None:
    rows, columns = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(50) + 0.5, indexing="ij")
    centres = torch.stack([columns, rows], -1).view(1, -1, 2)
    hits = (centres - scene.points_uv[0, :, None]).square().sum(-1) < 1.7**2
    facts = facts_of(scene)
    assert facts.fragments == int(hits.sum())
    assert facts.most_layers == int(hits.sum(0).max())
    assert facts.points == 24 * 50
    assert int(hits.any(1).sum()) <= facts.shown_points <= facts.points


def test_tasks_take_turns_without_garbage_collection() -> None:
    ran: list[str] = []

    def task(name: str) -> None:
        ran.append(name)
        if len(ran) > 4:
            assert not gc.isenabled()

    times = _timing.interleave({"a": lambda: task("a"), "b": lambda: task("b")}, seconds=0.0, least=20)
    rounds = ["".join(ran[start : start + 2]) for start in range(0, len(ran), 2)]
    assert len(rounds) == 2 + 20 and set(rounds[2:]) == {"ab", "ba"}
    assert {name: len(values) for name, values in times.items()} == {"a": 20, "b": 20}
    assert gc.isenabled()


def test_a_busy_machine_proves_no_target_missed() -> None:
    for cores, word in ((0.0, "missed"), (0.5 * (_timing.os.cpu_count() or 1), "can't tell")):
        token = _timing.busy_cores.set(cores)
        assert _table.verdict(True) == "reached" and _table.verdict(False) == word
        assert _table.verdict(False, timed=False) == "missed"
        _timing.busy_cores.reset(token)


def test_spread_is_median_and_quartiles() -> None:
    assert _timing.Spread.of(np.array([5.0, 1.0, 3.0, 4.0, 2.0])) == _timing.Spread(3.0, 2.0, 4.0, 5)


def test_copies_move_what_they_say() -> None:
    features, ones = torch.randn(1, 7, 5), torch.ones(1, 7, 5)
    for sources, wanted in (((features,), features), ((features, ones), features + 1)):
        shares = _timing.memcpy(2, *sources)()
        assert len(shares) == 2 and np.array_equal(np.concatenate(shares), wanted.reshape(-1).numpy())
