"""train.evaluation.report: tables and files of numbers that were put in."""

import dataclasses

from train.evaluation.protocols import NOW, PROTOCOLS, Protocol
from train.evaluation.report import EvaluationResults, as_json, grids, headline, markdown, short_grids, table_of_windows
from train.evaluation.windows import CAMERA, CONSTANT_VELOCITY
from vestcl.evaluation.scores import GEOMETRIC, Record
from vestcl.evaluation.tables import Grid

NAME = PROTOCOLS["kitti-space"].title


def record(method: str, clip: str, values: list[float], view: str = "source", metric: str = "ms_ssim") -> Record:
    return Record(clip, "000003", 3, view, method, 0.5, {metric: values}, first=0 if view == NOW else 1)


def results(*more: Record, protocol: Protocol = PROTOCOLS["kitti-space"]) -> EvaluationResults:
    """Two clips, a model that is better by 0.1 in one and worse by 0.05 in the other at t+1."""
    records = [
        record(GEOMETRIC, "a", [0.8, 0.6, 0.4]),
        record(GEOMETRIC, "b", [0.6, 0.5, 0.2]),
        record("ours", "a", [0.9, 0.6, 0.4]),
        record("ours", "b", [0.55, 0.5, 0.2]),
        *more,
    ]
    return EvaluationResults(protocol, records, (1, 3), ("ours",), ("Told.",))


def test_tables_name_how_models_made_later_frames() -> None:
    named = dataclasses.replace(results(), modes={"ours": "feedback"})
    for make in (grids, short_grids):
        own = [grid for grid in make(named) if not grid.title.endswith("the paper")]
        assert own and all(grid.notes[-1] == "Mode of later frames: ours feedback." for grid in own)
        assert all(sum("Mode of" in note for note in grid.notes) == 1 for grid in own)
    assert not any("Mode of" in note for grid in grids(results()) for note in grid.notes)


def find(made: list[Grid], title: str) -> Grid:
    (grid,) = [grid for grid in made if grid.title == f"{NAME}, {title}"]
    return grid


def test_tables_by_hand() -> None:
    made = grids(results())
    horizon = find(made, "view source, mean over 2 windows")
    assert horizon.heading == ("", "MS-SSIM t+1", "MS-SSIM t+3", "s")
    assert horizon.rows == ((GEOMETRIC, "0.700", "0.300", "0.50"), ("ours", "0.725", "0.300", "0.50"))
    interval = find(made, "view source, mean and 95 % interval")
    assert interval.rows[0] == (GEOMETRIC, "0.700 [0.600, 0.800]", "0.300 [0.200, 0.400]")
    assert interval.notes == ("Intervals: bootstrap over 2 clips, with all of their windows.",)
    difference = find(made, "view source, model less geometric")
    assert difference.heading == ("", "t+1", "t+3")
    assert difference.rows == (("ours, MS-SSIM", "+0.025 [-0.050, +0.100], 50%", "+0.000 [+0.000, +0.000], 0%"),)
    by_clip = find(made, "view source, by clip")
    assert by_clip.rows[1] == ("b", "1", "0.600", "0.200", "0.550", "0.200")


def test_the_present_has_a_column_of_its_own() -> None:
    made = grids(results(record(GEOMETRIC, "a", [0.7], NOW), record(GEOMETRIC, "b", [0.9], NOW)))
    now = find(made, f"view {NOW}, mean over 2 windows")
    assert now.heading == ("", "MS-SSIM t", "s") and now.rows == ((GEOMETRIC, "0.800", "0.50"),)
    assert not [grid for grid in made if NOW in grid.title and "model less" in grid.title]
    rows = table_of_windows(results(record(GEOMETRIC, "a", [0.7], NOW)).records).splitlines()
    assert rows[-1].startswith(f"a,000003,3,{NOW},{GEOMETRIC},0,0.5,,,0.7,")


def test_running_means_are_up_to_the_horizon() -> None:
    protocol = dataclasses.replace(PROTOCOLS["kitti-space"], now=False)
    images = [record(GEOMETRIC, "a", [10.0, 20.0, 60.0], metric="psnr")]
    made = grids(EvaluationResults(protocol, images, (1, 3), ()))
    running = find(made, "view source, mean over 1 window, and over t+1 to the horizon")
    assert running.heading == ("", "PSNR t+3", "s") and running.rows == ((GEOMETRIC, "30.00", "0.50"),)


def test_the_camera_is_held_against_constant_velocity() -> None:
    camera = [record(CONSTANT_VELOCITY, c, [4.0, 4.0, 8.0], CAMERA, "translation_percent") for c in "ab"]
    camera += [record("ours", c, [3.0, 3.0, 9.0], CAMERA, "translation_percent") for c in "ab"]
    found = find(short_grids(results(*camera)), f"view {CAMERA}, model less {CONSTANT_VELOCITY}")
    assert found.rows == (("ours, translation", "-1.00 [-1.00, -1.00], 100%", "+1.00 [+1.00, +1.00], 0%"),)


def test_one_clip_is_marked_as_doubtful() -> None:
    made = grids(EvaluationResults(PROTOCOLS["clip"], [record(GEOMETRIC, "a", [0.5])], (1,), ()))
    (interval,) = [grid for grid in made if "interval" in grid.title]
    assert "too narrow" in interval.notes[0]
    assert not [grid for grid in made if "by clip" in grid.title]


def test_files_hold_the_paper_and_what_was_reported() -> None:
    done = results()
    reported = as_json(done, {"settings": {}})
    assert reported["notes"] == ["Told."] and reported["settings"] == {}
    assert reported["clips"]["b"]["source"]["ours"]["by_horizon"]["ms_ssim"][0] == 0.55
    assert {row["method"] for row in reported["paper"]} == {"the paper, space", "the paper, time"}
    text = markdown(done, ["ours: sha256 1234"])
    assert text.startswith(f"# {NAME}\n\n- ours: sha256 1234\n- Told.\n")
    for row in done.protocol.paper:
        assert f"{next(iter(row.values.values())):.3f}" in text
    assert f"| {row.method}, view {row.view} |" in text


def test_headline() -> None:
    both = [Record("a", "0", 0, "source", "m", 0, {"psnr": [1], "ssim": [1], "squeeze": [1], "lpips": [1]})]
    assert headline(both) == ["ssim", "lpips"]
    assert headline([record("m", "a", [1.0], metric="psnr")]) == ["psnr"]
    assert headline([record("m", "a", [1.0], CAMERA, "rotation_deg")]) == ["rotation_deg"]
