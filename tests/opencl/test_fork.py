"""OpenCL does not survive a fork: a child that would wait for threads that it does not have gets an error at once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from vestcl import opencl

#: What forks, and says how each child ended: "passed", the error that it got, or "hangs".
COMMON = """
import os, signal, sys
import vestcl
from vestcl import opencl

def in_child(name, work):
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends a child that hangs
        try:
            work()
            outcome = "passed"
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        os.write(writing, outcome.encode())
        if name != "exit":
            os._exit(7)
        sys.exit(7)  # through all destructors, which takes half a second where torch is loaded
    os.close(writing)
    outcome = os.read(reading, 4096).decode()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(name, "|", outcome or "hangs", "|", status, flush=True)
"""

DEVICES_ONLY = """
in_child("before", vestcl.devices)
vestcl.devices()
in_child("devices", vestcl.devices)
in_child("select", lambda: opencl.select("pocl"))
in_child("use", lambda: vestcl.use("pocl"))
in_child("current", opencl.current)
in_child("exit", lambda: None)
in_child("free", vestcl.free_memory)
in_child("grandchild", lambda: in_child("child's child", vestcl.devices))
"""

USED = """
import multiprocessing, numpy as np, torch
from vestcl.data import Street, intrinsics

depth, K = torch.rand(1, 1, 4, 4) + 1, torch.eye(3)[None]
def unproject():
    return vestcl.unproject(depth, K)
def street():
    scene = Street.generate(1)
    scene.render(np.linalg.inv(scene.camera_pose(2.0)), intrinsics(20, 37), 20, 37, 2.0)

wanted = unproject()
session = opencl.current()
points = [torch.rand(1, 9, 2) * 16, torch.rand(1, 9) + 1, torch.rand(1, 9) + 1, torch.rand(1, 9)]
raster = vestcl.rasterize(*points, 16, 16)
required = depth.clone().requires_grad_()
loss = vestcl.unproject(required, K).sum()

in_child("operator", unproject)
in_child("composite", lambda: vestcl.composite(raster, torch.rand(1, 9, 3)))
in_child("backward", loss.backward)
in_child("street", street)
in_child("profile", lambda: session.profile().__enter__())
in_child("build", lambda: session.kernel("displace.cl", "displace", {}))
in_child("scratch", session.free_scratch)
in_child("clock", session.clock_bounds)
in_child("exit", lambda: None)
with session.job() as job:
    in_child("inside a job", job.sync)
    job.read(np.ones(1))
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        sys.exit(7)
    print("exit inside a job | passed |", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
with vestcl.use(mapping="pixel"):
    in_child("chosen", unproject)

class Points(torch.utils.data.Dataset):
    def __len__(self):
        return 2
    def __getitem__(self, index):
        return unproject()

try:
    list(torch.utils.data.DataLoader(Points(), num_workers=1, multiprocessing_context="fork", timeout=60))
except Exception as error:
    print("loader |", "DeviceError" in type(error).__name__, "spawn" in str(error), "| 7")
assert torch.equal(unproject(), wanted), "the parent continues"
"""

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")


def ends(code: str) -> dict[str, tuple[str, str]]:
    """Name -> what the child said, and its exit status."""
    environment = os.environ | {"PYTHONPATH": str(Path(opencl.__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMMON + code],
        capture_output=True, text=True, env=environment, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "leaked" not in done.stderr and "rror" not in done.stderr, done.stderr
    lines = [line.split(" | ") for line in done.stdout.splitlines()]
    return {name: (reported, status) for name, reported, status in lines}


def assert_refused(reported: tuple[str, str]) -> None:
    error, status = reported
    assert status == "7", error
    assert error.startswith("DeviceError: OpenCL was used before this process was forked")
    assert "'spawn'" in error and "'forkserver'" in error and "multiprocessing_context" in error


def test_having_listed_the_devices_is_enough() -> None:
    reported = ends(DEVICES_ONLY)
    for name in ("devices", "select", "use", "current", "child's child"):
        assert_refused(reported[name])
    for name in ("before", "exit", "free", "grandchild"):
        assert reported[name] == ("passed", "7"), name


def test_whatever_was_in_use_is_refused_and_the_parent_continues() -> None:
    reported = ends(USED)
    assert reported.pop("exit") == reported.pop("exit inside a job") == ("passed", "7")
    assert reported.pop("loader") == ("True True", "7")
    assert len(reported) == 10
    for end in reported.values():
        assert_refused(end)
