"""What works on each OpenCL device of this machine, and the remedy for what does not.

A driver may kill the process that loads it, so every one is tried in a child: ``python -m vestcl.doctor list``
enumerates the devices, ``python -m vestcl.doctor INDEX`` takes one device through `STEPS`. Children print one
JSON object a line as they go; the parent reads how far they came.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from vestcl import opencl
from vestcl.opencl import icd, pocl_cache, pocl_cpu

#: What a child tries on its device, in this order; the first failure ends it.
STEPS: Final = ("build", "run", "float64", "splat")


@dataclass(frozen=True)
class DeviceCheck:
    """One step on one device."""

    name: str
    passed: bool
    detail: str = ""


@dataclass(frozen=True)
class DeviceReport:
    """One device: the steps that its child came through, the last one failed unless ``works``."""

    info: opencl.DeviceInfo
    steps: tuple[DeviceCheck, ...]
    notes: tuple[str, ...]

    @property
    def works(self) -> bool:
        """Whether vestcl can use the device. Lacking float64 is not a fault: float32 remains."""
        return len(self.steps) == len(STEPS) and all(s.passed or s.name == "float64" for s in self.steps)


@dataclass(frozen=True)
class Report:
    """Every device, the index of the one that vestcl would use, and what is wrong with the machine itself."""

    devices: tuple[DeviceReport, ...]
    default: str | None
    notes: tuple[str, ...]

    @property
    def works(self) -> bool:
        """Whether the default device works."""
        return any(device.works for device in self.devices if device.info.index == self.default)


def examine(timeout: float = 120.0) -> Report:
    """Try every OpenCL device in a separate child process.

    Args:
        timeout: seconds that each child may take.
    """
    cache = pocl_cache.ensure()  # children inherit a temporary one
    listing = _run_child([sys.executable, "-m", "vestcl.doctor", "list"], timeout)
    notes = [*icd.faults(), *_driver_notes(timeout)]
    if listing.ending:
        notes.append(f"listing the devices failed: {listing.ending}")
        notes.append(f"find the driver at fault: move the .icd files in {icd.vendors()} away one by one")
    infos = [opencl.DeviceInfo(**line["device"]) for line in listing.lines if "device" in line]
    if not infos and not listing.ending:
        notes.append(icd.no_device())
    elif cache.note or cache.fault:
        notes.append(cache.note or cache.fault)
    notes += [line["error"] for line in listing.lines if infos and "error" in line]
    notes += icd.intel_notes([info.platform for info in infos])
    if os.environ.get("RUSTICL_ENABLE") is None and any("rusticl" in library.lower() for _, library in icd.drivers()):
        notes.append("rusticl shows no device until one is chosen: RUSTICL_ENABLE=llvmpipe, radeonsi, iris, ...")
    default = next((line["default"] for line in listing.lines if "default" in line), None)
    return Report(tuple(_examine_device(info, timeout) for info in infos), default, tuple(notes))


# ---------------------------------------------------------------- the parent


@dataclass(frozen=True)
class _Child:
    """What a child printed, and how it ended if not well."""

    lines: tuple[dict[str, Any], ...]
    ending: str


def _run_child(command: Sequence[str], timeout: float) -> _Child:
    try:
        done = subprocess.run(command, capture_output=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired as late:
        output, ending = late.stdout or b"", f"did not end within {timeout:g} s"
    else:
        output, ending = done.stdout, _ending(done.returncode, done.stderr.decode(errors="replace"))
    lines = [json.loads(line) for line in output.decode(errors="replace").splitlines() if line.startswith("{")]
    return _Child(tuple(lines), ending)


def _ending(code: int, errors: str) -> str:
    said = [line.strip() for line in errors.splitlines() if line.strip()] or ["it printed nothing"]
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}: {' / '.join(said[-3:])}"
    return said[-1] if code else ""


def _examine_device(info: opencl.DeviceInfo, timeout: float) -> DeviceReport:
    child = _run_child([sys.executable, "-m", "vestcl.doctor", info.index], timeout)
    steps = [DeviceCheck(**line) for line in child.lines]
    if child.ending:
        steps.append(DeviceCheck(STEPS[min(len(steps), len(STEPS) - 1)], False, child.ending))
    notes = [f"{step.name}: {step.detail}" for step in steps if step.detail]
    if child.ending:
        notes.append("choose another device with VESTCL_DEVICE; a newer driver may mend this one")
    if pocl_cpu.is_unnamed(info.driver, info.version):
        name = pocl_cpu.host_key()
        notes.append(
            f"this PoCL does not know this CPU; vestcl has named it {name!r}, so that it can build"
            if name
            else "this PoCL does not know this CPU and cannot build: install PoCL 3.1 or later"
        )
    return DeviceReport(info, tuple(steps), tuple(notes))


def _driver_notes(timeout: float) -> Iterator[str]:
    """The drivers that can't be loaded, each tried in a separate process."""
    for file, library in icd.drivers():
        child = _run_child([sys.executable, "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])", library], timeout)
        if child.ending:
            yield f"{file} names {library}, which can't be loaded: {child.ending}"
            if "intelocl" in library:
                yield f"{file} must hold the full path of libintelocl.so; `pip show -f intel-opencl-rt` shows it"


# ---------------------------------------------------------------- the children


def _list_devices() -> None:
    for info in opencl.devices():
        _say(device=dataclasses.asdict(info))
    try:
        _say(default=opencl.select().index)
    except opencl.DeviceError as error:
        _say(error=str(error))


def _try_device(index: str) -> None:
    attempts: dict[str, Callable[[], str]] = {
        "build": lambda: _build(index),
        "run": lambda: _run(np.float32),
        "float64": lambda: _run(np.float64),
        "splat": _splat,
    }
    assert tuple(attempts) == STEPS
    for name, attempt in attempts.items():
        try:
            fault = attempt()
        except (opencl.DeviceError, ImportError) as error:
            fault = str(error)
        _say(name=name, passed=not fault, detail=fault)
        if fault and name != "float64":
            break


def _build(index: str) -> str:
    opencl.use(index)
    opencl.current().kernel("unproject.cl", "unproject", opencl.defines_for(np.dtype(np.float32)))
    return ""


def _run(dtype: type[np.floating[Any]]) -> str:
    """Two pixels side by side, 2 m away, seen by a camera with K = 1."""
    from vestcl.ops.unproject import unproject  # torch is slow to import

    points_xyz = unproject(np.full((1, 1, 1, 2), 2, dtype), np.eye(3, dtype=dtype)[None])
    return _compare(np.asarray(points_xyz), [[[1, 1, 2], [3, 1, 2]]])


def _splat() -> str:
    """One opaque point of radius 1.5 px in the middle of 3 x 3 pixels (SPEC section 2)."""
    from vestcl.ops.splat import splat

    one = np.ones((1, 1), np.float32)
    points_uv = np.full((1, 1, 2), 1.5, np.float32)
    image, _ = splat(points_uv, one, 1.5 * one, one, one[..., None], 3, 3)
    edge, corner = 5 / 9, 1 / 9
    return _compare(np.asarray(image), [[[[corner, edge, corner], [edge, 1, edge], [corner, edge, corner]]]])


def _compare(got: np.ndarray, wanted: list[Any]) -> str:
    error = float(np.abs(got - np.array(wanted)).max())
    return "" if error < 1e-6 else f"wrong result: off by {error:.2g}"


def _say(**line: object) -> None:
    print(json.dumps(line), flush=True)


if __name__ == "__main__":
    if sys.argv[1] == "list":
        _list_devices()
    else:
        _try_device(sys.argv[1])
