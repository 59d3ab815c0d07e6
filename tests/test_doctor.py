"""The doctor on this machine, and on machines with the faults it knows, made of environment variables."""

import importlib.util
import signal
import sys
from pathlib import Path

import pytest

from vestcl import doctor
from vestcl.opencl import pocl_cpu


@pytest.fixture
def only_pip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No driver but the PoCL that pip installed; the empty folder where others would be named."""
    folder = tmp_path / "vendors"
    folder.mkdir()
    monkeypatch.setenv("OCL_ICD_VENDORS", str(folder))
    monkeypatch.delenv("VESTCL_DEVICE", raising=False)
    monkeypatch.delenv("RUSTICL_ENABLE", raising=False)
    return folder


def notes(report: doctor.Report) -> str:
    return "\n".join([*report.notes, *(note for device in report.devices for note in device.notes)])


def test_a_sound_machine(only_pip: Path) -> None:
    report = doctor.examine()
    assert report.works
    (device,) = report.devices
    assert device.works
    assert "PoCL" in device.info.version
    assert device.info.index == report.default
    assert [step.name for step in device.steps if step.passed] == list(doctor.STEPS)
    assert report.notes == ()
    unnamed = pocl_cpu.is_unnamed(device.info.driver, device.info.version)
    assert (f"vestcl has named it {pocl_cpu.host_key()!r}" in notes(report)) == unnamed


def test_without_a_linker(only_pip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    report = doctor.examine()
    assert not report.works
    assert "build: PoCL calls the linker `ld`" in notes(report)
    assert "apt install binutils" in notes(report)


def test_vendors_folder_that_does_not_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "gone"))
    report = doctor.examine()
    assert not report.works
    assert report.devices == ()
    assert f"OCL_ICD_VENDORS names {tmp_path / 'gone'}, which does not exist" in notes(report)


def test_a_cache_that_pocl_can_not_write(only_pip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "file" / "folder"))
    report = doctor.examine()
    assert report.works, "kernels go to a temporary one"
    assert f"PoCL's cache {tmp_path / 'file' / 'folder'} can't be used (Not a directory)" in notes(report)
    assert "let POCL_CACHE_DIR name a folder that can be written" in notes(report)


def test_no_pocl(only_pip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_run_child", lambda *_: doctor._Child((), ""))
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert "no OpenCL device: pip install 'pyopencl[pocl]'" in notes(doctor.examine())


def test_driver_that_can_not_be_loaded(only_pip: Path) -> None:
    (only_pip / "intel.icd").write_text("/nowhere/libintelocl.so\n")
    (only_pip / "torn.icd").write_text("libtorn.so")
    report = doctor.examine()
    assert report.works, "a broken neighbour does not stop the default device"
    assert f"{only_pip / 'intel.icd'} names /nowhere/libintelocl.so, which can't be loaded" in notes(report)
    assert "cannot open shared object file" in notes(report)
    assert "must hold the full path of libintelocl.so" in notes(report)
    assert f"{only_pip / 'torn.icd'} names libtorn.so" in notes(report)


def test_rusticl_that_was_not_enabled(only_pip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (only_pip / "rusticl.icd").write_text("libRusticlOpenCL.so.1\n")
    assert "RUSTICL_ENABLE=llvmpipe" in notes(doctor.examine(timeout=0.01))
    monkeypatch.setenv("RUSTICL_ENABLE", "llvmpipe")
    assert "RUSTICL_ENABLE=llvmpipe" not in notes(doctor.examine(timeout=0.01))


def test_chosen_device_that_does_not_exist(only_pip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VESTCL_DEVICE", "abacus")
    report = doctor.examine()
    assert not report.works
    assert report.devices[0].works
    assert "'abacus' fits none of the OpenCL devices" in notes(report)


def test_a_device_that_hangs(only_pip: Path) -> None:
    report = doctor.examine(timeout=0.01)
    assert not report.works
    assert "listing the devices failed: did not end within 0.01 s" in notes(report)
    assert f"move the .icd files in {only_pip} away one by one" in notes(report)


def test_children_report_how_they_ended() -> None:
    def ending(code: str) -> str:
        return doctor._run_child([sys.executable, "-c", code], timeout=60).ending

    assert ending("print('{\"name\": 1}')") == ""
    assert ending("raise OSError('no luck')") == "OSError: no luck"
    assert ending("raise SystemExit(3)") == "it printed nothing"
    abort = "import os, sys; print('assertion failed', file=sys.stderr, flush=True); os.abort()"
    assert ending(abort) == "was killed by SIGABRT: assertion failed"
    kill = f"import os; os.kill(os.getpid(), {int(signal.SIGSEGV)})"
    assert ending(kill) == "was killed by SIGSEGV: it printed nothing"


def test_a_crash_after_some_steps_is_put_down_to_the_next(only_pip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (info,) = (device.info for device in doctor.examine().devices)
    passed = tuple({"name": name, "passed": True, "detail": ""} for name in ("build", "run"))
    crash = doctor._Child(passed, "was killed by SIGSEGV: it printed nothing")
    monkeypatch.setattr(doctor, "_run_child", lambda *_: crash)
    device = doctor._examine_device(info, timeout=60)
    assert not device.works
    assert [(step.name, step.passed) for step in device.steps] == [("build", True), ("run", True), ("float64", False)]
    assert "float64: was killed by SIGSEGV: it printed nothing" in device.notes
