"""How drivers are found: broken .icd files and linkers by name, and Intel's runtime from pip."""

import os
import sys
from importlib import metadata
from pathlib import Path, PurePosixPath
from types import SimpleNamespace

import pytest

from vestcl import opencl
from vestcl.opencl import icd


@pytest.fixture
def vendors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "vendors"
    folder.mkdir()
    monkeypatch.setenv("OCL_ICD_VENDORS", str(folder))
    return folder


def faults() -> str:
    return "\n".join(icd.faults())


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"\x7fELF\x02\x01\x01\x00\x00", "is binary"),
        (b"a" * 5000, "is binary"),
        (b"libone.so\nlibtwo.so\n", "is binary"),
        (b"", "is empty"),
        (b"\n \n", "is empty"),
    ],
)
def test_broken_files_are_named(content: bytes, fault: str, vendors: Path) -> None:
    (vendors / "broken.icd").write_bytes(content)
    (vendors / "sound.icd").write_bytes("/opt/häuser und mehr/libä.so\n".encode("latin-1"))
    assert faults().startswith(f"{vendors / 'broken.icd'} {fault}: it must be a file of one line")
    ((file, library),) = icd.drivers()
    assert file.name == "sound.icd" and os.fsencode(library) == "/opt/häuser und mehr/libä.so".encode("latin-1")


def test_a_folder_a_fifo_and_a_dangling_link(vendors: Path) -> None:
    (vendors / "a.icd").mkdir()
    os.mkfifo(vendors / "b.icd")
    (vendors / "c.icd").symlink_to("nowhere")
    assert icd.drivers() == []
    for line, fault in zip(
        icd.faults(), ("is a folder", "is not a regular file", "can't be read (No such"), strict=True
    ):
        assert fault in line


def test_one_driver_in_place_of_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = tmp_path / "libone.so"
    library.touch()
    monkeypatch.setenv("OCL_ICD_VENDORS", str(library))
    assert icd.drivers() == [(library, str(library))] and faults() == ""
    (tmp_path / "one.icd").write_text(f"{library}\n")
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "one.icd"))
    assert icd.drivers() == [(tmp_path / "one.icd", str(library))]


@pytest.mark.parametrize(
    ("script", "fault"), [("exit 1", "exit status 1"), ("exit 0", "no version"), (None, "Exec format error")]
)
def test_a_broken_linker_is_named(
    script: str | None, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    linker = tmp_path / "ld"
    linker.write_bytes(b"\0\0" if script is None else f"#!/bin/sh\n{script}\n".encode())
    linker.chmod(0o755)
    assert icd.linker_fault() == ""
    info = opencl.select("pocl")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert f"{linker} does not work ({fault})" in icd.linker_fault()
    with pytest.raises(opencl.DeviceError, match="apt install binutils"):
        opencl.open_session.__wrapped__(info, "tile")


# ---------------------------------------------------------------- Intel's runtime


@pytest.fixture
def intel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment where pip has installed it."""
    prefix = tmp_path / "env"
    monkeypatch.setattr(sys, "prefix", str(prefix))

    def files(name: str) -> list[object]:
        places = (PurePosixPath("../../libintelocl_emu.so"), PurePosixPath("../../libintelocl.so"))
        return [SimpleNamespace(name=p.name, locate=lambda p=p: prefix / "lib" / p.name) for p in places]

    monkeypatch.setattr(metadata, "files", files)
    return prefix


def test_how_to_make_it_visible(intel: Path) -> None:
    (note,) = icd.intel_notes(["Portable Computing Language"])
    folder = intel / "etc" / "OpenCL" / "vendors"
    assert note == (
        "Intel's runtime is installed, but OpenCL's loader does not see it: "
        f"mkdir -p {folder} && echo {intel / 'lib' / 'libintelocl.so'} > {folder / 'intel-cpu.icd'} && "
        f"export OCL_ICD_VENDORS={folder}"
    )
    folder.mkdir(parents=True)
    (note,) = icd.intel_notes([])
    assert "mkdir" not in note
    assert list(icd.intel_notes(["Portable Computing Language", "Intel(R) OpenCL"])) == []


@pytest.mark.parametrize("name", ["a blank", "umgebung_ä"])
def test_a_path_that_it_fails_in(name: str, intel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = SimpleNamespace(name="libintelocl.so", locate=lambda: tmp_path / name / "libintelocl.so")
    monkeypatch.setattr(metadata, "files", lambda _: [path])
    for seen in ([], ["Intel(R) OpenCL"]):
        (note,) = icd.intel_notes(seen)
        assert f"{tmp_path / name}: it fails in a folder whose path has a blank or a letter beyond ASCII" in note


def test_where_pip_has_not_installed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def files(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "files", files)
    assert list(icd.intel_notes([])) == []


def test_no_device_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in icd._HIDING:
        monkeypatch.delenv(name, raising=False)
    assert icd.no_device() == "no OpenCL device, though PoCL is installed: pip install 'pyopencl[pocl]' again"
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    monkeypatch.setenv("POCL_DEVICES", "none")
    assert icd.no_device().endswith("unset POCL_DEVICES, OCL_ICD_VENDORS")
