"""What the host and the kernels both know: sizes of structures, constants, arguments. A breach never runs."""

import re
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from vestcl import opencl
from vestcl.data.street import raycast
from vestcl.opencl.parameters import Parameter, check_arguments, parameters
from vestcl.ops import _splat_layer
from vestcl.ops._splat_lists import entry_type, record_type, splat_defines

LISTS = "splat/splat_bin.cl"
COMPOSITE = "splat/splat_composite.cl"
PIXELS = "splat/splat_composite_pixels.cl"
FLOAT32 = np.dtype(np.float32)
GRADS = {f"GRAD_{name}": 1 for name in ("FEATURES", "POINTS_UV", "RADII", "OPACITIES", "BACKGROUNDS")}
BACKWARD: dict[str, str | int] = {**GRADS, "HAS_BACKGROUNDS": 1, "HAS_GRAD_COVERAGE": 1}


def splat_programs(dtype: np.dtype[Any]) -> dict[str, dict[str, str | int]]:
    """Each file of splatting, and what it may be built with."""
    return {
        LISTS: splat_defines(dtype, BUILTINS=0, TOGETHER=1),
        "splat/splat_bin_few.cl": splat_defines(dtype, BUILTINS=0),
        "splat/splat_skipped.cl": splat_defines(dtype),
        COMPOSITE: {**_splat_layer.defines_of_tiles(dtype, 5, True, False), **BACKWARD},
        PIXELS: {**_splat_layer.defines_of_pixels(dtype, 5, True), **BACKWARD},
    }


def build(session: opencl.Session, file: str, defines: dict[str, str | int]) -> None:
    session._build(file, defines)


def assert_does_not_build(session: opencl.Session, file: str, defines: dict[str, str | int], why: str) -> None:
    with pytest.raises(opencl.DeviceError, match=why):
        build(session, file, defines)


# ---------------------------------------------------------------- sizes and constants


def test_sizes_of_structures(session: opencl.Session, dtype: Any) -> None:
    real = np.dtype(str(dtype).removeprefix("torch."))
    assert (entry_type(real).itemsize, record_type(real).itemsize) == (2 * real.itemsize, 4 * real.itemsize + 8)
    for file, defines in splat_programs(real).items():
        build(session, file, defines)


@pytest.mark.parametrize("file", [LISTS, "splat/splat_bin_few.cl", "splat/splat_skipped.cl", COMPOSITE, PIXELS])
@pytest.mark.parametrize("size", ["ENTRY_BYTES", "RECORD_BYTES"])
def test_a_structure_of_another_size(session: opencl.Session, file: str, size: str) -> None:
    defines = splat_programs(FLOAT32)[file]
    name = size.split("_")[0].lower()
    for wrong in (int(defines[size]) - 4, int(defines[size]) + 8):
        assert_does_not_build(session, file, {**defines, size: wrong}, f"{name}_t_has_the_hosts_size")
    del defines[size]
    assert_does_not_build(session, file, defines, "ENTRY_BYTES and RECORD_BYTES")


@pytest.mark.parametrize("structure", ["SOLID", "VIEW", "COURSE"])
def test_a_structure_of_the_street_of_another_size(
    session: opencl.Session, monkeypatch: pytest.MonkeyPatch, structure: str
) -> None:
    defines = raycast.defines(bent=True)
    wrong = {**defines, f"{structure}_BYTES": int(defines[f"{structure}_BYTES"]) + 4}
    assert_does_not_build(session, "raycast/raycast.cl", wrong, f"{structure.lower()}_t_has_the_hosts_size")


@pytest.mark.parametrize(
    ("file", "change", "why"),
    [
        (COMPOSITE, {"SEGMENT": 255}, "SEGMENT must be at least TILE"),
        (COMPOSITE, {"VECTOR": 8}, "VECTOR must be 1, 4, 8 or 16, and at most CHANNELS"),
        (COMPOSITE, {"VECTOR": 2}, "VECTOR must be 1, 4, 8 or 16"),
        (COMPOSITE, {"TILE": 32, "SEGMENT": 4096}, "TILE must be below 32"),
        (PIXELS, {"CHANNEL_GROUP": 0}, "CHANNEL_GROUP must be at least 1 and at most CHANNELS"),
        (PIXELS, {"CHANNEL_GROUP": 6}, "CHANNEL_GROUP must be at least 1 and at most CHANNELS"),
        (LISTS, {"REAL": "double"}, "double_has_the_hosts_size"),
        (LISTS, {"REAL_BITS": 64}, "float_has_the_hosts_size"),
    ],
)
def test_constants_that_do_not_fit(session: opencl.Session, file: str, change: dict[str, str | int], why: str) -> None:
    if "double" in change.values() and not session.info.float64:
        pytest.skip("no float64")
    assert_does_not_build(session, file, {**splat_programs(FLOAT32)[file], **change}, why)


def test_a_segment_that_just_fits(session: opencl.Session) -> None:
    build(session, COMPOSITE, {**splat_programs(FLOAT32)[COMPOSITE], "SEGMENT": 256})


@pytest.mark.parametrize("file", [COMPOSITE, PIXELS, LISTS])
def test_a_missing_define(session: opencl.Session, file: str) -> None:
    """Each is an #error that names it. Without GRAD_FEATURES there is no backward."""
    complete = splat_programs(FLOAT32)[file]
    for name in set(complete) - {"TOGETHER", "GRAD_FEATURES"}:
        defines = {key: value for key, value in complete.items() if key != name}
        assert_does_not_build(session, file, defines, rf"(?s)error.*define .*{name}")


def test_kernels_of_a_group_take_no_other(session: opencl.Session) -> None:
    defines = splat_programs(FLOAT32)
    for file, name in ((LISTS, "sort_tiles_together"), (PIXELS, "composite_pixels"), (PIXELS, "sum_scratch")):
        kernel = session.kernel(file, name, defines[file])
        wanted = cl.kernel_work_group_info.COMPILE_WORK_GROUP_SIZE
        assert list(kernel.get_work_group_info(wanted, session._device)) == [256, 1, 1]


# ---------------------------------------------------------------- arguments

WITH_OPTION = """
// void stub(const int no)
kernel __attribute__((reqd_work_group_size(1, 1, 1))) void stub(
    const int count, const long stride,  // (a comment, with a comma)
    global const REAL* restrict in,      // [N]
    const REAL factor, global REAL* out
#ifdef BENT
    , const uint course_points
#endif
    )
{
}
"""
STUB = (
    Parameter("count", np.int32), Parameter("stride", np.int64), Parameter("in", None),
    Parameter("factor", np.float64), Parameter("out", None),
)  # fmt: skip


def test_parameters_by_hand() -> None:
    assert parameters(WITH_OPTION, "stub", {"REAL": "double"}) == STUB
    bent = parameters(WITH_OPTION, "stub", {"REAL": "double", "BENT": 1})
    assert bent == (*STUB, Parameter("course_points", np.uint32))
    with pytest.raises(ValueError, match="`kernel` must be one of the program's, got 'other'"):
        parameters(WITH_OPTION, "other", {})
    with pytest.raises(ValueError, match="must declare numbers and pointers, got 'const REAL factor'"):
        parameters(WITH_OPTION, "stub", {})


@pytest.mark.parametrize("bent", [False, True])
def test_parameters_are_those_that_the_driver_has(session: opencl.Session, bent: bool) -> None:
    """Of every kernel that there is."""
    files = {
        **splat_programs(FLOAT32),
        "raycast/raycast.cl": raycast.defines(bent=bent),
        "unproject.cl": opencl.defines_for(FLOAT32),
        "displace.cl": opencl.defines_for(FLOAT32),
        "stretch.cl": opencl.defines_for(FLOAT32, TORN=1, SLANTED=1, BENT=1),
        "rigid_flow.cl": opencl.defines_for(FLOAT32, CHUNKS=4, QUATERNION_FLOOR="1e-8"),
        "splat/splat_roofline.cl": {"BUILTINS": 0},
    }
    folder = opencl.kernel_folder()
    assert set(files) == {path.relative_to(folder).as_posix() for path in folder.rglob("*.cl")}
    for file, defines in files.items():
        text = opencl.source(file)
        named = set(re.findall(r"\bkernel\b[^;{]*?\bvoid (\w+)\(", text))
        for name in named - {"sort_tiles", "composite_few_backward"}:  # other builds of these files have them
            assert len(parameters(text, name, defines)) == session.kernel(file, name, defines).num_args


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"in": ...}, "kernel stub: `in` is missing"),
        ({"inn": 0}, "kernel stub: it has no `inn`"),
        ({"count": np.int64(1)}, "kernel stub: `count` must be int32, got int64"),
        ({"factor": np.float32(1)}, "kernel stub: `factor` must be float64, got float32"),
        ({"stride": "buffer"}, "kernel stub: `stride` must be int64, got a buffer"),
        ({"out": np.int32(1)}, "kernel stub: `out` must be a buffer, got int32"),
        ({"out": ..., "output": "buffer"}, "kernel stub: `out` is missing; it has no `output`"),
    ],
)
def test_arguments_that_do_not_fit(change: dict[str, Any], message: str) -> None:
    fitting = {p.name: "buffer" if p.scalar is None else p.scalar(1) for p in STUB}
    check_arguments("kernel stub", STUB, dict(reversed(fitting.items())))
    arguments = {name: value for name, value in (fitting | change).items() if value is not ...}
    with pytest.raises(TypeError) as caught:
        check_arguments("kernel stub", STUB, arguments)
    assert str(caught.value) == message


def test_a_launch_with_an_argument_of_another_name(session: opencl.Session) -> None:
    array, result = np.ones((1, 1, 2, 2), np.float32), np.empty(12, np.float32)
    fresh = opencl.Session(session.info, session.mapping, session._device)

    def launch(output: str) -> None:
        with fresh.job() as job:
            sizes = dict.fromkeys(("height", "width", "chunk"), np.int32(2))
            arrays = {"depth": job.read(array), "inverse_K": job.read(np.eye(3, dtype=np.float32))}
            arguments: opencl.Arguments = {**sizes, **arrays, output: job.write(result)}
            job.launch("unproject.cl", "unproject", opencl.defines_for(FLOAT32), (1, 2, 1), arguments)

    with pytest.raises(
        TypeError, match=r"^kernel unproject of unproject.cl: `points_xyz` is missing; it has no `out`$"
    ):
        launch("out")
    launch("points_xyz")
    assert result[-3:].tolist() == [1.5, 1.5, 1]
