"""An exception between any two bytecodes leaves no lock held, no wrong result and no memory freed that kernels use."""

import contextlib
import contextvars
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from test_robust_lock import abandon

import vestcl
from vestcl import opencl
from vestcl.ops import unproject

#: Whose bytecodes count.
PACKAGES = tuple(str(Path(sys.modules[name].__file__ or "").parent) for name in ("vestcl", "pyopencl"))


class Stopped(BaseException):
    """What interrupts."""


class Bytecodes:
    """Counts the bytecodes of `PACKAGES` that run, and raises before the one that is asked for."""

    def __init__(self, stop: int = 0) -> None:
        self.stop, self.count = stop, 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> Any:
        if event == "call":
            frame.f_trace_opcodes, frame.f_trace_lines = True, False
            return self if frame.f_code.co_filename.startswith(PACKAGES) else None
        if event == "opcode":
            self.count += 1
            if self.count == self.stop:
                raise Stopped
        return self


@contextmanager
def traced(bytecodes: Bytecodes) -> Iterator[None]:
    before = sys.gettrace()
    sys._getframe().f_trace_opcodes = True  # Python 3.12 has to know before it traces
    sys.settrace(bytecodes)
    try:
        yield
    finally:
        sys.settrace(before)


def assert_survives(work: Callable[[], Any], check: Callable[[], None], step: int) -> None:
    """Interrupt ``work`` before every ``step``-th bytecode, and after each interrupt ``check`` in two threads."""
    work()
    check()
    whole = Bytecodes()
    with traced(whole):
        work()
    interrupted = 0
    for stop in range(1, whole.count + 1, step):
        kept = None
        try:
            with traced(Bytecodes(stop)):
                work()
        except Stopped as error:
            kept = error  # as a notebook keeps it, and with it the frames that it passed
            interrupted += 1
        failed: list[BaseException] = []
        thread = threading.Thread(target=_note, args=(check, failed), daemon=True)
        thread.start()
        thread.join(60)
        assert not thread.is_alive(), f"a lock is kept after an interrupt before bytecode {stop}"
        assert not failed, f"wrong in another thread after an interrupt before bytecode {stop}: {failed}"
        check()
        del kept
    assert interrupted > 0.95 * whole.count / step


def _note(check: Callable[[], None], failed: list[BaseException]) -> None:
    try:
        check()
    except BaseException as error:
        failed.append(error)


def splatting(count: int, channels: int, size: int) -> Callable[[], list[torch.Tensor]]:
    """A call of splat on fixed points that gives image, coverage and gradients."""
    generator = torch.Generator().manual_seed(count)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(1, count, *shape, generator=generator)

    points_uv, z, radii, opacities, features = rand(2) * size, rand() + 1, rand() * 3 + 0.5, rand(), rand(channels)

    def call() -> list[torch.Tensor]:
        inputs = [value.clone().requires_grad_() for value in (points_uv, radii, opacities, features)]
        outputs = vestcl.splat(inputs[0], z, *inputs[1:], size, size)
        grads = torch.autograd.grad([output.square().sum() for output in outputs], inputs)
        return [*(output.detach() for output in outputs), *grads]

    return call


def right(call: Callable[[], list[torch.Tensor]]) -> Callable[[], None]:
    wanted = call()

    def check() -> None:
        assert all(torch.equal(got, right) for got, right in zip(call(), wanted, strict=True))

    return check


def test_a_small_operator_stopped_at_every_bytecode(session: opencl.Session) -> None:
    depth, K = torch.rand(1, 1, 8, 8) + 1, torch.eye(3)[None]

    def nested() -> list[torch.Tensor]:
        with session.job():
            results = [vestcl.unproject(depth, K)]
            vestcl.unproject(depth + 1, K)
        return results

    assert_survives(nested, right(nested), 2)


def test_splatting_stopped_at_many_bytecodes() -> None:
    """Forward and backward; the interrupted scene's results are large enough to be recycled, and take long."""
    assert_survives(splatting(6000, 16, 80), right(splatting(300, 4, 32)), 101)


def test_profiles_and_observers_stopped_at_every_bytecode(session: opencl.Session) -> None:
    depth, K = torch.rand(1, 1, 8, 8) + 1, torch.eye(3)[None]

    def observed() -> tuple[int, int]:
        seen: list[opencl.JobTimes] = []
        with observing, opencl.observe(seen.append), session.profile() as times:
            vestcl.unproject(depth, K)
        return len(seen), len(times)

    def check() -> None:
        assert observed() == (1, 1)

    observing = threading.Lock()  # of both threads, for there is one observer
    assert_survives(observed, check, 5)


def test_building_a_kernel_stopped_at_many_bytecodes() -> None:
    depth, inverse_K = np.ones((1, 1, 2, 2), np.float32), np.eye(3, dtype=np.float32)[None]
    given = opencl.current()

    def work() -> None:
        session = opencl.Session(given.info, given.mapping, given._device)
        for _ in range(2):
            with contextlib.suppress(Stopped):  # once of the two times
                assert unproject._forward(session, depth, inverse_K)[0, -1].tolist() == [1.5, 1.5, 1]
        assert unproject._forward(session, depth, inverse_K)[0, -1].tolist() == [1.5, 1.5, 1]
        assert len(session._kernels) == 1

    whole = Bytecodes()
    with traced(whole):
        work()
    for stop in range(1, whole.count // 3, 97):
        with traced(Bytecodes(stop)), contextlib.suppress(Stopped):
            work()


def test_arrays_outlive_the_kernels_of_an_interrupted_job() -> None:
    """The end of the job is lost, and with it all that held the arrays; the next job waits before it lets them go."""
    session = opencl.current()
    array, result = np.ones((1, 1, 64, 64), np.float32), np.empty((1, 4096, 3), np.float32)
    job = abandon(session.job())
    sizes = dict.fromkeys(("height", "width", "chunk"), np.int32(64))
    inputs = {"depth": job.read(array), "inverse_K": job.read(np.eye(3, dtype=np.float32))}
    arguments: opencl.Arguments = {**sizes, **inputs, "points_xyz": job.write(result)}
    job.launch("unproject.cl", "unproject", opencl.defines_for(array.dtype), (1, 64, 1), arguments)
    held = [id(bound) for _, bound in session._bound]
    assert id(array) in held and id(result) in held
    with session.job():
        assert not session._bound, "and has nothing to do with the interrupted one's"
    assert result[0, -1].tolist() == [63.5, 63.5, 1]


def test_use_ends_with_its_block_though_interrupted() -> None:
    before = opencl.current()
    assert abandon(vestcl.use(mapping="pixel")).mapping == "pixel"
    assert opencl.current() is before
    with vestcl.use(mapping="pixel") as chosen:
        assert opencl.current() is chosen
    assert opencl.current() is before


def test_use_without_a_block_continues() -> None:
    """Whatever looks at it, and however often it is called; and blocks go back to it."""

    def choose() -> None:
        for _ in range(3):
            kept = vestcl.use(mapping="pixel")
        assert opencl.current().mapping == "pixel"
        assert kept.__exit__ is not None and opencl.current().mapping == "pixel"
        for _ in range(2):
            with vestcl.use(mapping="tile"), contextlib.ExitStack() as stack:
                stack.enter_context(vestcl.use(mapping="pixel"))
                abandon(vestcl.use(mapping="tile"))
                assert opencl.current().mapping == "pixel"
                stack.close()
                assert opencl.current().mapping == "tile"
            assert opencl.current() is kept.session
        assert kept._before is None, "a chain of all calls would be a leak"

    contextvars.copy_context().run(choose)


def test_an_interrupted_observer_hears_no_more() -> None:
    lost: list[opencl.JobTimes] = []
    heard: list[opencl.JobTimes] = []
    abandon(opencl.observe(lost.append))
    with opencl.observe(heard.append):
        vestcl.unproject(np.ones((1, 1, 2, 2)), np.eye(3)[None])
    assert len(heard) == 1 and not lost


def test_stress() -> None:
    """A twentieth of the interrupts of `make stress`, in a separate process, which may crash."""
    script = Path(__file__).parents[1] / "stress" / "interrupts.py"
    done = subprocess.run([sys.executable, script, "--share", "0.05"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("100 interrupts") and "0 wrong, 0 locks kept, 0 crashes" in done.stdout
