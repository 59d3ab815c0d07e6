"""docs/tables.py: the pages' tables are those of the JSON files, and what the script does with other files."""

import json
import re
from pathlib import Path
from typing import Any

import bench_rows
import pytest
import rows
import tables

ROOT = Path(__file__).resolve().parents[1]
MACHINE = {"vestcl": "0.1.0", "date": "2026-12-01T08:00:00+00:00", "processor": "A CPU", "cores": "2"}


def method(*psnr: float, windows: int = 2, **more: list[float | None]) -> dict[str, Any]:
    return {"windows": windows, "by_horizon": {"psnr": list(psnr), **more}}


def bench(**methods: dict[str, Any]) -> dict[str, Any]:
    """A file of `vestcl bench forecast` with one clip."""
    group = {"input": "/data/highway.mp4", "use": "checked", "views": {"source": methods}}
    return {"machine": MACHINE, "config": {}, "inputs": [group]}


def test_the_pages_are_those_of_the_files() -> None:
    """`make tables` after a bench; no figure is edited by hand."""
    assert [page.relative_to(ROOT).as_posix() for page in tables.stale()] == []


def test_every_table_is_shown_and_every_marker_is_closed() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in tables.pages())
    shown = {match["name"] for match in tables._BLOCK.finditer(text)}
    paths = {name: [ROOT / source.path for source in table.sources] for name, table in tables.TABLES.items()}
    waiting = {name for name, files in paths.items() if not all(file.is_file() for file in files)}
    assert shown == set(tables.TABLES) - waiting
    markers = (re.findall(rf"^<!-- {kind}", text, re.MULTILINE) for kind in ("table: ", "/table -->"))
    assert {len(found) for found in markers} == {len(list(tables._BLOCK.finditer(text)))}


def test_no_file_has_a_path_of_a_machine() -> None:
    for file in (ROOT / "docs" / "results").glob("*.json"):
        assert '"/' not in file.read_text(encoding="utf-8"), file.name


def test_a_row_by_hand() -> None:
    """Steps 1, 3 and 5; a metric that was not measured, and a step beyond the last, are "-"."""
    content = bench(
        **{
            "optical flow": method(30, 29, 28, 27, 26, ms_ssim=[0.9, 0.8, 0.7, 0.6, None]),
            "geometric": method(31.006, 30, 29.5),
        }
    )
    heading, *found = rows.clips("source", ("psnr", "ms_ssim"))(content)
    assert heading == ("PSNR / MS-SSIM; windows", "method", "t+1", "t+3", "t+5")
    flow = ("30.00 / 0.900", "28.00 / 0.700", "26.00 / -")
    assert found == [
        ("/data/highway.mp4 (checked); 2", "constant-velocity flow extrapolation", *flow),
        ("", "geometric", "31.01", "29.50", "-"),
    ]


def test_presets_by_hand() -> None:
    def point(value: str, ms: float, psnr: float) -> dict[str, Any]:
        return {
            "value": value, "seconds": {"median": ms / 1e3}, "psnr": {"median": psnr}, "ms_ssim": {"median": 0.9579}
        }  # fmt: skip

    front = {
        "points": [point("exact", 211, 25.8), point("blocks 2", 131.4, 25.9)],
        "qualities": {"exact": "exact", "balanced": "blocks 2"},
    }
    _, *found = rows.presets({"devices": [{"details": {"front": front}}]})
    assert found == [("`exact`", "211", "0", "0.958", ""), ("`balanced`", "131", "+0.10", "0.958", "blocks 2")]


def test_splatting_by_hand() -> None:
    def timed(ms: float, copies: float) -> dict[str, Any]:
        return {"time": {"median": ms / 1e3}, "copies": {"spread": {"median": copies}}}

    facts = {"radius": 1.0, "fragments": 547540}
    details = {
        "speed": [{"facts": facts, "forward": timed(7.4, 3.5), "both": timed(14.21, 3.2)}],
        "memory": [{"radius": 1.0, "ratio": 0.336}],
    }
    _, row = rows.splatting({"devices": [{"details": details}]})
    assert row == ("1", "547,540", "7.4 ms, 3.5x memcpy time", "14.2 ms, 3.2x memcpy time", "0.34")


def test_opacities_by_hand() -> None:
    """The worst array counts; other families and opacities are left out."""
    errors = {"outputs": {"image": 2e-7, "coverage": 1e-8}, "gradients": {"radii": 1e-7, "features": 3.04e-7}}
    row = {"family": "opacity", "knob": 1e-3, "errors": errors, "peers": {"dividing": errors, "clamping": errors}}
    three = [row | {"family": "depth"}, row, row | {"knob": 0.5}]
    _, *found = rows.opacities({"devices": [{"details": {"rows": three}}]})
    assert found == [("opacity 0.999", *["2.0e-07 / 3.0e-07"] * 3)]


def long_table(*cells: tuple[str, str, str, float | str]) -> dict[str, Any]:
    """A bench's file of (table, row, column, median or text)."""
    kept = [
        {
            "table": table,
            "row": row,
            "column": column,
            "median": value,
            "text": value if isinstance(value, str) else f"{value:.1e}",
        }
        for table, row, column, value in cells
    ]
    return {"devices": [{"measures": kept}]}


def test_tables_of_long_tables() -> None:
    """What benches write now has no details: every figure is a cell."""
    best = "best of 2 combinations"
    front = long_table(
        (best, "exact", "time", 0.211), (best, "exact", "PSNR", 25.8), (best, "exact", "MS-SSIM", 0.9579),
        (best, "exact", "is", "front exact"), (best, "blocks 2", "time", 0.1314), (best, "blocks 2", "PSNR", 25.9),
        (best, "blocks 2", "MS-SSIM", 0.9579), (best, "blocks 2", "is", "balanced"),
    )  # fmt: skip
    _, *found = rows.presets(front)
    assert found == [("`exact`", "211", "0", "0.958", ""), ("`balanced`", "131", "+0.10", "0.958", "blocks 2")]
    size = "256x832, C = 32, radius 1"
    speeds = {"forward ms": 7.4e-3, "forward x copy": 3.5, "both ms": 14.21e-3, "both x copy": 3.2, "x features": 0.336}
    cells = [("Splat", size, column, value) for column, value in speeds.items()]
    _, row = rows.splatting(long_table(("Splat", size, "fragments", "547,540"), *cells))
    assert row == ("1", "547,540", "7.4 ms, 3.5x memcpy time", "14.2 ms, 3.2x memcpy time", "0.34")
    columns = [f"{who}{kind}" for who in ("", "dividing ", "clamping ") for kind in ("output", "gradient")]
    errors = [("opacity: error", "0.001", column, 2e-7) for column in columns]
    _, *found = rows.opacities(long_table(*errors, ("depth: error", "0.001", "output", 1.0)))
    assert found == [("opacity 0.999", *["2.0e-07 / 2.0e-07"] * 3)]
    step = "forecast step, jam (33% foreground), vest-s, 256x832"
    times = {"nothing skipped": 0.167, "all skipped": 0.14}
    scene = [(step, row, "ms (quartiles)", seconds) for row, seconds in times.items()]
    peer = ("targets", "jam", "of DMVFN's", 0.55)
    _, *found = rows.skipping(long_table(*scene, (step, "all skipped", "saved", 0.16), peer))
    assert found == [("jam", "33%", "167", "140", "16%", "0.55")]


def test_keep_reduces_paths_to_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "DOCS", tmp_path)
    (tmp_path / "results").mkdir()
    file = tmp_path / "real.json"
    file.write_text(json.dumps(bench(geometric=method(31.0062891)) | {"clips": {"street 1": 2}}))
    kept = json.loads(tables.keep(file, "forecast").read_text())
    assert kept["inputs"][0]["input"] == "highway.mp4"
    assert kept["inputs"][0]["views"]["source"]["geometric"]["by_horizon"]["psnr"] == [31.0063]
    assert "clips" not in kept


def test_a_page_keeps_the_rest_of_its_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    (tmp_path / "a.json").write_text(json.dumps(bench(geometric=method(31.0))))
    source = tables.Source("a.json", "vestcl bench forecast CLIP")
    monkeypatch.setattr(tables, "TABLES", {"a": tables.Table((source,), rows.clips("source", ("psnr",)))})
    text = tables.filled("before\n<!-- table: a -->\nold\n<!-- /table -->\nafter\n")
    assert text.startswith("before\n<!-- table: a -->\n| PSNR; windows | ") and text.endswith(
        "\n<!-- /table -->\nafter\n"
    )
    assert "| 31.00 |" in text and "old" not in text
    assert "`vestcl bench forecast CLIP`; vestcl 0.1.0, 2026-12-01, A CPU, 2 cores." in text
    assert tables.filled(text) == text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "a.json: no such file; `vestcl bench x` writes it"),
        ("{", "a.json: no JSON"),
        ("[]", "must be a JSON"),
    ],
)
def test_a_file_that_is_none_is_named(
    content: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    if content is not None:
        (tmp_path / "a.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        tables.Source("a.json", "vestcl bench x").read()


def test_an_unknown_table_is_refused() -> None:
    with pytest.raises(ValueError, match="'colours' must be one of accuracy, "):
        tables.filled("<!-- table: colours -->\n<!-- /table -->")


def test_the_cameras_errors_are_next_to_their_ratio_to_constant_velocity() -> None:
    def part(rotation: float, translation: float) -> dict[str, dict[str, float]]:
        ours = {"rotation_deg": rotation, "translation_percent": translation}
        return {"forecast": ours, "constant velocity": {"rotation_deg": 0.5, "translation_percent": 4.0}}

    errors = {"/data/00.txt": {"0.1 s": {"all": part(0.25, 3), "bends": part(0.1, 1), "straights": part(9, 9)}}}
    _, *found = bench_rows.camera({"errors": errors})
    assert found == [("00", "0.250 (0.50) / 3.00 (0.75)"), ("00, bends", "0.100 (0.20) / 1.00 (0.25)")]


def test_the_best_inpainter_comes_first() -> None:
    means = {
        "telea": {"psnr": 14.24, "depth_median": 0.021, "depth_right": 0.8, "seconds": 0.1},
        "regions": {"psnr": 15.7, "depth_median": 0.01, "depth_right": 0.9, "seconds": 0.04},
    }
    _, first, second = bench_rows.inpainting({"means": means})
    assert first == ("road from road, walls from walls (default)", "15.7", "1.0%", "90%", "0.04")
    assert second[:2] == ("Telea", "14.2")


def test_remembered_frames_are_compared_with_none() -> None:
    """Filled pixels by their number, delta of the whole image; what was not measured is left out of its mean."""
    one = {"clip": "a", "open": 0.1, "psnr": 15.0, "st_lpips": 0.02}
    scores = [
        {**one, "memory": 0, "filled": 0.0, "whole": 20.0},
        {**one, "memory": 3, "filled": 0.5, "whole": 20.5},
        {**one, "memory": 0, "filled": 0.0, "whole": 22.0, "open": 0.3, "psnr": float("nan")},
        {**one, "memory": 3, "filled": 0.1, "whole": 22.0, "open": 0.3, "st_lpips": None},
    ]
    heading, none, three = bench_rows.memory({"scores": scores})
    assert heading[1:] == ("a; 2 images",)
    assert none == ("0", "0% / 15.00 / 0.0200 / +0.00") and three == ("3", "20% / 15.00 / 0.0200 / +0.25")


def device(title: str, cells: dict[str, dict[str, float]], **config: Any) -> dict[str, Any]:
    measures = [
        {"table": title, "row": row, "column": column, "median": median}
        for row, columns in cells.items()
        for column, median in columns.items()
    ]
    return {"devices": [{"machine": MACHINE, "config": config, "measures": measures}]}


def test_stages_of_networks_are_in_ms() -> None:
    small = device("vest-s, forecast, 256x832", {"encode": {"ms (quartiles)": 0.1}}, model="vest-s")
    large = device(
        "vest-paper, forecast, 256x832", {"lift": {"ms (quartiles)": 2}, "peak memory": {"GB": 1.5}}, model="vest-paper"
    )
    heading, *found = bench_rows.network(small, large)
    assert heading == ("median, ms", "vest-s, forecast", "vest-paper, forecast")
    assert found == [("encode", "100", ""), ("lift", "", "2000"), ("peak memory", "", "1.5 GB")]


def test_a_training_steps_share_of_opencl() -> None:
    cells = {"step, ms (quartiles)": 2.0, "forward, ms": 0.5, "backward, ms": 1.4, "Adam, ms": 0.1, "OpenCL, ms": 0.1}
    _, row = bench_rows.training(device("training step, vest-s", {"all": cells}))
    assert row == ("all", "2000", "500", "1400", "100", "5.0%")


def test_times_of_commands() -> None:
    measured = [("a.mp4", 0, 20.4, 1.26), ("a.mp4", 960, 10, 1), ("b", 960, 5, 1)]
    keys = ("input", "work_width", "cpu_s", "memory_gb")
    heading, *found = bench_rows.forecast_times({"rows": [dict(zip(keys, each, strict=True)) for each in measured]})
    assert heading == ("CPU time, memory", "own width", "960 px")
    assert found == [("a.mp4", "20 s, 1.3 GB", "10 s, 1.0 GB"), ("b", "-", "5 s, 1.0 GB")]


def test_the_front_is_of_means_over_clips() -> None:
    def record(clip: str, cpu_s: float, *psnr: float) -> dict[str, Any]:
        more = {"ms_ssim": [0.9], "st_lpips": [0.1]}
        return {"clip": clip, "method": "geometric, 640 px", "cpu_s": cpu_s, "psnr": list(psnr), **more}

    records = [record("a", 1, 20, 10), record("a", 2, 24, 14), record("b", 9, 30, 20)]
    _, row = bench_rows.front({"records": records})
    assert row == ("geometric, 640 px", "2.00", "26.00", "21.00", "0.900", "0.100")
