"""Two hosts on one machine: network namespaces that a pair of virtual cables joins, and torchrun on both.

    python tests/support/two_hosts.py

prepares two streets on both, evaluates a model on both, trains a small network on both, once undisturbed and once with
one host lost and started again, and compares the weights with those of two processes on one host. Making namespaces
takes root; exits with 2 where that is not allowed, with 1 where weights differ by more than 1e-6.
"""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from processes import ROOT, Process, preload, torchrun
from train_scenes import MOMENT, weights, write_yaml

from train.run.report import LOG, read_log

#: Of the first host; the second has .2.
ADDRESS: Final = "10.213.77.1"
#: Seconds until a run is given up.
PATIENCE: Final = 240.0
#: Weights of the same run, relative to the largest of their tensor.
SAME: Final = 1e-6
#: How torchrun finds out soon that a host is lost.
_RENDEZVOUS: Final = "keep_alive_interval=1,keep_alive_max_attempt=3,join_timeout=120"

#: CLONE_NEWNET of <sched.h>.
_NETWORK: Final = 0x40000000


class NotAllowedError(Exception):
    """This machine lets the process make no network namespaces."""


class Hosts:
    """Two of them; the end of the ``with`` block ends all their processes, too."""

    def __init__(self) -> None:
        self.names = [f"vestcl{os.getpid()}{letter}" for letter in "ab"]
        self.interfaces = [f"vc{os.getpid()}{letter}" for letter in "ab"]
        self.addresses = [ADDRESS, ADDRESS[:-1] + "2"]

    def __enter__(self) -> "Hosts":
        try:
            for name in self.names:
                _ip("netns", "add", name)
            _ip("link", "add", self.interfaces[0], "type", "veth", "peer", "name", self.interfaces[1])
            for name, interface, address in zip(self.names, self.interfaces, self.addresses, strict=True):
                _ip("link", "set", interface, "netns", name)
                _ip("-n", name, "address", "add", f"{address}/24", "dev", interface)
                for device in ("lo", interface):
                    _ip("-n", name, "link", "set", device, "up")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for host, name in enumerate(self.names):
            with contextlib.suppress(NotAllowedError):  # it may not be there
                self.kill(host)
                _ip("netns", "delete", name)

    def kill(self, host: int) -> None:
        """Every process of a host at once, as if it had lost power."""
        for process in _ip("netns", "pids", self.names[host]).split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(process), signal.SIGKILL)

    def torchrun(self, host: int, program: Sequence[str], log: Path, moment: str = "") -> Process:
        """Begin torchrun on a host, with one process of ``program``; both print to ``log``."""
        options = [
            "--nnodes", "2", "--nproc-per-node", "1", "--max-restarts", "3", "--rdzv-backend", "c10d",
            "--rdzv-id", "vestcl", "--rdzv-endpoint", f"{ADDRESS}:29400",
            "--rdzv-conf", f"{_RENDEZVOUS},is_host={int(host == 0)}", "--local-addr", self.addresses[host],
        ]  # fmt: skip
        own = {MOMENT: moment, "GLOO_SOCKET_IFNAME": self.interfaces[host]}
        own |= {"TORCH_DISABLE_SHARE_RDZV_TCP_STORE": "1"}  # else a lost host can't be replaced
        return Process(log, _enter, self.names[host], options, list(program), environment=own)

    def run(self, program: Sequence[str], folder: Path, lost_when: Callable[[], bool] | None = None) -> str:
        """``program`` on both; the second host is lost when ``lost_when`` is true, and started again.

        Returns:
            What both printed.

        Raises:
            RuntimeError: a host fails, or takes longer than `PATIENCE`; the message ends with what it printed.
        """
        logs = [folder / f"host{host}.txt" for host in range(2)]
        moments = ["", "SIGSTOP update 5 1" if lost_when else ""]  # the second host has rank 1: addresses are sorted
        running = [self.torchrun(host, program, logs[host], moments[host]) for host in range(2)]
        if lost_when is not None:
            _wait(lost_when, logs)
            self.kill(1)
            running[1].wait()
            running[1] = self.torchrun(1, program, logs[1])
        statuses = [process.wait(PATIENCE) for process in running]
        if any(statuses):
            raise RuntimeError(f"exit status {statuses}:\n{_printed(logs)}")
        return _printed(logs)


def _ip(*arguments: str) -> str:
    try:
        done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise NotAllowedError("there is no `ip` (Debian: apt-get install iproute2)") from None
    if done.returncode:
        raise NotAllowedError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout


def _enter(host: str, options: Sequence[str], program: Sequence[str]) -> None:
    """torchrun in the network namespace ``host``."""
    with Path("/run/netns", host).open("rb") as namespace:
        if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), _NETWORK):
            raise OSError(ctypes.get_errno(), f"setns {host}")
    torchrun(options, program)


def _printed(logs: Sequence[Path]) -> str:
    return "".join(log.read_text() for log in logs)


def _wait(ready: Callable[[], bool], logs: Sequence[Path]) -> None:
    end = time.monotonic() + PATIENCE
    while not ready():
        if time.monotonic() > end:
            raise RuntimeError(f"it hangs:\n{_printed(logs)}")
        time.sleep(0.1)


def training(file: Path) -> list[str]:
    """For torchrun: `train_scenes` with a run's file."""
    return [str(ROOT / "tests" / "support" / "train_scenes.py"), str(file)]


def train_on_both(hosts: Hosts, cache: Path, folder: Path, lost: bool = False) -> str:
    """A run of two processes to ``folder``/out; see `Hosts.run`. The second host is lost after step 5."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "out" / LOG
    program = training(write_yaml(folder / "run.yaml", cache, folder / "out"))
    return hosts.run(program, folder, (lambda: log.is_file() and len(read_log(log)) >= 5) if lost else None)


def train_on_one(cache: Path, folder: Path) -> None:
    """The same run with both processes on this host."""
    folder.mkdir(parents=True, exist_ok=True)
    program = training(write_yaml(folder / "run.yaml", cache, folder / "out"))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *program]
    subprocess.run(command, check=True, capture_output=True)


def prepare_on_both(hosts: Hosts, folder: Path) -> Path:
    """Two streets by `vestcl prepare`, one on each host."""
    folder.mkdir(parents=True, exist_ok=True)
    options = ["--out", str(folder / "cache"), "--height", "48", "--width", "160", "--frames", "5"]
    hosts.run(["-m", "vestcl", "prepare", "street:3-4", *options], folder)
    return folder / "cache"


def evaluate_on_both(hosts: Hosts, folder: Path) -> Path:
    """The packaged model on two streets, one on each host; the folder of the tables."""
    folder.mkdir(parents=True, exist_ok=True)
    model = ROOT / "vestcl" / "weights" / "vest-s.safetensors"
    options = ["--model", str(model), "--seeds", "1100", "1101", "--height", "96", "--width", "320"]
    hosts.run(["-m", "train.evaluate", "street", *options, "--out", str(folder / "out")], folder)
    return folder / "out"


def distance(out: Path, other: Path) -> float:
    """The largest difference of two runs' weights, relative to the largest weight of its tensor."""
    pairs = [(weights(out, name), weights(other, name)) for name in ("model", "ema")]
    return max(
        float((ours[name] - theirs[name]).abs().max() / theirs[name].abs().max().clamp(min=1e-12))
        for ours, theirs in pairs for name in theirs
    )  # fmt: skip


def main() -> int:
    preload()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            with Hosts() as hosts:
                cache = prepare_on_both(hosts, folder / "prepared")
                print("prepared:", ", ".join(sorted(path.name for path in cache.iterdir() if path.is_dir())))
                tables = evaluate_on_both(hosts, folder / "evaluated")
                print("evaluated:", ", ".join(sorted(path.name for path in tables.rglob("*.json"))))
                train_on_both(hosts, cache, folder / "two")
                train_on_both(hosts, cache, folder / "lost", lost=True)
        except NotAllowedError as error:
            print(f"two hosts can't be made here: {error}", file=sys.stderr)
            return 2
        train_on_one(cache, folder / "one")
        found = {kind: distance(folder / kind / "out", folder / "one" / "out") for kind in ("two", "lost")}
    for kind, what in (("two", "two hosts"), ("lost", "two hosts, one lost and started again")):
        print(f"{what}: weights differ from one host's by {found[kind]:.1e}")
    return int(max(found.values()) > SAME)


if __name__ == "__main__":
    sys.exit(main())
