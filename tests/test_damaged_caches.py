"""A tenth of tests/stress/damaged_caches.py."""

from pathlib import Path

from stress import damaged_caches


def test_damaged_caches_are_named_and_healed(tmp_path: Path) -> None:
    trials = list(damaged_caches.faults(damaged_caches.TRIALS // 10, 0, tmp_path))
    assert len(trials) == 40
    assert [trial for trial in trials if trial[2]] == []
