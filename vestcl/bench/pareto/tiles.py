"""The splatter with tiles of other sides: a process for each side, because the kernels' side is fixed for a process.

`python -m vestcl.bench.pareto.tiles SIDE SCENE.npz [DEVICE]` tells its error on a line, and then for each line that
it reads how many seconds a forward took.
"""

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from vestcl import constants, opencl


@contextmanager
def _splatter(arguments: Sequence[str]) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "vestcl.bench.pareto.tiles", *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            assert process.stdin is not None
            process.stdin.close()


def _told(process: "subprocess.Popen[str]") -> float:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"the splatter of another tile ended with {process.wait()}")
    return float(line)


def measure(sides: Sequence[int], scene: Path, device: str | None, runs: int) -> dict[int, tuple[float, list[float]]]:
    """Error and seconds of a forward, by the tile's side; processes take turns from run to run.

    Args:
        sides: px.
        scene: .npz of `splat`'s arguments points_uv, z, radii, opacities and features, and of the image ``exact``.
        device: of OpenCL.
        runs: of each.

    Returns:
        Side -> root mean square difference from ``exact`` over its root mean square, and seconds.

    Raises:
        RuntimeError: a process ended early; its own words are on the error output.
    """
    with ExitStack() as stack:
        rest = [str(scene), *([] if device is None else [device])]
        processes = {side: stack.enter_context(_splatter([str(side), *rest])) for side in sides}
        found: dict[int, tuple[float, list[float]]] = {side: (_told(p), []) for side, p in processes.items()}
        for _ in range(runs):
            for side, process in processes.items():
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
                found[side][1].append(_told(process))
    return found


def main(arguments: Sequence[str]) -> None:
    """Answer what comes in."""
    side, path, *device = arguments
    setattr(constants, "TILE", int(side))  # noqa: B010 - before the operators are imported, which take it as it is
    from vestcl.ops.splat import splat

    with np.load(path) as file:
        exact, *arrays = (file[name] for name in ("exact", "points_uv", "z", "radii", "opacities", "features"))
    with opencl.use(*device):
        difference = splat(*arrays, *exact.shape[2:])[0] - exact
        print(np.sqrt((difference**2).mean() / (exact**2).mean()), flush=True)
        for _ in sys.stdin:
            start = time.perf_counter()
            splat(*arrays, *exact.shape[2:])
            print(time.perf_counter() - start, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
