"""vestcl.bench.forecast.inpaint: the figures are those of known errors, and the table and file hold them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vestcl.bench.forecast import inpaint
from vestcl.bench.forecast.inpaint import InpaintBench, main, score
from vestcl.cli.main import main as command
from vestcl.data import Street, street_clip


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
    assert f"{content['means']['telea']['psnr']:.2f}" in printed and "regions (default)" in printed


def test_no_streets() -> None:
    with pytest.raises(ValueError, match="`streets` must be 1 or more"):
        InpaintBench(streets=0)


def test_an_unknown_method_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        command(["bench", "inpaint", "--streets", "1", "--height", "64", "--width", "208", "--methods", "magic"]) == 2
    )
    assert "`method` must be one of" in capsys.readouterr().err


def test_open_pixels_of_a_street() -> None:
    """Scores of every step, camera and number of frames; more memory covers no fewer of the open pixels."""
    clip = street_clip(Street.generate(4), 10, 48, 160)
    assert inpaint.windows_of(clip, 1, (0, 2)) == [3]
    scores = list(inpaint.measure_open(clip, [3], (0, 2), None))
    assert [(one["step"], one["memory"]) for one in scores if one["view"] == "source"] == [
        (step, count) for step in inpaint.STEPS for count in (0, 2)
    ]
    assert all(one["filled"] == 0 for one in scores if one["memory"] == 0) and any(one["filled"] > 0 for one in scores)
    assert len(inpaint.open_section(scores, "street").grid().rows) == 2
    with pytest.raises(ValueError, match="must have 9 frames or more, got 8"):
        inpaint.windows_of(clip[:8], 1, (0, 2))


@pytest.mark.parametrize(("option", "words"), [({"windows": 0}, "`windows`"), ({"memory": (-1,)}, "`memory`")])
def test_numbers_of_clips_out_of_range(option: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"{words} must be"):
        InpaintBench(**option)
