"""Several processes at the same clips."""

import fcntl
import subprocess
from pathlib import Path

import pytest
from prepare_scenes import COMMAND, FRAMES, HEIGHT, ROOT, SMALL, WIDTH, contents, counted, options, run, until

from vestcl.prepare.files import frame_path


def test_two_at_once_compute_every_frame_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [*COMMAND, "street:5-7", "--out", str(tmp_path / "cache"), *SMALL]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) for _ in range(2)]
    done = [counted(process.communicate()[0]) for process in both]
    assert [process.returncode for process in both] == [0, 0]
    assert sum(computed for computed, _ in done) == 3 * FRAMES
    assert [computed + kept for computed, kept in done] == [3 * FRAMES] * 2
    run(options("street:5-7", out=tmp_path / "alone"), capsys)
    assert contents(tmp_path / "cache") == contents(tmp_path / "alone")


def test_other_clips_come_before_one_that_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken = tmp_path / f"street_5-{HEIGHT}x{WIDTH}"
    taken.mkdir()
    with (taken / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = [*COMMAND, "street:5-6", "--out", str(tmp_path), *SMALL]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
        until(lambda: (tmp_path / f"street_6-{HEIGHT}x{WIDTH}" / "clip.json").exists())
        assert process.poll() is None
        assert not frame_path(taken, 0).exists()
    assert counted(process.communicate()[0]) == (2 * FRAMES, 0)


def test_workers_make_what_one_process_makes_and_die_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*COMMAND, "street:5-6", "--out", str(tmp_path / "two"), *SMALL, "--workers", "2"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, cwd=ROOT)
    until(lambda: any((tmp_path / "two").rglob("*.safetensors")))
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.kill()
    process.wait()
    assert len(children) >= 2
    until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    settings = options("street:5-6", out=tmp_path / "two", workers=2)
    computed, kept = run(settings, capsys)
    assert kept >= 1 and computed + kept == 2 * FRAMES
    run(options("street:5-6", out=tmp_path / "one"), capsys)
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
