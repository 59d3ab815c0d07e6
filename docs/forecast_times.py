"""CPU time and memory of `vestcl forecast`, the whole command with its files: the table of docs/performance.md.

    python docs/forecast_times.py CLIP ... --out times.json --work-width 0 960
    python docs/tables.py --keep times.json forecast_times

Each command runs in a process of its own, --runs times in turns; the least CPU time counts, for other work on the
machine only adds to it.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vestcl.bench.common.results import describe, write_json

STEPS = 5


def main() -> int:
    """Measure and write; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", help="of `vestcl forecast`")
    parser.add_argument("--out", type=Path, required=True, help="JSON file for the results")
    parser.add_argument("--work-width", type=int, nargs="+", default=[960], help="px, one or more; 0 is the clip's own")
    parser.add_argument("--frame", type=int, default=10, help="the current frame")
    parser.add_argument("--fov", type=float, default=60, help="degrees, of videos")
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    for _ in range(options.runs):
        for name in options.inputs:
            for width in options.work_width:
                measured = _measure(_arguments(name, width, options.frame, options.fov))
                best = rows.setdefault((name, width), {"input": name, "work_width": width, **measured})
                best |= {key: min(best[key], value) for key, value in measured.items()}
                print(f"{name} {width}: {measured['cpu_s']:.1f} s of CPU, {measured['memory_gb']:.2f} GB", flush=True)
    write_json(options.out, {"machine": describe(), "config": {"steps": STEPS}, "rows": list(rows.values())})
    return 0


def _arguments(name: str, width: int, frame: int, fov: float) -> list[str]:
    video = Path(name).suffix in (".mp4", ".mov", ".mkv", ".avi")
    return [name, *(("--fov", f"{fov:g}") if video else ()), "--frame", str(frame), "--work-width", str(width)]


def _measure(arguments: Sequence[str]) -> dict[str, float]:
    """CPU and wall seconds and GB of memory at most, of one command."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "vestcl", "forecast", *arguments, "--steps", str(STEPS), "--out", folder]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
            assert process.stderr is not None
            errors = process.stderr.read()
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise RuntimeError(f"{' '.join(command)}: {errors.decode(errors='replace').strip()}")
    return {"cpu_s": usage.ru_utime + usage.ru_stime, "memory_gb": usage.ru_maxrss * 1024 / 1e9}


if __name__ == "__main__":
    sys.exit(main())
