"""Streets by name, and what sensors and classifiers would say of their frames."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.cli import main as cli
from vestcl.cli.prepare import open_input, plan
from vestcl.data import STREET_SKY_DEPTH, Label, Street, street_clip
from vestcl.data.street import input as street_input
from vestcl.data.street.clip import Shot
from vestcl.data.street.driving.road import RoadDrive
from vestcl.data.street.input import Driven, parse
from vestcl.data.street.raycast import FOREGROUND
from vestcl.data.street.sensors import DisturbedLabels, StreetScan
from vestcl.prepare.clip import frame_keys
from vestcl.prepare.prepared import find_prepared
from vestcl.scene.inputs import inputs_of

SIZE = HEIGHT, WIDTH = 48, 160


def options(*inputs: str, **changes: Any) -> cli.Prepare:
    return cli.Prepare(inputs, **{"height": HEIGHT, "width": WIDTH, "frames": 3, "samples": 1, **changes})


# ---------------------------------------------------------------- names


def test_names() -> None:
    assert parse("kitti/0001") is None and parse("street:x") is None
    one = parse("street:7")
    assert one is not None and one.seeds == range(7, 8) and one.driven == Driven()
    several = parse("street:7-9?drive=road,fps=12.5,depth=stereo,masks=motion")
    assert several is not None and several.seeds == range(7, 10)
    assert several.driven == Driven("road", 12.5, "stereo", "motion")
    assert several.each()[2] == "street:9?drive=road,fps=12.5,depth=stereo,masks=motion"
    held_out = parse("street:?drive=road")
    assert held_out is not None and held_out.seeds is None and held_out.driven.drive == "road"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("street:7?drive=fast", "drive must be usual, random, road, got 'fast'"),
        ("street:7?speed=3", "must have options of drive, fps, depth and masks"),
        ("street:7?fps=0", "fps must be 0.1 ... 240 frames per second or random, got '0'"),
        ("street:7?fps=nan", "fps must be"),
        ("street:7?fps=8,fps=9", "has fps twice"),
        ("street:7?", "must have options"),
        ("street:9-7?drive=road", "from a lower to a higher seed"),
    ],
)
def test_refused_names(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("...", r"\.\.\.").replace("?", r"\?")):
        parse(text)


def test_draws_are_by_seed_and_in_range() -> None:
    asked = Driven("road", "random", "random", "random")
    drawn = [asked.drawn(seed) for seed in range(60)]
    assert all(8 <= float(one.fps or 0) <= 30 for one in drawn)
    assert {one.depth for one in drawn} == {"stereo", "motion", "scan"}
    assert {one.masks for one in drawn} == {"motion", "disturbed"}
    assert drawn == [asked.drawn(seed) for seed in range(60)]
    assert drawn[0].drawn(0) == drawn[0]


def test_the_default_street_stays_as_it_is() -> None:
    """Its frames have the same keys, whatever it is called by."""
    plain = street_clip(Street.generate(5), 3, *SIZE, samples=1)
    for text in ("street:5", "street:5?drive=usual", "street:5?depth=true,masks=true,fps=10"):
        assert frame_keys(open_input(text, options())) == frame_keys(plain)
    assert open_input("street:5", options()).name == "street 5"


def test_inputs_go_before_options() -> None:
    given = options(drive="road", street_fps="25", street_depth="stereo")
    clip = open_input("street:5?fps=20", given)
    assert clip.fps == pytest.approx(20) and clip[0].depth is None
    shot = plan(options("street:5-6?drive=road,fps=20", out=Path("x")))
    assert [task.folder.name for task in shot] == [f"street_{i}_drive_road_fps_20-48x160" for i in (5, 6)]
    image: Any = clip[0].image
    assert isinstance(image.shot.street.drive, RoadDrive)


def test_evaluation_and_forecast_take_the_drive(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from train.evaluate import _where
    from train.evaluation.options import Evaluation
    from train.evaluation.protocols import PROTOCOLS

    config = Evaluation("street", seeds=(7, 7), drive="road", street_fps=25.0, height=HEIGHT, width=WIDTH)
    (source,) = PROTOCOLS["street"].sources(_where(config, PROTOCOLS["street"]))
    clip = source.opens()
    assert source.name == clip.name == "street 7 drive=road fps=25" and clip.fps == pytest.approx(25)
    arguments = ["forecast", "street:7?drive=road,depth=scan", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 2
    assert "must have no depth and masks here" in capsys.readouterr().err


# ---------------------------------------------------------------- sensors


def test_a_scan_is_sparse_and_true(session: opencl.Session) -> None:
    shot = Shot(Street.generate(3), 1.0, 0.0, (128, 416), 1, True)
    truth = shot.take().depth[0]
    shares = []
    for beams in (64, 32, 16):
        scan = StreetScan(shot, beams, 0).read()
        shares.append(float((scan > 0).mean()))
        there = scan > 0
        assert np.abs(scan[there] - truth[there]).max() < 0.15
        assert (scan[there] - truth[there]).std() == pytest.approx(0.02, rel=0.2)
        assert not (truth[there] == STREET_SKY_DEPTH).any() and scan[there].max() < 121
        rows = np.flatnonzero(there[0].any(axis=1))
        assert rows.min() > 40  # 2 degrees above the horizon
    assert 0.05 < shares[0] < 0.25 and shares[0] > 1.8 * shares[1] > 3 * shares[2]
    assert not np.array_equal(StreetScan(shot, 64, 1).read(), StreetScan(shot, 64, 0).read())


def test_disturbed_labels_are_nearly_right(session: opencl.Session) -> None:
    shot = Shot(Street.generate(3), 1.0, 0.0, (128, 416), 1, True)
    truth, missed, off = shot.take().labels[0], 0, 0
    front = np.isin(truth, FOREGROUND)
    for index in range(12):
        labels = DisturbedLabels(shot, index).read()
        assert labels.shape == truth.shape and labels.dtype == np.uint8
        assert set(np.unique(labels)) <= set(np.unique(truth))
        assert (labels == Label.SKY).sum() >= (truth == Label.SKY).sum() * 0.95
        wrong = labels != truth
        assert 0 < wrong.mean() < 0.2
        missed += int((front & ~np.isin(labels, FOREGROUND)).sum())
        off += int((~front & np.isin(labels, FOREGROUND)).sum())
    assert missed > 0 and off > 0
    np.testing.assert_array_equal(DisturbedLabels(shot, 4).read(), DisturbedLabels(shot, 4).read())


def test_each_source_is_prepared(session: opencl.Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every depth and mask source gives frames, and all have the right camera's images as targets."""
    inputs = [f"street:5?drive=road,fps=20,depth={d},masks={m}" for d, m in
              (("motion", "motion"), ("scan", "disturbed"), ("stereo", "true"))]  # fmt: skip
    arguments = ["prepare", *inputs, "--out", str(tmp_path), "--height", "48", "--width", "160", "--frames", "3"]
    assert cli.main([*arguments, "--samples", "1"]) == 0
    assert "9 frames computed, 0 kept" in capsys.readouterr().out
    assert cli.main([*arguments, "--samples", "1"]) == 0
    assert "0 frames computed, 9 kept" in capsys.readouterr().out
    found = {clip.name.partition("depth=")[2].split()[0]: clip for clip in find_prepared(tmp_path)}
    assert all(all(clip.right_camera(index) is not None for index in range(len(clip))) for clip in found.values())
    assert [
        clip.inputs and (clip.inputs.depth, clip.inputs.masks, clip.inputs.stereo) for _, clip in sorted(found.items())
    ] == [
        ("motion", "motion", False),
        (
            "laser scans simulated from the street's depth, densified",
            "labels, with a classifier's errors simulated",
            False,
        ),
        ("the stereo pair at t-1 and t", "labels", True),
    ]
    keys = [clip.frames[1].key for clip in found.values()]
    assert len(set(keys)) == 3


def test_depth_from_motion_keeps_the_right_images_key() -> None:
    clip = street_input.clip(5, Driven("road", depth="motion"), 3, SIZE)
    seen = street_input.perceived(clip, Driven(depth="motion"))
    assert all(sample.right is None for sample in seen) and all(sample.right is not None for sample in clip)
    assert inputs_of(seen).depth == "motion"
    assert dataclasses.replace(clip, samples=seen.samples).name == clip.name
