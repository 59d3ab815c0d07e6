"""A tenth of tests/stress/bad_input.py."""

from pathlib import Path

from stress import bad_input


def test_bad_input_is_refused_in_one_line(tmp_path: Path) -> None:
    cases = list(bad_input.faults(bad_input.CASES // 10, 3, tmp_path))
    assert len(cases) == 35
    assert [(answer["program"], answer["arguments"], fault) for _, answer, fault in cases if fault] == []
