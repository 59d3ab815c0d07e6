"""vestcl.bench.inpaint: the figures are those of known errors, and the table and file hold them."""

import json
from pathlib import Path

import numpy as np
import pytest

from vestcl.bench import inpaint
from vestcl.bench.inpaint import InpaintBench, main, score
from vestcl.cli import main as command


def test_score_of_a_known_error(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, depth = np.full((3, 8, 8), 0.5, np.float32), np.full((1, 8, 8), 10, np.float32)
    mask = np.ones((1, 8, 8), bool)
    mask[0, 2:6, 2:6] = False
    wrong_depth = depth.copy()
    wrong_depth[0, 2:4, 2:6] = 12  # half of what is hidden is off by a fifth
    monkeypatch.setattr(inpaint, "inpaint_background", lambda *_, method: (truth + 0.1, wrong_depth))
    found = score("any", truth, depth, mask, truth, depth)
    assert found["psnr"] == pytest.approx(20, abs=1e-3)
    assert found["depth_right"] == 0.5 and found["depth_median"] == pytest.approx(0.1)


def test_a_run_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "inpaint.json"
    main(InpaintBench(streets=1, height=64, width=208, methods=("regions", "telea"), json=file))
    printed = capsys.readouterr().out
    content = json.loads(file.read_text(encoding="utf-8"))
    assert set(content["means"]) == {"regions", "telea"} and len(content["scores"]["telea"]) == 1
    assert f"{content['means']['telea']['psnr']:.2f} dB" in printed and "regions (default)" in printed


def test_no_streets() -> None:
    with pytest.raises(ValueError, match="`streets` must be 1 or more"):
        InpaintBench(streets=0)


def test_an_unknown_method_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        command(["bench", "inpaint", "--streets", "1", "--height", "64", "--width", "208", "--methods", "magic"]) == 2
    )
    assert "`method` must be one of" in capsys.readouterr().err
