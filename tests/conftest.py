"""Fixtures: the OpenCL devices that operators are tested on, and the precisions.

VESTCL_TEST_DEVICES: "all" tests every device, a comma-separated list of selectors tests those ("pocl,nvidia");
without it, the default device.
"""

import gc
import os
from collections.abc import Iterator

import processes
import pytest
import torch

from vestcl import opencl
from vestcl.opencl import selection

gc.disable()  # a third of the time that it takes to collect the tests; see pytest_collection_finish
processes.preload()
torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)

#: Files whose tests take longest: two processes that begin with them end together.
LONGEST = (
    "test_notebooks.py", "test_train_ranks.py", "test_prepare_workers.py", "test_train_evaluate.py",
    "test_train_fit.py", "test_bench_pareto.py", "test_geometric_forecast.py", "test_train_evaluate_preprocessing.py",
    "test_doctor.py", "test_compile.py", "test_bench_stability.py", "test_uneven_times.py", "test_train_overfit.py",
    "test_interrupts.py", "test_live.py", "test_packaging.py", "test_viewer_page.py", "test_demo.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


def pytest_collection_finish() -> None:
    """What is there before the first test stays: no collection of garbage needs to look at it, now or later."""
    gc.collect()
    gc.freeze()
    gc.enable()


def _devices() -> list[opencl.DeviceInfo]:
    wanted = os.environ.get("VESTCL_TEST_DEVICES", "")
    if wanted == "all":  # Clover lists GPUs that it can't compile for
        return [info for info in opencl.devices() if info.platform != "Clover"]
    return [opencl.select(selector.strip() or None) for selector in wanted.split(",")]


def _mapped() -> list[tuple[str, str]]:
    both, gpu = ("tile", "pixel"), ("pixel",)
    return [(info.index, mapping) for info in _devices() for mapping in (both if info.kind == "CPU" else gpu)]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _devices_are_given_back() -> Iterator[None]:
    """What a test leaves in use, the next one would run on."""
    before = selection._selected.get()
    yield
    assert selection._selected.get() is before, "the test left another device in use"


@pytest.fixture(params=[info.index for info in _devices()])
def session(request: pytest.FixtureRequest) -> Iterator[opencl.Session]:
    """Each device under test, with the mapping that suits it."""
    with opencl.use(request.param) as opened:
        yield opened


@pytest.fixture(params=_mapped(), ids="-".join)
def mapped_session(request: pytest.FixtureRequest) -> Iterator[opencl.Session]:
    """Each device under test; a CPU with both mappings, so that it tests the GPUs' path too."""
    with opencl.use(*request.param) as opened:
        yield opened


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Both precisions, on devices that have both."""
    if request.param == torch.float64:
        _need_float64(request)
    return request.param


@pytest.fixture
def float64(request: pytest.FixtureRequest) -> torch.dtype:
    """For gradcheck: only on devices that have float64."""
    _need_float64(request)
    return torch.float64


def _need_float64(request: pytest.FixtureRequest) -> None:
    name = "mapped_session" if "mapped_session" in request.fixturenames else "session"
    info = request.getfixturevalue(name).info
    if not info.float64:
        pytest.skip(f"{info.name} has no float64")
