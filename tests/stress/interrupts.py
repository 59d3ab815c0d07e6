"""Interrupt operators at random moments, and compare every later result with that of a process that saw no interrupt.

    python tests/stress/interrupts.py [--share 1.0] [--seed 0]

A timer's signal ends a call at a uniformly random moment of it: as the KeyboardInterrupt of a SIGINT, or as another
exception of the signal's handler; some calls in other threads are ended by PyThreadState_SetAsyncExc. Calls are small
and large, forward and backward, plain and inside jobs, on sessions that share the host's memory and on one that copies;
in half of them a second thread uses the device, too. Exits with 1 if a result is wrong, a lock is kept, earlier results
change, or the process crashes.
"""

import argparse
import ctypes
import hashlib
import json
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # the checkout's vestcl, whichever is installed

import vestcl  # noqa: E402
from vestcl import opencl  # noqa: E402

INTERRUPTS: Final = 2000
#: Calls after the interrupts, which are compared with a fresh process.
CALLS: Final = 100
#: One in this many interrupts is of another thread than the main one.
OTHER_THREAD: Final = 10
#: Seconds after which a call in another thread waits for a lock that nobody will release.
PATIENCE: Final = 60.0
#: Height, width, channels. The results of the large one are recycled memory.
SIZES: Final = {"small": (24, 32, 4), "large": (48, 128, 16)}


class Stopped(BaseException):
    """Something else than KeyboardInterrupt that a signal handler raises."""


@dataclass(frozen=True)
class Case:
    """How the operators are called."""

    size: str
    backward: bool
    nested: bool
    """Inside two jobs."""
    mapping: str


CASES: Final = [
    Case(size, backward, nested, mapping)
    for size in SIZES
    for backward in (False, True)
    for nested in (False, True)
    for mapping in ("tile", "pixel")
]


# ---------------------------------------------------------------- calls


def call(case: Case, seed: int = 0) -> list[torch.Tensor]:
    """Results and gradients of all differentiable operators."""
    height, width, channels = SIZES[case.size]
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand(1, 1, height, width, generator=generator) * 5 + 2
    features = torch.rand(1, height * width, channels, generator=generator)
    motion = [torch.tensor([[1.0, 0.01, 0.02, 0.0]]), torch.tensor([[0.1, 0.0, -0.2]])]
    inputs = [value.requires_grad_(case.backward) for value in (depth, features, *motion)]
    K = torch.tensor([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]])
    with opencl.use(mapping=case.mapping) as session:
        points_xyz = vestcl.unproject(depth, K)
        points_uv, z = vestcl.displace(points_xyz, vestcl.rigid_flow(points_xyz, *motion), K)
        opacities = features[..., 0].sigmoid()
        arguments = points_uv, z.detach(), 3 / z, opacities, features, height, width
        if case.nested:
            with session.job(), session.job():
                outputs = vestcl.splat(*arguments)
        else:
            outputs = vestcl.splat(*arguments)
        grads = torch.autograd.grad([output.square().sum() for output in outputs], inputs) if case.backward else ()
    return [tensor.detach() for tensor in (points_xyz, *outputs, *grads)]


def digest(results: list[torch.Tensor]) -> str:
    return hashlib.sha256(b"".join(result.contiguous().numpy().tobytes() for result in results)).hexdigest()


def last_calls() -> list[str]:
    """What the calls after the interrupts come to."""
    return [digest(call(CASES[number % len(CASES)], seed=number)) for number in range(CALLS)]


def prepare() -> None:
    """The device's sessions; the one of the mapping "pixel" copies, as a GPU's does."""
    torch.set_num_threads(1)
    with opencl.use(mapping="pixel") as session:
        session.shares_host_memory = False


# ---------------------------------------------------------------- interrupts


class Interrupter:
    """Calls that are interrupted, and what was measured of it."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.wanted = {case: digest(call(case)) for case in CASES}
        self.seconds = {case: self._time(case) for case in CASES}
        self.counts: Counter[str] = Counter()
        self._error: BaseException | None = None
        self._results: deque[tuple[str, list[torch.Tensor]]] = deque(maxlen=8)
        signal.signal(signal.SIGALRM, self._interrupt)

    def _time(self, case: Case) -> float:
        start = time.perf_counter()
        call(case)
        return time.perf_counter() - start

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self.counts["signals"] += 1
        if self.random.random() < 0.5:
            signal.raise_signal(signal.SIGINT)
        raise Stopped

    def interrupt(self, case: Case) -> bool:
        """Whether the signal came before the call's end."""
        delay = self.random.uniform(0, 1.1 * self.seconds[case])
        start = time.perf_counter()
        try:
            try:
                signal.setitimer(signal.ITIMER_REAL, max(delay, 1e-6))
                call(case)
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
        except (Stopped, KeyboardInterrupt) as error:
            # A notebook keeps the last error, and with it the frames that it passed.
            self._error = error if self.random.random() < 0.5 else None
            return True
        self.seconds[case] = 0.9 * self.seconds[case] + 0.1 * (time.perf_counter() - start)
        return False

    def interrupt_thread(self, case: Case) -> bool:
        """The same for a call in another thread."""
        stopped = []

        def work() -> None:
            try:
                call(case)
            except Stopped:
                stopped.append(True)

        thread = threading.Thread(target=work)
        thread.start()
        time.sleep(self.random.uniform(0, 1.1 * self.seconds[case]))
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident or 0), ctypes.py_object(Stopped))
        self._wait_for(thread)
        return bool(stopped)

    def check(self, case: Case) -> None:
        """Compare a call with what it came to before, and so an earlier call whose results are still in use."""
        self._results.append((self.wanted[case], call(case)))
        for wanted, results in (self._results[-1], self._results[0]):
            self.counts["wrong"] += digest(results) != wanted

    @contextmanager
    def second_thread(self) -> Iterator[None]:
        """Another thread that uses the device as well, and waits for it."""
        cases = self.random.choices(CASES, k=1)
        thread = threading.Thread(target=lambda: [self.check(case) for case in cases], daemon=True)
        thread.start()
        yield
        self._wait_for(thread)

    def _wait_for(self, thread: threading.Thread) -> None:
        thread.join(PATIENCE)
        if thread.is_alive():
            self.counts["locks kept"] += 1
            raise TimeoutError("a thread waits for a lock that nobody will release")

    def run(self, interrupts: int) -> None:
        while self.counts["interrupts"] < interrupts:
            case = self.random.choice(CASES)
            interrupt = self.interrupt if self.random.randrange(OTHER_THREAD) else self.interrupt_thread
            with self.second_thread() if self.random.random() < 0.5 else nullcontext():
                self.counts["interrupts"] += interrupt(case)
            self.check(self.random.choice(CASES))
            if self.counts["interrupts"] % 10 == 0:
                with self.second_thread():
                    pass


def interrupted_process(interrupts: int, seed: int) -> dict[str, object]:
    """What a child reports: counts, and what the last calls came to."""
    interrupter = Interrupter(seed)
    threading.excepthook = lambda _: None  # of threads that were interrupted after their work
    try:
        interrupter.run(interrupts)
    except TimeoutError:
        return {"counts": interrupter.counts, "calls": []}
    return {"counts": interrupter.counts, "calls": last_calls()}


def start(*arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen([sys.executable, __file__, *arguments], stdout=subprocess.PIPE, text=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help=f"of {INTERRUPTS} interrupts")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", choices=("interrupted", "fresh"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    interrupts = round(INTERRUPTS * options.share)
    if options.child:
        prepare()
        report = interrupted_process(interrupts, options.seed) if options.child == "interrupted" else last_calls()
        print(json.dumps(report))
        return 0
    given = ["--share", str(options.share), "--seed", str(options.seed)]
    with start("--child", "interrupted", *given) as interrupted, start("--child", "fresh") as fresh:
        outputs = [process.communicate()[0] for process in (interrupted, fresh)]
    return verdict(interrupted.returncode, *outputs)


def verdict(status: int, interrupted: str, fresh: str) -> int:
    """Print the counts; 1 if anything failed."""
    if status:
        print(f"interrupts: 1 crash (exit status {status})")
        return 1
    report, wanted = json.loads(interrupted), json.loads(fresh)
    counts = Counter(report["counts"])
    wrong = counts["wrong"] + sum(got != right for got, right in zip(report["calls"], wanted, strict=False))
    kept = counts["locks kept"]
    print(
        f"{counts['interrupts']} interrupts ({counts['signals']} signals), {len(report['calls'])} calls after them: "
        f"{wrong} wrong, {kept} locks kept, 0 crashes"
    )
    return int(wrong or kept or len(report["calls"]) != len(wanted))


if __name__ == "__main__":
    sys.exit(main())
