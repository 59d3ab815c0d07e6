"""What benchmarks hand over: files that come back, devices in turn, plots that are there."""

import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from rich.console import Console

from vestcl import doctor, opencl
from vestcl.bench.common import plots as _plots
from vestcl.bench.common import results as _results
from vestcl.bench.common import table as _table
from vestcl.bench.common.options import Options
from vestcl.bench.common.results import Results
from vestcl.bench.common.timing import Spread, busy_cores
from vestcl.evaluation.tables import Grid


def results(bench: str = "abacus", device: str = "0:0 frame", **config: Any) -> Results:
    rows = [
        _table.Measurement("moved", "ms", Spread(2e-3, 1e-3, 3e-3, 5), "s", ".0f", "beads moved"),
        _table.Measurement("[red]kept", "ms", math.nan, "1", name="beads kept", better="higher"),
    ]
    section = _table.Section("Beads", rows, ("a note",))
    return Results(bench, {"device": device, "date": "now"}, {"rows": 9, **config}, section.frame, [section.grid()])


FIGURE = """{"vestcl": 1, "bench": "abacus", "devices": [{"machine": {}, "config": {}, "measures": [
    {"name": "a", "unit": "s", "median": 1.0, "low": 1, "high": 1, "better": "lower"}]}]}"""


@pytest.fixture
def console() -> Console:
    return Console(width=100, record=True, file=io.StringIO())


def doctored(monkeypatch: pytest.MonkeyPatch, *works: bool) -> list[opencl.DeviceInfo]:
    """Let the doctor find devices that work or not, all of them the default one."""
    infos = [opencl.select() for _ in works]
    passed, failed = (
        tuple(doctor.DeviceCheck(name, True) for name in doctor.STEPS),
        (doctor.DeviceCheck("build", False, "ill"),),
    )
    steps = {True: passed, False: failed}
    reports = [
        doctor.DeviceReport(info, steps[work], () if work else ("build: ill",))
        for info, work in zip(infos, works, strict=True)
    ]
    monkeypatch.setattr(doctor, "examine", lambda: doctor.Report(tuple(reports), infos[0].index, ()))
    return infos


# ---------------------------------------------------------------- files


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    saved = [results(), results(device="1:0 other", counts=[1, 2], nested={"a": None})]
    path, markdown = tmp_path / "new" / "r.json", tmp_path / "new" / "r.md"
    _results.save(saved, path, markdown)
    assert sorted(file.name for file in path.parent.iterdir()) == ["r.json", "r.md"]
    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)
    assert content["vestcl"] == 1 and content["bench"] == "abacus"
    assert [set(device) for device in content["devices"]] == [{"machine", "config", "measures"}] * 2
    loaded = _results.load(path)
    assert [result.grids for result in loaded] == [[], []]
    for one, two in zip(loaded, saved, strict=True):
        assert (one.bench, one.machine, one.config) == (two.bench, two.machine, two.config)
        pd.testing.assert_frame_equal(one.frame, two.frame, check_like=True)
        assert list(one.figures["name"]) == ["beads moved", "beads kept"]
        assert math.isnan(one.frame["median"][1]) and one.frame["better"][1] == "higher"
    text = markdown.read_text(encoding="utf-8")
    assert "0:0 frame" in text and "1:0 other" in text and text.count("| moved | 2 |") == 2 and "- date: now" in text


def test_nothing_is_written_where_no_file_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _results.save([results()], None, None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("saved", "message"),
    [([results(x=object())], "got object")],
)
def test_what_can_not_be_saved_leaves_the_old_file(tmp_path: Path, saved: list[Results], message: str) -> None:
    path = tmp_path / "r.json"
    _results.save([results()], path, None)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=message):
        _results.save(saved, path, None)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "no JSON"),
        ("[]", 'must be a file of `vestcl bench NAME --json` with "vestcl": 1'),
        ('{"vestcl": 2}', 'with "vestcl": 1'),
        ('{"vestcl": 1, "bench": "abacus"}', "lacks or mistakes 'devices'"),
        ('{"vestcl": 1, "bench": "abacus", "devices": [{"measures": [{"median": 1}]}]}', "lacks or mistakes 'low'"),
        ('{"vestcl": 1, "bench": "abacus", "devices": [[]]}', "lacks or mistakes"),
        (FIGURE.replace("1.0", '"x"'), "float: 'x'"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "other.json"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        _results.load(path)
    assert str(path) in str(caught.value)
    with pytest.raises(ValueError, match="absent"):
        _results.load(tmp_path / "absent.json")


def test_plain_values() -> None:
    @dataclass(frozen=True)
    class Config:
        json: Path | None
        radii: tuple[float, ...]

    config = Config(Path("a/b"), (1.0, math.inf))
    assert _results.settings(config) == {"json": "a/b", "radii": [1.0, None]}
    assert _results.plain({1: np.float32(0.5), "a": np.arange(2), "s": Spread(1.0, 0.0, 2.0, 3)}) == {
        "1": 0.5,
        "a": [0, 1],
        "s": {"median": 1.0, "low": 0.0, "high": 2.0, "runs": 3},
    }


def test_files_of_earlier_versions_have_figures_and_details(tmp_path: Path) -> None:
    figure = {"name": "a", "unit": "s", "median": 2.0, "low": 1.0, "high": None, "better": "lower"}
    device = {"machine": {}, "config": {}, "measures": [figure], "details": {"beads": [1]}}
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps({"vestcl": 1, "bench": "abacus", "devices": [device]}), encoding="utf-8")
    (found,) = _results.load(path)
    assert found.details == {"beads": [1]}
    (row,) = found.figures.to_dict("records")
    assert (row["name"], row["median"], row["table"], row["column"]) == ("a", 2.0, "", "") and math.isnan(row["high"])


def test_sections_become_figures_and_tables(console: Console) -> None:
    rows = [
        _table.Measurement("moved", "ms", Spread(2e-3, 1e-3, 3e-3, 5), "s", name="beads moved"),
        _table.Measurement("moved", "verdict", "<= 4 reached"),
        _table.Measurement("kept", "ms", math.nan, "s", ".1f"),
        _table.Measurement("kept", "", 0.5, name="beads kept", better="higher"),
    ]
    section = _table.Section("Beads", rows, ("a note",))
    figures = section.frame[section.frame["name"] != ""].set_index("name")
    assert list(figures.index) == ["beads moved", "beads kept"] and set(figures["table"]) == {"Beads"}
    assert list(figures["median"]) == [2e-3, 0.5] and list(figures["better"]) == ["lower", "higher"]
    grid = section.grid()
    _table.show_grid(grid, console)
    assert grid.heading == ("", "ms", "verdict") and grid.notes == ("a note",)
    assert grid.rows == (("moved", "2.00 (1.00-3.00)", "<= 4 reached"), ("kept", "-", ""))
    text = console.export_text()
    assert "Beads" in text and "2.00 (1.00-3.00)" in text and "a note" in text


@pytest.mark.parametrize("width", [40, 80, 300])
def test_a_table_that_is_too_wide_goes_on_below(width: int) -> None:
    columns = [f"column {number}" for number in range(12)]
    rows = [_table.Measurement(row, name, f"{row}{name}") for row in ("a", "b") for name in columns]
    grid = _table.Section("Wide", rows).grid()
    parts = list(_table.fitting(grid, width))
    assert [name for part in parts for name in part.heading[1:]] == columns
    assert all(part.heading[0] == "" and [row[0] for row in part.rows] == ["a", "b"] for part in parts)
    assert len(parts) == {40: 4, 80: 2, 300: 1}[width]
    console = Console(width=width, record=True, file=io.StringIO())
    _table.show_grid(grid, console)
    text = console.export_text()
    assert all(f"{row}{name}" in text for row in "ab" for name in columns), "no cell is cut"


# ---------------------------------------------------------------- devices


def test_one_device_is_current_while_it_is_measured(session: opencl.Session) -> None:
    before = opencl.current()
    seen = []

    def measure(one: opencl.Session) -> Results:
        seen.append((one, opencl.current()))
        return results()

    _results.measure_each(session.info.index, measure, Console())
    assert [one.info.index for one, _ in seen] == [session.info.index] and seen[0][0] is seen[0][1]
    assert opencl.current() is before
    machine = _results.describe(session)
    assert {"vestcl", "torch", "numpy", "pyopencl", "driver", "processor", "cores", "date"} <= set(machine)
    assert machine["device"].startswith(session.info.index)


def test_all_devices_are_those_that_the_doctor_passes(monkeypatch: pytest.MonkeyPatch, console: Console) -> None:
    infos = doctored(monkeypatch, True, False, True)
    seen = []

    def measure(one: opencl.Session) -> Results:
        seen.append(one.info)
        return results()

    assert len(_results.measure_each("all", measure, console)) == 2 and seen == [infos[0], infos[2]]
    assert f"{infos[1].index} {infos[1].platform} / {infos[1].name} left out: build: ill" in _flat(console)


def test_no_device_works(monkeypatch: pytest.MonkeyPatch, console: Console) -> None:
    doctored(monkeypatch, False)
    with pytest.raises(opencl.DeviceError, match="`vestcl doctor` tells why"):
        _results.measure_each("all", lambda _: results(), console)


def test_a_device_that_fails_is_reported_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, console: Console
) -> None:
    doctored(monkeypatch, True, True)
    outcomes: Iterator[Any] = iter([RuntimeError("burst"), results()])

    def measure(session: opencl.Session) -> Results:
        assert session is opencl.current()
        outcome = next(outcomes)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    assert [found.bench for found in _results.measure_each("all", measure, console)] == ["abacus"]
    assert "left out: RuntimeError: burst" in _flat(console)
    outcomes = iter([RuntimeError("burst"), RuntimeError("burst")])
    with pytest.raises(opencl.DeviceError, match="failed on every device"):
        _results.measure_each("all", measure, console)
    outcomes = iter([ValueError("`height` must be positive")])
    with pytest.raises(ValueError, match="height"):
        _results.measure_each("all", measure, console)
    outcomes = iter([RuntimeError("burst")])
    with pytest.raises(RuntimeError, match="burst"):
        _results.measure_each(None, measure, console)


def _flat(console: Console) -> str:
    return " ".join(console.export_text(clear=False).split())


# ---------------------------------------------------------------- plots and tables


SPREADS = [Spread(value, 0.8 * value, 1.3 * value, 5) for value in (1e-4, 3e-3)]


CELLS = (("y", "a", SPREADS[1]), ("x", "b", SPREADS[1]), ("y", "b", SPREADS[0]))


def test_plots_are_pictures(tmp_path: Path) -> None:
    lines = [
        _plots.Curve("a", [64, 256], [0.1, 9.0]),
        _plots.Curve("", [64, 90], [1, 2], "s--", "xy", ([60, 89], [70, 95])),
    ]
    rows = [_table.Measurement(row, column, one, "s") for row, column, one in (("x", "a", SPREADS[0]), *CELLS)]
    frame = _table.Section("", [*rows, _table.Measurement("y", "c", "text")]).frame
    figures = [
        _plots.curves("title", "points", {"ms": lines, "dB": lines}),
        *(_plots.bars(frame, "title", ("a", "b"), stacked) for stacked in (False, True)),
    ]
    assert [axes.get_yscale() for axes in figures[0].axes] == ["log", "log"]
    assert [axes.get_xscale() for axes in figures[0].axes] == ["linear", "linear"]
    for number, figure in enumerate(figures):
        path = tmp_path / "new" / f"{number}.png"
        _plots.write(figure, path)
        picture = np.asarray(Image.open(path).convert("L"))
        assert picture.shape[1] == 1200 and picture.shape[0] >= 300
        assert 0.5 < (picture > 250).mean() < 0.999, "something is drawn on white"
        assert (picture[:, [0, -1]] > 250).mean() > 0.9, "nothing runs over the edge"


def test_file_names() -> None:
    assert _plots.file_name("Splat over size, 0:0 / a") == "splat-over-size-0-0-a.png"


def test_verdicts_are_coloured_and_text_is_no_markup(console: Console) -> None:
    grid = Grid("[b]title", ("", "target"), (("[red]a", "<= 6 reached"), ("b", "missed it")), ("busy: measure again",))
    _table.show_grid(grid, console)
    plain, styled = console.export_text(clear=False), console.export_text(styles=True)
    assert "[b]title" in plain and "[red]a" in plain and "measure again" in " ".join(plain.split())
    assert "\x1b[32mreached" in styled and "\x1b[31mmissed" not in styled


def test_a_disturbed_section_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    def sections(*_: Any) -> Iterator[_table.Section]:
        for cores in (0.0, 9.0, 0.0):
            busy_cores.set(cores)
            yield _table.Section(f"table {cores}", [_table.Measurement("a", "b", "c")])

    _results.run("abacus", Options(), sections)
    quiet, disturbed, again = capsys.readouterr().out.split("\ntable ")[1:]
    assert "kept 9.0 cores busy meanwhile: measure again" in " ".join(disturbed.split())
    assert "busy" not in quiet and "busy" not in again
