"""Files that are whole or not there: full disks, rights, and what killed processes leave."""

import os
import resource
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from vestcl import io
from vestcl.io import atomic
from vestcl.io.exr import write_exr

ROOT = Path(__file__).resolve().parents[2]
WRITES = """
import sys, time
from vestcl.io.atomic import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half")
    print(temporary.name, flush=True)
    time.sleep(60)
"""


@contextmanager
def full_disk(size: int = 512) -> Iterator[None]:
    """No file may be longer than ``size`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def writer(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    """A process that is writing tmp_path/a.png."""
    atomic._tidied.discard(tmp_path)
    process = subprocess.Popen(
        [sys.executable, "-c", WRITES, str(tmp_path / "a.png")], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline().startswith(".a.")
    yield process
    process.kill()
    process.communicate()


def pixels() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)


@pytest.mark.parametrize("name", ["a.bin", "a.exr", "a.png", "a.gif", "a.npy"])
def test_a_full_disk_names_the_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    write = {
        ".bin": lambda: atomic.write_bytes(path, bytes(2000)),
        ".exr": lambda: write_exr(path, {"Z": np.random.default_rng(0).random((32, 32), np.float32)}),
        ".png": lambda: io.write_pixels(path, pixels()),
        ".gif": lambda: io.write_gif(path, [pixels()], 10),
        ".npy": lambda: io.write_depth(path, np.ones((32, 32), np.float32)),
    }[path.suffix]
    with full_disk(), pytest.raises(OSError, match="File too large") as caught:
        write()
    assert caught.value.filename == str(path)
    assert not list(tmp_path.iterdir())
    write()
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_in_the_files_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.bin").mkdir()
    with pytest.raises(IsADirectoryError) as caught:
        atomic.write_bytes(tmp_path / "a.bin", b"")
    assert caught.value.filename == str(tmp_path / "a.bin")


def test_errors_of_other_files_keep_their_names(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught, atomic.replacing(tmp_path / "a.bin"):
        (tmp_path / "source").read_bytes()
    assert caught.value.filename == str(tmp_path / "source")


def test_files_have_the_rights_of_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        atomic.write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_what_a_killed_process_left_is_removed(tmp_path: Path, writer: "subprocess.Popen[str]") -> None:
    (hidden,) = tmp_path.iterdir()
    atomic.write_bytes(tmp_path / "b", b"")
    assert hidden.exists(), "it is being written"
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    assert hidden.exists()
    atomic.write_bytes(tmp_path / "b", b"")
    assert hidden.exists(), "a folder is searched once"
    atomic._tidied.clear()
    atomic.write_bytes(tmp_path / "b", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_other_hidden_files_stay(tmp_path: Path) -> None:
    names = [".lock", ".a.png", ".a.12-0123456g.png", ".vestcl", "a.12-01234567.png", ".a.b-01234567.png"]
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / ".d.1-01234567").mkdir()
    os.mkfifo(tmp_path / ".f.1-01234567")
    atomic.remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*names, ".d.1-01234567", ".f.1-01234567"}
    atomic.remove_leftovers(tmp_path / "nowhere")


def test_threads_write_side_by_side(tmp_path: Path) -> None:
    def write(number: int) -> None:
        for _ in range(20):
            atomic.write_bytes(tmp_path / f"{number % 2}.bin", bytes(100))
            atomic.remove_leftovers(tmp_path)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.bin", "1.bin"]
