"""Several processes at the same clips."""

import contextlib
import fcntl
from pathlib import Path

import pytest
from prepare_scenes import FRAMES, HEIGHT, WIDTH, contents, counted, options, prepare, run, until

from vestcl.prepare.files import frame_path


def test_two_at_once_compute_every_frame_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = [prepare(tmp_path / name, "street:5-7", "--out", str(tmp_path / "cache")) for name in ("log 1", "log 2")]
    assert [process.wait() for process in both] == [0, 0]
    done = [counted(process.output) for process in both]
    assert sum(computed for computed, _ in done) == 3 * FRAMES
    assert [computed + kept for computed, kept in done] == [3 * FRAMES] * 2
    run(options("street:5-7", out=tmp_path / "alone"), capsys)
    assert contents(tmp_path / "cache") == contents(tmp_path / "alone")


def test_other_clips_come_before_one_that_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = tmp_path / f"street_5-{HEIGHT}x{WIDTH}"
    taken.mkdir()
    with (taken / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = prepare(tmp_path / "log", "street:5-6", "--out", str(tmp_path))
        until(lambda: (tmp_path / f"street_6-{HEIGHT}x{WIDTH}" / "clip.json").exists())
        assert process.runs()
        assert not frame_path(taken, 0).exists()
    assert process.wait() == 0 and counted(process.output) == (2 * FRAMES, 0)


def test_workers_make_what_one_process_makes_and_die_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    process = prepare(tmp_path / "log", "street:5-6", "--out", str(tmp_path / "two"), "--workers", "2")
    until(lambda: any((tmp_path / "two").rglob("*.safetensors")) and len(processes_at(tmp_path / "two")) == 2)
    process.kill()
    process.wait()
    until(lambda: not processes_at(tmp_path / "two"))
    settings = options("street:5-6", out=tmp_path / "two", workers=2)
    computed, kept = run(settings, capsys)
    assert kept >= 1 and computed + kept == 2 * FRAMES
    run(options("street:5-6", out=tmp_path / "one"), capsys)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")


def processes_at(folder: Path) -> set[int]:
    """Those that have a file of ``folder`` open."""
    found = set()
    for process in (path for path in Path("/proc").iterdir() if path.name.isdecimal()):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            if any(link.readlink().is_relative_to(folder) for link in (process / "fd").iterdir()):
                found.add(int(process.name))
    return found
