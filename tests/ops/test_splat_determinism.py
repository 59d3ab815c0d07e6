"""vestcl.ops.splat gives the same bits: twice, on any number of threads, from any memory and in any layout."""

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from processes import Process
from test_splat import INPUTS, all_of, assert_same_bits, detached, scene

from vestcl import opencl
from vestcl.opencl import host_memory
from vestcl.ops import _splat_lists
from vestcl.ops.splat import composite, rasterize, splat


@pytest.fixture(autouse=True)
def _no_points_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """All scenes use the kernels for many points; test_splat_few.py compares them with those for few."""
    monkeypatch.setattr(_splat_lists, "FEW_POINTS", 0)


def bits(channels: int) -> str:
    """A hash of image, coverage and all gradients of a scene with lists of several hundred points."""
    torch.manual_seed(2)
    outputs = all_of(scene(3, 2000, channels))
    return hashlib.sha256(b"".join(t.detach().contiguous().numpy().tobytes() for t in outputs)).hexdigest()


def report() -> None:
    """What a child process prints: the compute units that it has, and the bits of both mappings."""
    hashes = []
    for mapping in ("tile", "pixel"):
        with opencl.use(None, mapping):
            hashes += [bits(5), bits(16)]
    print(opencl.current().info.compute_units, *hashes)


@pytest.mark.parametrize("channels", [5, 16])
def test_twice(mapped_session: opencl.Session, channels: int) -> None:
    assert bits(channels) == bits(channels)


def test_any_number_of_threads(session: opencl.Session, tmp_path: Path) -> None:
    if "PoCL" not in session.info.version or session.info.kind != "CPU":
        pytest.skip("only PoCL on a CPU can be given a number of threads to use")
    children = []
    for threads in ("1", "3"):
        units = {"POCL_MAX_PTHREAD_COUNT": threads, "POCL_CPU_MAX_CU_COUNT": threads}
        environment = units | {"VESTCL_DEVICE": session.info.index}
        children.append(Process(tmp_path / threads, report, environment=environment))
    assert [child.wait() for child in children] == [0, 0], [child.output for child in children]
    reports = [child.output.split() for child in children]
    assert [len(words) for words in reports] == [5, 5]
    assert reports[0][0] != reports[1][0], "both children have as many compute units"
    with opencl.use(session.info.index, "tile"):
        assert [bits(5), bits(16)] == reports[0][1:3]
    assert reports[0][1:] == reports[1][1:]


@pytest.mark.parametrize("most", [1 << 24, 100_000, 1])
def test_counters_are_bounded_on_any_number_of_units(
    mapped_session: opencl.Session, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Of a CPU with 100,000 units, too; and no result depends on how many chunks there are."""
    counters = 3 * 6
    reference = bits(5)
    monkeypatch.setattr(mapped_session, "info", dataclasses.replace(mapped_session.info, compute_units=100_000))
    monkeypatch.setattr(_splat_lists, "MAX_COUNTERS", most)
    chunks, group = _splat_lists.chunks_of(mapped_session, 10**9, counters)
    assert chunks >= 1 and (chunks == 1 or chunks * counters <= most) and chunks % group == 0
    assert bits(5) == reference


@pytest.mark.parametrize("pattern", [0x00, 0xFF, 0x3F])  # zeros, NaN or -1, and harmless looking numbers
def test_whatever_memory_held_before(
    mapped_session: opencl.Session, monkeypatch: pytest.MonkeyPatch, pattern: int
) -> None:
    """Outputs and scratch memory are written before they are read: their former contents leave no trace."""
    if not mapped_session.shares_host_memory:
        pytest.skip("this device's memory can't be filled from here")

    plain = host_memory.empty

    def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        array = plain(shape, dtype)
        filled.append(array.nbytes)
        array.reshape(-1).view(np.uint8).fill(pattern)
        return array

    def scratch(job: opencl.Job, count: int, dtype: Any) -> opencl.Buffer:
        scratches.append(count)
        return job.write(empty((max(1, count) * np.dtype(dtype).itemsize,), np.uint8))

    reference, filled, scratches = (bits(5), bits(16)), [], []
    monkeypatch.setattr(opencl.Job, "scratch", scratch)
    monkeypatch.setattr(host_memory, "empty", empty)
    assert (bits(5), bits(16)) == reference
    assert len(filled) > 10 and scratches


@pytest.mark.parametrize("name", ["z", *INPUTS])
@pytest.mark.parametrize("layout", ["every second", "transposed", "expanded"])
def test_any_strides(mapped_session: opencl.Session, name: str, layout: str) -> None:
    arguments = scene(2, 40, 3)
    plain = arguments[name].detach()
    if layout == "every second":
        strided = plain.repeat_interleave(2, dim=-1)[..., ::2]
    elif layout == "transposed":
        strided = plain.transpose(0, -1).contiguous().transpose(0, -1)
    else:
        strided = plain[:1].expand(plain.shape)
    assert not strided.is_contiguous()
    as_it_is = arguments | {name: strided.requires_grad_(name != "z")}
    copied = arguments | {name: strided.detach().contiguous().requires_grad_(name != "z")}
    assert_same_bits(all_of(as_it_is), all_of(copied))


def laid_out(layout: str, shape: torch.Size) -> torch.Tensor:
    """A random gradient of an output, in a layout of memory."""
    batch, channels, height, width = shape
    if layout == "expanded":  # what .sum() makes
        return torch.tensor(1.5).expand(shape)
    if layout == "expanded channels":
        return torch.randn(batch, 1, height, width).expand(shape)
    if layout == "expanded images":
        return torch.randn(1, channels, height, width).expand(shape)
    if layout == "expanded pixels":
        return torch.randn(batch, channels, 1, 1).expand(shape)
    if layout == "expanded columns":
        return torch.randn(batch, channels, height, 1).expand(shape)
    if layout == "transposed":
        return torch.randn(batch, channels, width, height).transpose(2, 3)
    if layout == "slice":
        return torch.randn(batch + 1, channels + 2, height + 3, width + 5)[1:, 1:-1, 2:-1, 3:-2]
    if layout == "channels-last slice":
        return torch.randn(batch, height, width, channels + 2)[..., 1:-1].permute(0, 3, 1, 2)
    return torch.randn(shape).contiguous(memory_format=torch.channels_last)


LAYOUTS = (
    "channels-last", "channels-last slice", "slice", "transposed", "expanded", "expanded channels", "expanded images",
    "expanded pixels", "expanded columns",
)  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("channels", [1, 3, 5, 16])
def test_any_strides_of_the_incoming_gradients(mapped_session: opencl.Session, layout: str, channels: int) -> None:
    arguments = scene(2, 50, channels)
    outputs = splat(**arguments)
    grads = [laid_out(layout, output.shape) for output in outputs]
    inputs = [arguments[name] for name in INPUTS]
    planar = [grad.clone(memory_format=torch.contiguous_format) for grad in grads]
    as_they_are = torch.autograd.grad(outputs, inputs, grads, retain_graph=True)
    assert_same_bits(as_they_are, torch.autograd.grad(outputs, inputs, planar))


def test_any_order_in_memory_at_distinct_depths(mapped_session: opencl.Session) -> None:
    arguments = scene(1, 300, 3)
    arguments["z"] = torch.randperm(300)[None] / 10 + 0.1
    order = torch.randperm(300)
    shuffled = {
        name: v.detach()[:, order].requires_grad_(v.requires_grad) if name in ("z", *INPUTS[:4]) else v
        for name, v in arguments.items()
    }
    image, coverage, *grads, grad_backgrounds = all_of(arguments)
    wanted = image, coverage, *(grad[:, order] for grad in grads), grad_backgrounds
    assert_same_bits(all_of(shuffled), wanted)


def test_a_raster_keeps_its_own_numbers(mapped_session: opencl.Session) -> None:
    arguments = detached(scene(1, 50, 3))
    before = splat(**arguments)
    features, backgrounds = arguments.pop("features"), arguments.pop("backgrounds")
    raster = rasterize(**arguments)
    for name in ("points_uv", "z", "radii", "opacities"):
        arguments[name].zero_()
    assert_same_bits(composite(raster, features, backgrounds), before)
