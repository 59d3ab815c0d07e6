"""PoCL's cache where it can't be used: a temporary one, or the remedy."""

import errno
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from vestcl import interrupt, opencl
from vestcl.opencl import icd, pocl_cache

ROOT = Path(__file__).resolve().parents[2]
OPERATOR = """
import warnings
warnings.simplefilter("always")
from vestcl import doctor
print("wrong" if doctor._splat() else "right")
"""


@pytest.fixture(autouse=True)
def _fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(pocl_cache, "_caches", {})
    monkeypatch.setattr(interrupt, "_cleanups", [])
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "cache"))


def test_where_pocl_looks() -> None:
    assert pocl_cache.wanted({"POCL_CACHE_DIR": "/c", "XDG_CACHE_HOME": "/x", "HOME": "/h"}) == Path("/c")
    assert pocl_cache.wanted({"XDG_CACHE_HOME": "/x", "HOME": "/h"}) == Path("/x/pocl/kcache")
    assert pocl_cache.wanted({"XDG_CACHE_HOME": "", "HOME": "/h"}) == Path("/h/.cache/pocl/kcache")
    assert pocl_cache.wanted({}) == Path("/tmp/pocl")


def test_a_sound_cache_stays(tmp_path: Path) -> None:
    assert pocl_cache.ensure() == pocl_cache.Cache(tmp_path / "cache")
    assert os.environ["POCL_CACHE_DIR"] == str(tmp_path / "cache")
    assert list(tmp_path.rglob("*")) == [tmp_path / "cache"]
    assert pocl_cache.fault_before_build() == ""


@pytest.mark.parametrize("where", ["file", "file/below", "", "/proc/nothing/here", "n" * 300, "/" + "n/" * 600])
def test_one_that_can_not_be_used(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("POCL_CACHE_DIR", where and str(tmp_path / where))
    cache = pocl_cache.ensure()
    assert cache.folder.parent == tmp_path and cache.folder.is_dir()
    assert os.environ["POCL_CACHE_DIR"] == str(cache.folder)
    assert cache.note.startswith("PoCL's cache ") and cache.note.endswith(
        "a temporary one for this run: let POCL_CACHE_DIR name a folder that can be written, with 32 MiB free"
    )
    assert pocl_cache.ensure() is cache
    for cleanup in interrupt._cleanups:
        cleanup()
    assert not cache.folder.exists()


def test_a_full_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reserve(file: int, offset: int, size: int) -> None:
        where = Path(f"/proc/self/fd/{file}").readlink()
        if where.is_relative_to(tmp_path / "cache"):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", reserve)
    cache = pocl_cache.ensure()
    assert f"{tmp_path / 'cache'} can't be used (No space left on device)" in cache.note
    assert cache.folder.exists()


def test_without_any_space_it_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reserve(file: int, offset: int, size: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, "posix_fallocate", reserve)
    fault = pocl_cache.ensure().fault
    assert "can't be used (Disk quota exceeded), nor a temporary one in" in fault
    assert "let POCL_CACHE_DIR name a folder" in fault
    assert icd.no_device() == f"no OpenCL device: {fault}"
    with pytest.raises(opencl.DeviceError, match="let POCL_CACHE_DIR name a folder"):
        opencl.open_session.__wrapped__(opencl.select("pocl"), "tile")


def test_a_disk_that_becomes_full(monkeypatch: pytest.MonkeyPatch) -> None:
    pocl_cache.ensure()
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((4096, 4096, 9, 9, 9, 0, 0, 0, 0, 255)))
    assert "has no space left" in pocl_cache.fault_before_build()


def test_leftovers_are_removed_and_others_caches_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cache").touch()
    mine = pocl_cache.ensure().folder
    dead = tmp_path / f"{pocl_cache._PREFIX}dead"
    dead.mkdir()
    (dead / ".lock").touch()
    pocl_cache._remove_leftovers()
    assert mine.exists() and not dead.exists()


def test_kernels_run_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "cache").touch()
    done = subprocess.run(
        [sys.executable, "-c", OPERATOR], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")},
    )  # fmt: skip
    assert done.stdout == "right\n"
    assert f"PoCL's cache {tmp_path / 'cache'} can't be used (File exists)" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
