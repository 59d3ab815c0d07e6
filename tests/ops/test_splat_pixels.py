"""The mapping "pixel", which GPUs have, on CPU devices: groups of 64 and more, and a composite that stops early."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from test_splat import Scene, all_of, assert_same_bits, detached, scene
from tolerances import assert_like_reference

from vestcl import opencl, reference
from vestcl.data import Street, intrinsics
from vestcl.opencl import session as session_module
from vestcl.ops.displace import displace
from vestcl.ops.rigid_flow import rigid_flow
from vestcl.ops.splat import rasterize, skipped, splat
from vestcl.ops.stretch import stretch
from vestcl.ops.unproject import unproject

LEAVE = "if (last_open != e) break;"


@pytest.fixture
def pixels(session: opencl.Session) -> Iterator[opencl.Session]:
    with opencl.use(session.info.index, "pixel") as opened:
        yield opened


def run_all_operators() -> None:
    """Forward and backward; the sizes are no multiples of a group."""
    depth, K = torch.rand(3, 1, 9, 14, requires_grad=True), torch.eye(3).repeat(3, 1, 1)
    points_xyz = unproject(depth, K)
    motion = torch.rand(3, 4, requires_grad=True), torch.rand(3, 3, requires_grad=True)
    points_uv, z = displace(points_xyz, rigid_flow(points_xyz, *motion), K)
    torch.autograd.backward((points_uv.sum() + z.sum(),))
    stretch(points_uv.detach().view(3, 9, 14, 2), torch.rand(3, 9, 14))
    arguments = scene(2, 300, 5)
    all_of(arguments)
    geometry = {name: arguments[name] for name in ("points_uv", "z", "radii", "opacities", "height", "width")}
    skipped(rasterize(**geometry))
    town = Street.generate(1)
    town.render(np.linalg.inv(town.camera_pose(0.0)), intrinsics(20, 37), 20, 37, 0.0)


def test_groups_of_64_and_more(pixels: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU runs 32 or 64 work-items of a group in step: a group of one would use one of its lanes."""
    sizes = dict[str, tuple[Sequence[int], Sequence[int]]]()
    plain = opencl.Job.launch

    def launch(
        job: opencl.Job, file: str, name: str, defines: Any, size: Any, arguments: Any, local: Any = None
    ) -> None:
        sizes[name] = tuple(size), tuple(local or (1,) * len(size))
        plain(job, file, name, defines, size, arguments, local)

    monkeypatch.setattr(opencl.Job, "launch", launch)
    run_all_operators()
    assert {"count_tiles", "fill_tiles", "find_finite", "clear_gradients", "list_solids", "count_skipped"} <= set(sizes)
    for name, (items, group) in sizes.items():
        assert np.prod(group) >= 64, f"{name}: a group is {group}"
        assert all(n % g == 0 for n, g in zip(items, group, strict=True)), f"{name}: {items} in groups of {group}"


def test_results_do_not_depend_on_the_group(pixels: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = all_of(scene(2, 2000, 5))
    for group in (128, 256):  # Intel's compiler rounds in groups of 1 differently: it makes no vector code of them
        monkeypatch.setattr(opencl.groups, "GPU_GROUP", group)
        torch.manual_seed(0)
        monkeypatch.setattr(opencl, "GPU_GROUP", group)
        assert_same_bits(all_of(scene(2, 2000, 5)), wanted)


# ---------------------------------------------------------------- a composite that stops early


def opaque_layers(layers: int, height: int, width: int, channels: int = 3) -> Scene:
    """A point of opacity 1 on every pixel's centre, in each layer."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    count = layers * height * width
    return {
        "points_uv": torch.stack([x, y], dim=-1).reshape(1, -1, 2).repeat(1, layers, 1),
        "z": torch.arange(1.0, layers + 1).repeat_interleave(height * width)[None],
        "radii": torch.ones(1, count),
        "opacities": torch.ones(1, count),
        "features": torch.randn(1, count, channels),
        "backgrounds": torch.randn(1, channels),
        "height": height,
        "width": width,
    }


def haze(count: int) -> Scene:
    """Points over the whole image: a list of `count` entries a tile, transmittance falls by and by."""
    arguments = detached(scene(1, count, 3))
    arguments["radii"] = arguments["radii"].fill_(60)
    arguments["opacities"] = 0.02 * arguments["opacities"]
    return arguments


def with_a_window() -> Scene:
    """All pixels but one are opaque after the first layer, which has a hole; the point behind it is the last one."""
    arguments = opaque_layers(4, 20, 37)
    first = arguments["points_uv"][0, : 3 * 20 * 37]
    hole = (first - torch.tensor([18.5, 3.5])).norm(dim=-1) < 1
    arguments["opacities"][0, : 3 * 20 * 37][hole] = 0
    return arguments


def strange_opacities() -> Scene:
    """Beyond [0, 1]: transmittance may be negative, grow again, overflow and become NaN."""
    arguments = detached(scene(1, 1500, 3))
    arguments["opacities"] = 100 * torch.randn(1, 1500)
    return arguments


@pytest.fixture
def never_leaving(pixels: opencl.Session, monkeypatch: pytest.MonkeyPatch) -> Callable[[], opencl.Session]:
    """A session of the same device whose composite traverses every list to its end."""

    def opened() -> opencl.Session:
        plain = session_module.source
        assert plain("splat/splat_composite_pixels.cl").count(LEAVE) == 1
        monkeypatch.setattr(session_module, "source", lambda file: plain(file).replace(LEAVE, ""))
        return opencl.Session(pixels.info, "pixel", pixels._device)

    return opened


SCENES: dict[str, Callable[[], Scene]] = {
    "opaque": lambda: opaque_layers(12, 20, 37),
    "haze": lambda: haze(900),
    "window": with_a_window,
    "strange": strange_opacities,
    "random": lambda: detached(scene(2, 1500, 3)),
}


@pytest.mark.parametrize("min_transmittance", [0.0, 0.3])
@pytest.mark.parametrize("name", SCENES)
def test_stopping_early_changes_no_bit(
    pixels: opencl.Session, never_leaving: Callable[[], opencl.Session], monkeypatch: pytest.MonkeyPatch,
    name: str, min_transmittance: float,
) -> None:  # fmt: skip
    arguments = SCENES[name]() | {"min_transmittance": min_transmittance}
    got = splat(**arguments)
    plain, monkeyed = opencl.current, never_leaving()
    monkeypatch.setattr(opencl, "current", lambda: monkeyed)
    wanted = splat(**arguments)
    monkeypatch.setattr(opencl, "current", plain)
    for one, other in zip(got, wanted, strict=True):
        assert one.numpy().tobytes() == other.numpy().tobytes()  # NaN, too


def composite_seconds(session: opencl.Session, arguments: Scene) -> float:
    """The fastest of three."""
    runs = []
    for _ in range(3):
        with session.profile() as times:
            splat(**arguments)
        runs.append(sum(t.end_ns - t.start_ns for t in times if t.name == "composite_pixels"))
    return min(runs) / 1e9


def test_opaque_layers_take_a_fraction_of_the_time(
    pixels: opencl.Session, never_leaving: Callable[[], opencl.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = opaque_layers(200, 16, 32)
    early = composite_seconds(pixels, arguments)
    late = never_leaving()
    monkeypatch.setattr(opencl, "current", lambda: late)
    assert early < composite_seconds(late, arguments) / 3


# ---------------------------------------------------------------- channels in groups


@pytest.mark.parametrize("channels", [31, 32, 33, 70])
def test_channels_in_overlapping_groups(pixels: opencl.Session, channels: int) -> None:
    """Of 33 the second group composites 31 that the first has written, and writes one."""
    arguments = scene(2, 60, channels)
    assert_like_reference(splat, reference.splat, **arguments)
    image, _ = splat(**detached(arguments))
    for c in (0, channels - 32, 31, channels - 1):
        c = max(0, min(c, channels - 1))
        only = {name: arguments[name].detach()[..., c : c + 1] for name in ("features", "backgrounds")}
        torch.testing.assert_close(image[:, c], splat(**detached(arguments) | only)[0][:, 0], rtol=1e-5, atol=1e-6)
