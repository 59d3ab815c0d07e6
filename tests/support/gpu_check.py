"""Everything that shows within five minutes whether vestcl works on this machine's GPUs: `make gpu-check`.

    python tests/support/gpu_check.py [--allow-none] [--device SELECTOR]

prints each GPU and its driver, the tests of the operators, fuzzed scenes, and each operator's error and time. Exits
with 1 if a step fails or if there is no GPU; --allow-none makes 0 of the latter. --device rehearses it on any device.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from vestcl import opencl

ROOT: Final = Path(__file__).resolve().parents[2]
#: Seconds of a device, all steps together: five minutes, less what Python takes to start.
PATIENCE: Final = 290.0
#: Of the operators in float32 against the reference on the CPU, relative, in the Euclidean norm.
LARGEST_ERROR: Final = 1e-5
TESTS: Final = ("unproject", "rigid_flow", "displace", "stretch", "splat", "splat_pixels", "splat_skipped")
_PRINTED_LINES: Final = 12
_CLI: Final = "import sys; from vestcl.cli.main import main; sys.exit(main())"


@dataclass(frozen=True)
class Step:
    """A child process."""

    name: str
    command: Sequence[str]
    seconds: float
    """That it may take."""
    environment: dict[str, str] = field(default_factory=dict)


def gpus() -> list[opencl.DeviceInfo]:
    """Clover lists GPUs that it can't compile for."""
    return [info for info in opencl.devices() if info.kind == "GPU" and info.platform != "Clover"]


def steps(info: opencl.DeviceInfo, results: Path) -> list[Step]:
    """What is run on a device; the last step writes ``results``."""
    tests = [str(ROOT / "tests" / "ops" / f"test_{name}.py") for name in TESTS]
    fuzz = [sys.executable, str(ROOT / "tests" / "stress" / "fuzz_splat.py"), "--share", "0.02", "--mapping", "pixel"]
    bench = [sys.executable, "-c", _CLI, "bench", "operators", "--seconds", "3", "--device", info.index]
    return [
        Step("tests of the operators", [sys.executable, "-m", "pytest", "-q", *tests], 150),
        Step("fuzzed scenes", fuzz, 60),
        Step("error and ms of the operators", [*bench, "--json", str(results)], 100),
    ]


def run(step: Step, info: opencl.DeviceInfo, seconds: float) -> bool:
    """Whether it ends with 0 within ``seconds``; the end of its output is printed."""
    started = time.monotonic()
    environment = os.environ | {"VESTCL_TEST_DEVICES": info.index, "VESTCL_DEVICE": info.index, "COLUMNS": "100"}
    environment |= {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    try:
        done = subprocess.run(
            step.command, cwd=ROOT, env=environment | step.environment, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, timeout=max(1.0, min(seconds, step.seconds)), check=False,
        )  # fmt: skip
        output, ending = done.stdout, "ok" if done.returncode == 0 else f"FAILED (exit status {done.returncode})"
    except subprocess.TimeoutExpired as late:
        output = late.stdout.decode() if isinstance(late.stdout, bytes) else late.stdout or ""
        ending = "FAILED (it took too long)"
    print(f"-- {step.name}: {ending}, {time.monotonic() - started:.0f} s")
    if ending != "ok" or step.name.startswith("fuzzed"):
        print("\n".join(output.splitlines()[-_PRINTED_LINES:]))
    return ending == "ok"


def operators(results: Path) -> Iterator[tuple[str, float, str]]:
    """Name, error and milliseconds of each operator and pass, from the bench's file."""
    rows = [row for device in json.loads(results.read_text())["devices"] for row in device["measures"]]
    for row in rows:
        if row["column"] == "error":
            times = next(r["text"] for r in rows if r["row"] == row["row"] and r["column"].startswith("ms"))
            yield row["row"], float(row["median"]), times


def check(info: opencl.DeviceInfo) -> bool:
    """All steps on one device; each gets what time is left."""
    print(f"{info.index} {info.name} ({info.platform}), {info.kind}\ndriver: {info.driver}")
    print(f"{info.compute_units} compute units, {info.memory_gib:.1f} GiB, float64: {'yes' if info.float64 else 'no'}")
    end, good = time.monotonic() + PATIENCE, True
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder) / "operators.json"
        for step in steps(info, results):
            good &= run(step, info, end - time.monotonic())
        for name, error, milliseconds in operators(results) if results.is_file() else ():
            fits = math.isfinite(error) and error <= LARGEST_ERROR
            good &= fits
            print(f"   {name:32} error {error:.1e}{'' if fits else ' (TOO LARGE)'}   {milliseconds} ms")
    print(f"{info.index}: {'all passed' if good else 'FAILED'}\n", flush=True)
    return good


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--allow-none", action="store_true", help="exit with 0 where there is no GPU")
    parser.add_argument("--device", help="check this device instead of the GPUs")
    options = parser.parse_args(arguments)
    found = [opencl.select(options.device)] if options.device else gpus()
    if not found:
        print("no GPU found: `vestcl devices` lists the OpenCL devices, `vestcl doctor` what is wrong with drivers")
        return 0 if options.allow_none else 1
    passed = [check(info) for info in found]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
