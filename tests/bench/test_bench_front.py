"""`vestcl bench front`: time of the whole chain against error."""

import json
from pathlib import Path

import pandas as pd
import pytest

from vestcl.bench import front
from vestcl.bench.front import FrontBench
from vestcl.cli import main as cli
from vestcl.data import Street, street_clip

HEIGHT, WIDTH = 176, 352


def records() -> pd.DataFrame:
    """Two windows of one clip, one of another: clips count alike."""
    rows = [
        ("a", "geometric, 64 px", 1.0, [20.0, 10.0]),
        ("a", "geometric, 64 px", 3.0, [22.0, 12.0]),
        ("b", "geometric, 64 px", 2.0, [31.0, 21.0]),
        ("a", "repeat", 0.0, [10.0, 10.0]),
    ]
    more = {"index": 5, "ms_ssim": [0.5], "st_lpips": []}
    return pd.DataFrame(
        {"clip": clip, "method": name, "s": s, "cpu_s": 2 * s, "psnr": psnr, **more} for clip, name, s, psnr in rows
    )


def test_means_are_over_clips() -> None:
    found = front.means(records()).loc["geometric, 64 px"]
    assert found["s"].median == 2 and found["cpu_s"].median == 4
    assert found["psnr, t+1"] == pytest.approx((21 + 31) / 2) and found["psnr"] == pytest.approx((16 + 26) / 2)
    assert pd.isna(found["st_lpips"])


def test_what_was_not_measured_is_neither_a_column_nor_a_panel() -> None:
    section = front.section(records())
    assert "ST-LPIPS" not in {row.column for row in section.rows}
    assert [axes.get_ylabel() for axes in front.figure(records()).axes] == ["PSNR, dB", "MS-SSIM"]


def test_the_command_times_every_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clip = street_clip(Street.generate(5), 7, HEIGHT, WIDTH)
    monkeypatch.setattr("vestcl.forecasting.api.open", lambda text: clip)
    sizes = ["--height", str(HEIGHT), "--width", str(WIDTH), "--steps", "1", "--windows", "1"]
    files = ["--json", str(tmp_path / "front.json"), "--plots", str(tmp_path)]
    assert cli.main(["bench", "front", "street:5", "--work-widths", "0", "192", *sizes, *files]) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("geometric, own width", "geometric, 192 px", "optical flow", "repeat"))
    written = json.loads((tmp_path / "front.json").read_text())["records"]
    by_method = {record["method"]: record for record in written}
    assert by_method["geometric, own width"]["psnr"][0] > by_method["repeat"]["psnr"][0] + 3
    assert all(record["index"] == 5 and record["s"] > 0 for record in written)
    assert (tmp_path / "front.png").stat().st_size > 10_000


def test_refusals(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("vestcl.forecasting.api.open", lambda text: street_clip(Street.generate(5), 7, HEIGHT, WIDTH))
    assert cli.main(["bench", "front", "street:5", "--steps", "2"]) == 2
    assert "must have 8 frames or more, got 7" in capsys.readouterr().err
    with pytest.raises(ValueError, match="--work-widths 0 or more"):
        FrontBench(("a",), work_widths=(-1,))
