"""Every kernel on small scenes under Oclgrind, which reports data races and accesses beyond a buffer or an array.

    python tests/support/oclgrind_scenes.py

exits with 1 if Oclgrind reports anything, and prints each finding once, with the number of times that it occurred.

Not asked for is --uninitialized: Oclgrind 21.10 crashes in it on vectors joined of two (shuffles with undefined
lanes), knows no `freeze` instruction, and reports memory that a kernel has just written. What memory held before
a kernel runs is varied in test_splat_determinism.py instead.
"""

import collections
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from vestcl import opencl
from vestcl.data import Street, intrinsics
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import composite, rasterize
from vestcl.ops.stretch import stretch
from vestcl.ops.unproject import unproject

HEIGHT, WIDTH = 20, 37
CHECKS = ("--data-races", "--max-errors", "100000")
#: What a child runs, and how. Oclgrind doesn't know what LLVM makes of `restrict` when it inlines the ray caster.
OPTIONS = {"splat": CHECKS, "street": (*CHECKS, "--build-options", "-cl-opt-disable")}


def exact_scratch(job: opencl.Job, count: int, dtype: Any) -> opencl.Buffer:
    """Memory of the very size asked for: the pool's is larger, and an access beyond it would not show."""
    return job.write(np.empty(max(1, count) * np.dtype(dtype).itemsize, np.uint8))


def backward(*outputs: torch.Tensor) -> None:
    """Gradients of all inputs; the incoming ones lie in planes."""
    torch.autograd.backward(outputs, [torch.randn(output.shape, dtype=output.dtype) for output in outputs])


def recorded(*shape: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.rand(*shape, dtype=dtype).requires_grad_()


def small_operators(dtype: torch.dtype) -> None:
    K = torch.tensor([[30.0, 0, 18], [0, 30, 10], [0, 0, 1]], dtype=dtype).repeat(2, 1, 1)
    points_xyz = unproject(recorded(2, 1, HEIGHT, WIDTH, dtype=dtype), K)
    flow = rigid_flow(points_xyz, recorded(2, 4, dtype=dtype), recorded(2, 3, dtype=dtype))
    for camera in (None, torch.eye(4, dtype=dtype).repeat(2, 1, 1)):
        points_uv, z = displace(points_xyz, flow, K, camera)
    backward(points_uv, z)
    stretch(points_uv.detach().view(2, HEIGHT, WIDTH, 2), torch.rand(2, HEIGHT, WIDTH, dtype=dtype))


def geometry(count: int, dtype: torch.dtype, radius: float) -> dict[str, Any]:
    """Two clouds on and around 3 x 2 tiles, some points in all of them."""
    size = torch.tensor([WIDTH + 8, HEIGHT + 8])
    return {
        "points_uv": (torch.rand(2, count, 2, dtype=dtype) * size - 4).to(dtype).requires_grad_(),
        "z": torch.randint(-1, 9, (2, count)).to(dtype),
        "radii": (torch.rand(2, count, dtype=dtype) ** 4 * radius + 0.4).requires_grad_(),
        "opacities": recorded(2, count, dtype=dtype),
        "height": HEIGHT,
        "width": WIDTH,
    }


def splatting(dtype: torch.dtype) -> None:
    """Vectors of every kind, incoming gradients of every layout, truncation, no points, and lists of segments."""
    raster = rasterize(**geometry(40, dtype, radius=25))
    for channels in (1, 3, 5, 16):
        features = recorded(2, 40, channels, dtype=dtype)
        backward(*composite(raster, features, recorded(2, channels, dtype=dtype)))
    features = torch.where(torch.rand(2, 40, 5) < 0.05, torch.nan, torch.rand(2, 40, 5)).to(dtype).requires_grad_()
    image, _ = composite(raster, features, min_transmittance=0.3)
    image.backward(torch.randn(image.shape, dtype=dtype).contiguous(memory_format=torch.channels_last))
    _, coverage = composite(raster, features)
    coverage.sum().backward()
    empty = rasterize(**geometry(0, dtype, radius=1))
    backward(*composite(empty, recorded(2, 0, 3, dtype=dtype), recorded(2, 3, dtype=dtype)))
    crowded = rasterize(**geometry(80, dtype, radius=80))
    backward(*composite(crowded, recorded(2, 80, 3, dtype=dtype)))
    composite(rasterize(**geometry(300, dtype, radius=80)), torch.rand(2, 300, 1, dtype=dtype))  # more than a group


def splat_and_small_operators() -> None:
    setattr(opencl.Job, "scratch", exact_scratch)  # noqa: B010 - a method may not be assigned to
    for mapping in ("tile", "pixel"):
        with opencl.use("oclgrind", mapping):
            for dtype in (torch.float32, torch.float64):
                small_operators(dtype)
                splatting(dtype)


def street() -> None:
    with opencl.use("oclgrind"):
        scene = Street.generate(1)
        scene.render(np.linalg.inv(scene.camera_pose(2.0)), intrinsics(HEIGHT, WIDTH), HEIGHT, WIDTH, 2.0)


def findings(messages: str) -> collections.Counter[str]:
    """Each report as "what, kernel, lines", without addresses and indices, and how often it was made."""
    reports = [report for report in re.split(r"\n(?=\S)", messages) if "\n\tKernel: " in report]
    short = ["\n  ".join(re.findall(r"^\S.*|Kernel: .*|At line .*", report, re.MULTILINE)) for report in reports]
    return collections.Counter(re.sub(r"0x[0-9a-f]+|\(-?\d+\)", "...", report) for report in short)


def main(arguments: Sequence[str]) -> int:
    if arguments:
        torch.manual_seed(0)
        {"splat": splat_and_small_operators, "street": street}[arguments[0]]()
        return 0
    oclgrind = shutil.which("oclgrind")
    if oclgrind is None:
        print("oclgrind is not installed: apt install oclgrind", file=sys.stderr)
        return 2
    failed = False
    for scenes, options in OPTIONS.items():
        command = [oclgrind, *options, sys.executable, __file__, scenes]
        # pyopencl's cache would hand over programs without their source. Reports go to stderr, for a log would be
        # begun again by every OpenCL context.
        environment = os.environ | {"PYOPENCL_NO_CACHE": "1"}
        child = subprocess.run(command, env=environment, stderr=subprocess.PIPE, text=True, check=False)
        found = findings(child.stderr)
        for report, count in found.items():
            print(f"{count} x {report}", file=sys.stderr)
        if child.returncode:
            print(child.stderr[-4000:], file=sys.stderr)
        print(f"{scenes}: {len(found)} findings, exit status {child.returncode}")
        failed |= bool(found or child.returncode)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
