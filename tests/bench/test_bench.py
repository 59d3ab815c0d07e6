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
from vestcl.bench.common import timing as _timing
from vestcl.bench.splat import bench as splat
from vestcl.bench.splat import measure as _measure
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
    content, printed = json.loads(path.read_text(encoding="utf-8")), capsys.readouterr().out
    (device,) = content["devices"]
    results = device["details"]
    assert {"vestcl", "torch", "numpy", "pyopencl", "device", "driver", "processor", "cores", "date"} <= set(
        device["machine"]
    )
    assert device["config"]["radii"] == [1.0, 2.0]
    assert [speed["facts"]["radius"] for speed in results["speed"]] == [1.0, 2.0]
    for speed in results["speed"] + results["scaling"] + results["channels"]:
        assert speed["facts"]["points"] == speed["facts"]["height"] * speed["facts"]["width"]
        for name in ("forward", "both"):
            assert 0 < speed[name]["time"]["low"] <= speed[name]["time"]["median"] <= speed[name]["time"]["high"]
            assert speed[name]["time"]["runs"] >= _timing.LEAST_ROUNDS
            assert speed[name]["copies"]["spread"]["median"] > 0
    assert [[peer["name"] for peer in result["peers"]] for result in results["peers"]] == [["vestcl", "sparse"]] * 2
    assert results["speed"][0]["forward"]["copies"]["target"] is None, "targets hold for 256x832"
    assert all(max(peer["errors"].values()) < 2e-6 for result in results["peers"] for peer in result["peers"])
    assert {kernel["name"] for kernel in results["kernels"][0]["kernels"]} >= {"count_tiles", "clear_gradients"}
    assert len(results["memory"]) == 2
    assert [speed["facts"]["channels"] for speed in results["channels"]] == [1, 3, 1, 3]
    assert [speed["facts"]["width"] for speed in results["scaling"]] == [16, 32, 16, 32]
    for text in ("x copy", "forward + backward", "sparse", "PyTorch3D is not installed", "GB/s", "pixels^"):
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
    expanding, compiled = splat._expanding(splat.SplatBench(), splat.Console())
    assert expanding is _peer.expand
    assert not compiled
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


def test_a_busy_machine_decides_nothing() -> None:
    spread, cores = _timing.Spread(3.0, 2.0, 4.0, 5), _timing.os.cpu_count()
    assert _measure.ratio(spread, 4.0, 0.0)["reached"] is True
    assert _measure.ratio(spread, 4.0, None, at_most=False)["reached"] is False
    assert _measure.ratio(spread, 2.0, 0.5 * cores, at_most=False)["reached"] is None
    assert _measure.ratio(spread, None, 0.0, at_most=False)["reached"] is None


def test_spread_is_median_and_quartiles() -> None:
    assert _timing.Spread.of(np.array([5.0, 1.0, 3.0, 4.0, 2.0])) == _timing.Spread(3.0, 2.0, 4.0, 5)


def test_copies_move_what_they_say() -> None:
    features = torch.randn(1, 7, 5)
    for copies in (_timing.copies_of_forward(features, 2), _timing.copies_of_backward(features, 2)):
        for name, task in copies.items():
            result = task()
            if isinstance(result, torch.Tensor):
                assert torch.equal(result, features if name == "torch copy_" else features + 1)
            else:
                assert len(result) == 2


@pytest.mark.parametrize("power", [1.0, 1.5])
def test_growth_finds_the_power(power: float) -> None:
    assert _measure.growth([10, 20, 40], [3 * n**power for n in (10, 20, 40)]) == pytest.approx(power)
