"""`vestcl bench pipeline`: what its scenes hold, that it runs and tells what it should. No time is judged."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from forecaster_scenes import OBJECTS, SMALL, stir
from PIL import Image

from vestcl.bench.common import results as _results
from vestcl.bench.common.timing import busy_cores
from vestcl.bench.pipeline import traffic as _traffic
from vestcl.bench.pipeline.bench import PipelineBench, load, main, verdicts
from vestcl.bench.pipeline.measure import ALL, NONE, PEER, SWITCHES, Stepper, variants
from vestcl.bench.pipeline.traffic import EMPTY, EVERYTHING, JAM, STREETS, TRAFFIC, drive
from vestcl.models.config import EncoderConfig
from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.options import InferenceOptions
from vestcl.models.inference.stage_times import REST, STAGES

HEIGHT, WIDTH = 32, 96

#: As vest-s in all that can be skipped.
SPARE = dataclasses.replace(
    SMALL,
    encoder=EncoderConfig(widths=(8, 8, 8), blocks=(1, 1, 1), decoder=(8, 8), features=4, background="frame"),
    object_motion=dataclasses.replace(OBJECTS, where="foreground"),
    render=dataclasses.replace(SMALL.render, stretched=True, inpainted="last", previous="uncovered"),
)


def model() -> Forecaster:
    torch.manual_seed(0)
    return stir(Forecaster(SPARE)).eval()


@pytest.fixture(scope="module")
def drives() -> dict[str, _traffic.Drive]:
    return {name: drive(name, HEIGHT, WIDTH, 4, 1100) for name in (*STREETS, EVERYTHING)}


def test_the_streets_get_fuller(drives: dict[str, _traffic.Drive]) -> None:
    shares = [drives[name].foreground for name in STREETS]
    assert shares[0] == 0 < shares[1] < shares[2]
    for name in STREETS:
        first, second = (window.given for window in drives[name].windows)
        assert torch.equal(first.frame_cur.image, second.frame_prev.image)
        assert first.frame_cur.image.data_ptr() != second.frame_prev.image.data_ptr()
        truth = drives[name].windows[0].truth
        assert truth is not None and torch.equal(truth, second.frame_cur.image)


def test_a_jam_is_slow_and_full() -> None:
    jam, usual = (_traffic.street(name, 1100) for name in (JAM, TRAFFIC))
    assert jam.drive.speed < usual.drive.speed / 4
    cars = [
        sum(mover.file.kind == "car" for mover in street._traffic().movers(0.0, 0.0, 200.0)) for street in (jam, usual)
    ]
    assert cars[0] > 1.5 * cars[1]
    for t in (0.0, 20.0):  # nobody in anybody else
        lanes: dict[int, list[float]] = {}
        for mover in jam._traffic().movers(t, 0.0, 200.0):
            if mover.file.kind == "car":
                lanes.setdefault(mover.file.tag, []).append(mover.position[2])
        assert len(lanes) == 2
        assert all(np.diff(sorted(places)).min() > 4.9 for places in lanes.values())


def test_everything_needs_everything(drives: dict[str, _traffic.Drive]) -> None:
    """No frame comes twice, foreground is near every pixel; of two frames' points alone some are always covered."""
    scene = drives[EVERYTHING]
    images = [frame.image for window in scene.windows for frame in window.frames]
    assert not any(torch.equal(a, b) for i, a in enumerate(images) for b in images[:i])
    near = torch.nn.functional.max_pool2d(1 - scene.windows[0].frames[0].mask, 8, stride=1)
    assert near.min() == 1
    with torch.no_grad():
        _, counts = Stepper(model(), ALL, InferenceOptions(covered=True, still=True), scene).look()
    assert all(counts[switch].skipped == 0 < counts[switch].of for switch in ("seen", "background", "objects", "views"))
    assert counts["covered"].skipped < 0.8 * counts["covered"].of


def test_variants_switch_one_on() -> None:
    found = variants(InferenceOptions(margin=8))
    assert list(found) == [NONE, *(f"{switch} alone" for switch in SWITCHES), ALL]
    for switch in SWITCHES:
        skip = found[f"{switch} alone"]
        assert [getattr(skip, other) for other in SWITCHES] == [other == switch for other in SWITCHES]
        assert skip.margin == 8
    assert found[NONE] == InferenceOptions(margin=8).without_skips() and found[ALL] == InferenceOptions(margin=8)


def test_what_is_skipped_is_counted_and_changes_nothing(drives: dict[str, _traffic.Drive]) -> None:
    with torch.no_grad():
        for name in (EMPTY, TRAFFIC):
            nothing, _ = Stepper(model(), NONE, InferenceOptions().without_skips(), drives[name]).look()
            everything, counts = Stepper(model(), ALL, InferenceOptions(), drives[name]).look()
            assert len(nothing) == len(everything) == 1
            assert torch.allclose(nothing[0], everything[0], atol=1e-4)
            assert counts["seen"][:2] == (1, 2)
            if name == EMPTY:
                assert all(counts[switch].skipped == counts[switch].of > 0 for switch in ("background", "objects"))


def test_a_run_writes_and_prints_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    model().save(tmp_path / "model.safetensors")
    main(
        PipelineBench(
            str(tmp_path / "model.safetensors"),
            (EMPTY, EVERYTHING),
            HEIGHT,
            WIDTH,
            frames=4,
            seconds=0.01,
            threads=1,
            quality="exact",
            json=tmp_path / "new folder" / "pipeline.json",
            markdown=tmp_path / "pipeline.md",
            plots=tmp_path / "plots",
            trace=tmp_path / "trace.json",
        )
    )
    (result,), printed = _results.load(tmp_path / "new folder" / "pipeline.json"), capsys.readouterr().out
    assert result.bench == "pipeline" and result.config["quality"] == "exact"
    figures = result.figures.set_index("name")
    for scene in (EMPTY, EVERYTHING):
        for variant in (NONE, ALL, "seen alone", PEER, "copy", "inpaint"):
            assert figures["median"][f"{scene}: {variant}"] > 0 and figures["unit"][f"{scene}: {variant}"] == "s"
        for stage in (*STAGES.values(), REST):
            assert figures["median"][f"{scene}: {NONE}: {stage}"] >= 0
        whole = figures.loc[f"{scene}: {NONE}"]
        assert whole["runs"] == figures["runs"][f"{scene}: {NONE}: refine"] >= 2
        assert whole["low"] <= whole["median"] <= whole["high"]
    assert figures["unit"][f"{EMPTY}: lost"] == "dB" and f"{EVERYTHING}: lost" not in figures.index
    skipped = result.frame[(result.frame["column"] == "skipped") & (result.frame["row"] == "objects alone")]
    assert skipped["text"].iloc[0].startswith("100% of")
    assert result.frame["column"].str.startswith("target ").sum() == 4
    (plot,) = (tmp_path / "plots").iterdir()
    with Image.open(plot) as picture:
        assert picture.width > 1000 and len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    events = json.loads((tmp_path / "trace.json").read_text(encoding="utf-8"))["traceEvents"]
    assert {"encode", "splat", NONE, ALL, PEER, EMPTY} <= {event["name"] for event in events}
    for text in (
        "forecast step, empty road (0% foreground)",
        "covered alone",
        "targets",
        "against nothing",
    ):
        assert text in printed and text in (tmp_path / "pipeline.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "of_peer", "saved", "loss", "cores", "words"),
    [
        (EMPTY, 0.2, 0.5, 0.05, 0.0, ["reached", "reached", "reached"]),
        (EMPTY, 0.3, 0.3, 0.2, 0.0, ["missed", "missed", "missed"]),
        (EMPTY, 0.3, 0.3, 0.2, 9.0, ["can't tell", "can't tell", "missed"]),
        (TRAFFIC, 0.3, 0.3, 0.0, 9.0, ["reached", "reached", "reached"]),
        (JAM, 0.6, 0.0, 0.0, 0.0, ["missed", "reached"]),
        (EVERYTHING, 9.0, -0.01, None, 0.0, ["reached"]),
        (EVERYTHING, 9.0, -0.03, None, 0.0, ["missed"]),
    ],
)
def test_verdicts(name: str, of_peer: float, saved: float, loss: float | None, cores: float, words: list[str]) -> None:
    token = busy_cores.set(cores)
    found = verdicts(name, of_peer, saved, loss)
    busy_cores.reset(token)
    assert [text.split(" ", 2)[2] for text in found.values()] == words


def test_load_takes_quality_and_precision(tmp_path: Path) -> None:
    plain = model()
    plain.save(tmp_path / "model.safetensors")
    config = PipelineBench(str(tmp_path / "model.safetensors"), quality="balanced", precision="bfloat16")
    for accelerated in (False, True):
        found = load(dataclasses.replace(config, accelerated=accelerated))
        assert found.options.autocast == "bfloat16" and found.options.margin is not None
        assert (type(found) is Forecaster) != accelerated
    assert load(dataclasses.replace(config, precision="float32")).options.autocast is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": 0}, "`height` must be positive, got 0"),
        ({"width": 100}, "`width` must be a multiple of 16 px, got 100"),
        ({"frames": 3}, "`frames` must be 4 or more, got 3"),
        ({"scenes": ()}, "`scenes` must be one or more, got none"),
        ({"seconds": 0.0}, "`seconds` must be positive"),
        ({"model": "vest-xl"}, "vest-xl: is not a model"),
    ],
)
def test_refuses(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        main(PipelineBench(**change))
    with pytest.raises(ValueError, match="`name` must be one of"):
        drive("motorway", HEIGHT, WIDTH, 4, 0)
