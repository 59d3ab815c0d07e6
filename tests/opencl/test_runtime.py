"""Devices, programs, launches and profiles, with kernels that a test writes into a separate folder."""

import contextvars
import dataclasses
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vestcl import opencl
from vestcl.opencl import device_list, programs
from vestcl.opencl import session as session_module

SCALE = """
kernel void scale(const REAL factor, global const REAL* in, global REAL* out)
{
  const int i = get_global_id(0);
  out[i] = factor * in[i];
}
kernel void add_one(global const REAL* in, global REAL* out)
{
  out[get_global_id(0)] = in[get_global_id(0)] + 1;
}
"""


@pytest.fixture(autouse=True)
def _no_chosen_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VESTCL_DEVICE", raising=False)


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A kernel folder with scale.cl, in place of vestcl's."""
    (tmp_path / "scale.cl").write_text(SCALE)
    monkeypatch.setattr(programs, "kernel_folder", lambda: tmp_path)
    uncached = programs.source.__wrapped__  # its cache knows file names only
    for module in (programs, session_module):
        monkeypatch.setattr(module, "source", uncached)
    return tmp_path


@pytest.fixture
def fresh(session: opencl.Session) -> opencl.Session:
    """A session of this test's own, in which nothing is built yet."""
    return opencl.Session(session.info, session.mapping, session._device)


def scale(session: opencl.Session, factor: float, array: np.ndarray) -> np.ndarray:
    result = np.empty_like(array)
    with session.job() as job:
        arguments = {"factor": array.dtype.type(factor), "in": job.read(array), "out": job.write(result)}
        job.launch("scale.cl", "scale", opencl.defines_for(array.dtype), array.shape, arguments)
    return result


# ---------------------------------------------------------------- devices


def test_default_is_a_cpu_of_pocl() -> None:
    info = opencl.select()
    assert info.kind == "CPU"
    assert "PoCL" in info.version


def test_select_by_index_and_by_any_part_of_a_name() -> None:
    for info in opencl.devices():
        assert opencl.select(info.index) == info
        assert info.platform == opencl.select(info.platform.upper()).platform
        assert info.name == opencl.select(info.name[2:].lower()).name
    assert "PoCL 3.0" in opencl.select("pocl 3.0").driver  # pip's, next to whichever the system has


def test_select_by_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    last = opencl.devices()[-1]
    monkeypatch.setenv("VESTCL_DEVICE", last.index)
    assert opencl.select() == last
    assert opencl.current().info == last
    assert opencl.select(opencl.devices()[0].index) == opencl.devices()[0]  # an argument outweighs it


@pytest.mark.parametrize("selector", ["no such device", "99:0"])
def test_unknown_device_lists_those_that_there_are(selector: str) -> None:
    with pytest.raises(opencl.DeviceError, match=selector) as caught:
        opencl.select(selector)
    for info in opencl.devices():
        assert f"{info.index} {info.platform} / {info.name}" in str(caught.value)


def test_no_device_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_list, "devices", list)
    with pytest.raises(opencl.DeviceError, match=r"pip install 'pyopencl\[pocl\]'"):
        opencl.select()


def test_use_holds_inside_a_with_block() -> None:
    before = opencl.current()
    last = opencl.devices()[-1].index
    with opencl.use(last, mapping="pixel") as outer:
        assert outer is opencl.current()
        assert (outer.info.index, outer.mapping) == (last, "pixel")
        with opencl.use(mapping="tile") as inner:
            assert inner is opencl.current() is not outer
        assert opencl.current() is outer
    assert opencl.current() is before


def test_use_sets_from_here_on() -> None:
    def choose() -> str:
        opencl.use(mapping="pixel")
        return opencl.current().mapping

    assert contextvars.copy_context().run(choose) == "pixel"
    assert opencl.current().mapping == "tile"


def test_use_checks_the_mapping() -> None:
    with pytest.raises(ValueError, match="`mapping` must be 'tile', 'pixel' or None, got 'row'"):
        opencl.use(mapping="row")


def test_pocl_without_a_linker_names_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    info = opencl.select("pocl")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(opencl.DeviceError, match="apt install binutils"):
        opencl.open_session.__wrapped__(info, "tile")


# ---------------------------------------------------------------- programs


def test_a_program_is_built_once(kernels: Path, fresh: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    builds: list[Any] = []
    build = fresh._build

    def counted(*arguments: Any) -> Any:
        builds.append(arguments)
        return build(*arguments)

    monkeypatch.setattr(fresh, "_build", counted)
    defines = opencl.defines_for(np.dtype(np.float32))
    first = fresh.kernel("scale.cl", "scale", defines)
    assert fresh.kernel("scale.cl", "scale", dict(reversed(defines.items()))) is first
    assert fresh.kernel("scale.cl", "add_one", defines) is not first
    assert len(builds) == 1
    assert fresh.kernel("scale.cl", "scale", {**defines, "TILE": 8}) is not first
    assert len(builds) == 2


@pytest.mark.parametrize("broken", ["broken.cl", "part.h"])
def test_a_build_error_points_to_file_and_line(kernels: Path, fresh: opencl.Session, broken: str) -> None:
    lines = {"part.h": "#define PART 1\n", "broken.cl": '\n#include "part.h"\n\nkernel void nothing() {}\n'}
    lines[broken] += "nonsense;\n"
    for name, text in lines.items():
        (kernels / name).write_text(text)
    line = lines[broken].count("\n")
    with pytest.raises(opencl.DeviceError, match=rf"(?s)broken.cl does not build on .*REAL=float.*{broken}:{line}:"):
        fresh.kernel("broken.cl", "nothing", {"REAL": "float"})


def test_float64_on_a_device_without_it(kernels: Path, fresh: opencl.Session) -> None:
    fresh.info = dataclasses.replace(fresh.info, float64=False)
    assert scale(fresh, 2, np.ones(3, np.float32)).tolist() == [2, 2, 2]
    with pytest.raises(opencl.DeviceError, match="has no float64: pass float32"):
        scale(fresh, 2, np.ones(3))


def test_missing_kernels_name_the_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(programs, "__file__", str(tmp_path / "vestcl" / "opencl" / "programs.py"))
    with pytest.raises(opencl.DeviceError, match="install the package again"):
        opencl.kernel_folder.__wrapped__()


def test_every_kernel_file_is_found_and_inlined() -> None:
    files = [*opencl.kernel_folder().rglob("*.cl")]
    assert {"splat_composite.cl", "unproject.cl"} <= {file.name for file in files}
    for file in files:
        assert '#include "' not in opencl.source(file.relative_to(opencl.kernel_folder()).as_posix())


# ---------------------------------------------------------------- jobs


def test_results_arrive(kernels: Path, fresh: opencl.Session) -> None:
    array = np.arange(1000, dtype=np.float32)
    np.testing.assert_array_equal(scale(fresh, 0.5, array), array / 2)
    fresh.writes_host_memory = False  # as for a CPU device whose driver may keep a copy
    np.testing.assert_array_equal(scale(fresh, 0.125, array), array / 8)
    fresh.shares_host_memory = False  # copies, as for a GPU
    np.testing.assert_array_equal(scale(fresh, 0.25, array), array / 4)


def test_pocl_shows_outputs_without_maps(session: opencl.Session) -> None:
    if session.info.platform != "Portable Computing Language" or session.info.kind != "CPU":
        pytest.skip("not PoCL on a CPU")
    assert session.writes_host_memory


def test_scalars_change_from_launch_to_launch(kernels: Path, fresh: opencl.Session) -> None:
    array = np.ones(3, np.float32)
    factors = (2.0, -0.5, 1e30, float("inf"), 0.1)
    assert [scale(fresh, factor, array)[0] for factor in factors] == [np.float32(factor) for factor in factors]
    assert scale(fresh, 0.1, array.astype(np.float64))[0] == 0.1


LOG = """Compilation started
Options used by backend compiler: -cl-std=CL1.2 -Werror -Wno-warning
remark: <unknown>:0:0: loop not vectorized: Control flow cannot be substituted for a select
Kernel "scale" was not vectorized
Done."""


def test_logs_of_success_are_silent(kernels: Path, fresh: opencl.Session) -> None:
    """Intel's compiler writes one; pytest makes errors of warnings."""
    assert programs.compiler_warnings(LOG) == programs.compiler_warnings("") == ""
    assert scale(fresh, 2, np.ones(1, np.float32))[0] == 2


def test_a_compilers_warnings_are_shown(kernels: Path, fresh: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    text = f"{LOG}\nscale.cl:3:7: warning: unused variable 'i'\n1 warning generated."
    wanted = "scale.cl:3:7: warning: unused variable 'i'\n1 warning generated."
    assert programs.compiler_warnings(text) == wanted
    monkeypatch.setattr(session_module, "compiler_warnings", lambda _: wanted)
    with pytest.warns(UserWarning, match=r"^scale.cl builds on .* with warnings:\nscale.cl:3:7: warning: unused"):
        scale(fresh, 2, np.ones(1, np.float32))


def test_results_of_one_launch_feed_the_next(kernels: Path, fresh: opencl.Session) -> None:
    array, result = np.arange(5, dtype=np.float32), np.empty(5, np.float32)
    defines = opencl.defines_for(array.dtype)
    with fresh.job() as job:
        between = job.scratch(array.size, array.dtype)
        scaled = {"factor": np.float32(3), "in": job.read(array), "out": between}
        job.launch("scale.cl", "scale", defines, array.shape, scaled)
        job.launch("scale.cl", "add_one", defines, array.shape, {"in": between, "out": job.write(result)})
        job.sync()
        assert result.tolist() == [1, 4, 7, 10, 13]


@pytest.mark.parametrize("offset", [4, 64, 128, 4096])
def test_a_cpu_reads_the_array_itself(kernels: Path, fresh: opencl.Session, offset: int) -> None:
    """However it is aligned; even if nobody may write it."""
    if fresh.info.kind != "CPU":
        pytest.skip("this device has its own memory")
    memory, result = np.ones(3 * 4096, np.uint8), np.empty(8, np.float32)
    start = -memory.ctypes.data % 4096 + offset
    array = memory[start : start + 32].view(np.float32)
    protected = array.view()
    protected.flags.writeable = False
    with fresh.job() as job:
        arguments = {"factor": np.float32(2), "in": job.read(protected), "out": job.write(result)}
        array[:] = 21  # after `read`: a copy would not see it
        job.launch("scale.cl", "scale", opencl.defines_for(array.dtype), array.shape, arguments)
    assert result.tolist() == [42] * 8


def test_a_failed_job_frees_the_session(kernels: Path, fresh: opencl.Session) -> None:
    with pytest.raises(KeyError), fresh.job() as job:
        job.launch("scale.cl", "no_such_kernel", opencl.defines_for(np.dtype(np.float32)), (1,), {})
    with ThreadPoolExecutor(1) as other:
        assert other.submit(scale, fresh, 2, np.ones(1, np.float32)).result(timeout=60) == 2


def test_threads_share_a_session(kernels: Path, fresh: opencl.Session) -> None:
    array = np.arange(100, dtype=np.float32)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda factor: scale(fresh, factor, array), range(40)))
    for factor, result in enumerate(results):
        np.testing.assert_array_equal(result, factor * array)


def test_profile_times_every_kernel(kernels: Path, fresh: opencl.Session) -> None:
    array = np.ones(10_000, np.float32)
    scale(fresh, 1, array)
    with fresh.profile() as times:
        scale(fresh, 2, array)
        scale(fresh, 3, array)
    scale(fresh, 4, array)
    assert [time.name for time in times] == ["scale", "scale"]
    assert all(0 < time.start_ns <= time.end_ns for time in times)


def test_an_observer_hears_of_every_outermost_job(kernels: Path, fresh: opencl.Session) -> None:
    array, heard = np.ones(10_000, np.float32), []
    scale(fresh, 1, array)
    before = time.perf_counter_ns()
    with opencl.observe(heard.append):
        scale(fresh, 2, array)
        with fresh.job(), fresh.profile() as times:
            scale(fresh, 3, array)
            scale(fresh, 4, array)
    after = time.perf_counter_ns()
    scale(fresh, 5, array)
    assert [[launch.name for launch in job.launches] for job in heard] == [["scale"], ["scale", "scale"]]
    assert [time.name for time in times] == ["scale", "scale"], "a profile inside sees what the observer sees"
    low, high = fresh.clock_bounds()
    for job in heard:
        assert job.session is fresh and before < job.start_ns < job.end_ns < after
        for launch in job.launches:
            assert job.start_ns < launch.enqueued_ns < job.end_ns
            assert launch.queued_ns <= launch.submitted_ns <= launch.start_ns < launch.end_ns
            assert job.start_ns <= launch.start_ns - low and launch.end_ns - high <= job.end_ns


def test_an_observer_is_notified_when_a_job_fails(kernels: Path, fresh: opencl.Session) -> None:
    heard: list[opencl.JobTimes] = []
    with opencl.observe(heard.append):
        test_a_failed_job_frees_the_session(kernels, fresh)
    assert [len(job.launches) for job in heard] == [1]


def test_one_observer_at_a_time(kernels: Path, fresh: opencl.Session) -> None:
    heard: list[opencl.JobTimes] = []
    with opencl.observe(heard.append):
        with pytest.raises(ValueError, match="`observer` must be the only one"), opencl.observe(print):
            pass
        scale(fresh, 2, np.ones(4, np.float32))
    assert len(heard) == 1


def test_clock_bounds_hold_the_devices_clock(fresh: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a device without a call for its clock, and of one with it, which is a made-up one."""
    low, high = fresh.clock_bounds()
    assert 0 <= high - low < 10**9

    class Clock:
        def device_and_host_timer(self) -> tuple[int, int]:
            return time.perf_counter_ns() + 10**12, 0

    monkeypatch.setattr(fresh, "_device", Clock())
    low, high = fresh.clock_bounds()
    assert low <= 10**12 <= high < low + 10**9


def test_a_profile_inside_a_job(kernels: Path, fresh: opencl.Session) -> None:
    array = np.ones(10_000, np.float32)
    with fresh.job():
        with fresh.profile() as times:
            result = scale(fresh, 2, array)
        again = scale(fresh, 3, array)
    assert [time.name for time in times] == ["scale"]
    assert result[0] == 2 and again[0] == 3


def test_a_profile_holds_up_no_other_thread(kernels: Path, fresh: opencl.Session) -> None:
    """Nor does it lose kernels: its own, or those of a profile around it."""
    array = np.ones(100, np.float32)
    with ThreadPoolExecutor(1) as other, fresh.profile() as outer:
        scale(fresh, 2, array)
        with fresh.profile() as inner:
            assert other.submit(scale, fresh, 3, array).result(timeout=60)[0] == 3
            assert other.submit(fresh.free_scratch).result(timeout=60) is None
        scale(fresh, 4, array)
    assert [len(times) for times in (outer, inner)] == [3, 1]
    assert all(0 < one.start_ns <= one.end_ns for one in (*outer, *inner))


def test_a_profile_and_an_observer_begin_while_a_job_runs(kernels: Path, fresh: opencl.Session) -> None:
    """In another thread: the profile sees the job's remaining kernels, the observer none of its."""
    array, heard = np.ones(100, np.float32), []
    with ThreadPoolExecutor(1) as other:
        begun, go_on = threading.Event(), threading.Event()

        def work() -> list[np.ndarray]:
            with fresh.job():
                results = [scale(fresh, 2, array)]
                begun.set()
                assert go_on.wait(60)
                results += [scale(fresh, 3, array), scale(fresh, 4, array)]
            return results

        running = other.submit(work)
        assert begun.wait(60)
        with opencl.observe(heard.append), fresh.profile() as times:
            go_on.set()
            results = running.result(timeout=60)
    assert [result[0] for result in results] == [2, 3, 4]
    assert len(times) == 2 and not heard


def test_the_leftovers_of_a_failed_job_inside_another(kernels: Path, fresh: opencl.Session) -> None:
    """The outer one continues."""
    array, result = np.ones(100, np.float32), np.empty(100, np.float32)

    def fail() -> None:
        with fresh.job() as inner:
            arguments = {"factor": np.float32(2), "in": inner.read(array), "out": inner.write(result)}
            inner.launch("scale.cl", "scale", opencl.defines_for(array.dtype), array.shape, arguments)
            inner.launch("scale.cl", "no_such_kernel", opencl.defines_for(array.dtype), (1,), {})

    with fresh.job() as outer:
        with pytest.raises(KeyError):
            fail()
        others = scale(fresh, 3, array), scale(fresh, 4, array)
        outer.sync()
        assert [other[0] for other in others] == [3, 4] and result[0] == 2


def test_a_session_counts_the_seconds_of_its_jobs(kernels: Path, fresh: opencl.Session) -> None:
    """From a job's first argument to its last result, once where one job is inside another."""
    assert fresh.seconds == 0
    start = time.perf_counter()
    scale(fresh, 2, np.ones(100, np.float32))
    first, around = fresh.seconds, time.perf_counter() - start
    assert 0 < first <= around
    start = time.perf_counter()
    with fresh.job():
        time.sleep(0.05)
        scale(fresh, 2, np.ones(100, np.float32))
        time.sleep(0.05)
    around = time.perf_counter() - start
    assert 0.1 <= fresh.seconds - first <= around
