"""vestcl.bench.splat.roofline: what is counted, and that table, figures and plot agree with it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vestcl import opencl
from vestcl.bench.common import results as _results
from vestcl.bench.splat import roofline as _roofline
from vestcl.bench.splat.kernels import Facts, bytes_of, facts_of, flops_of
from vestcl.bench.splat.roofline import RooflineBench, roofline
from vestcl.bench.splat.scenes import Scene, street

SIZE = (32, 48)
CHANNELS = 4
COPY_BYTES = 1 << 16


@pytest.fixture
def measured(mapped_session: opencl.Session) -> tuple[Scene, dict[str, Any]]:
    scene = street(*SIZE, CHANNELS, 1.0)
    return scene, roofline(scene, calls=2, copy_bytes=COPY_BYTES)


def test_each_kernel_once_with_a_share(measured: tuple[Scene, dict[str, Any]], mapped_session: opencl.Session) -> None:
    scene, result = measured
    names = [point["name"] for point in result["points"]]
    wanted = {"tile": ["sort_tiles", "composite_tiles"], "pixel": ["sort_tiles_together", "composite_pixels"]}
    assert names[:2] == ["count_tiles", "fill_tiles"]
    assert set(wanted[mapped_session.mapping]) <= set(names)
    assert len(set(names)) == len(names)
    bandwidth, peak = result["bandwidth"].median, result["peak"].median
    assert bandwidth > 0 < peak
    for point in result["points"]:
        by_memory, by_compute = point["moved_bytes"] / bandwidth, point["flops"] / peak
        least, share = max(by_memory, by_compute), point["share"]
        assert share.low <= share.median <= share.high
        assert least / point["time"].high <= share.high * 1.001
        assert point["bound"] == ("memory" if by_memory >= by_compute else "compute")
    assert result["kernels"] > 0
    assert result["facts"] == facts_of(scene)


def test_bytes_and_flops_by_hand(session: opencl.Session) -> None:
    """One point of radius 1 in the middle of a pixel, one that is behind; 16 x 16 pixels, 3 channels."""
    uv = torch.tensor([[[4.5, 4.5], [4.5, 4.5]]])
    z, ones = torch.tensor([[1.0, -1.0]]), torch.ones(1, 2)
    grad = torch.zeros(1, 3, 16, 16)
    scene = Scene(uv, z, ones, ones, torch.zeros(1, 2, 3), grad)
    facts = facts_of(scene)
    assert (facts.fragments, facts.shown_points) == (1, 1)
    moved = bytes_of(scene, facts)
    record, row, pixels = 24, 12, 256
    assert moved["count_tiles"] == 2 * (5 * 4 + 4)
    assert moved["fill_tiles"] == 2 * 8 + 8
    assert moved["sort_tiles"] == moved["sort_tiles_together"] == 8 + record + 16
    assert moved["composite_tiles"] == record + row + pixels * (row + 4)
    assert moved["clear_gradients"] == 2 * 4 + row + 16
    assert moved["composite_tiles_backward"] == record + 2 * row + 16 + pixels * row
    flops = flops_of(facts)
    assert flops["composite_tiles"] == 10 + 2 * 3 + pixels * 7
    assert flops["composite_tiles_backward"] == 28 + 4 * 3


def test_flops_grow_with_fragments_and_channels() -> None:
    facts = Facts(height=1, width=1, channels=8, radius=1.0, points=4, shown_points=4, fragments=4, most_layers=4)
    more = flops_of(Facts(**vars(facts) | {"fragments": 8}))
    wider = flops_of(Facts(**vars(facts) | {"channels": 16}))
    for name in ("composite_tiles", "composite_tiles_backward"):
        assert flops_of(facts)[name] < more[name]
        assert flops_of(facts)[name] < wider[name]


def test_table_figures_and_plot(
    measured: tuple[Scene, dict[str, Any]], mapped_session: opencl.Session, tmp_path: Path
) -> None:
    from matplotlib.image import imread

    _, result = measured
    names = [point["name"] for point in result["points"]]
    section = _roofline.section(result)
    assert [row[0] for row in section.grid().rows] == [*names, "all kernels", "no kernel running"]
    figures = [row.name for row in section.rows if row.name]
    assert len({*figures}) == len(figures) == 2 + len(names)
    list(_results.drawn("roofline", mapped_session, tmp_path / "deep", [section]))
    (path,) = (tmp_path / "deep").iterdir()
    plot = imread(path)
    assert plot.shape[0] > 400 < plot.shape[1]
    assert len(np.unique(plot[..., :3].reshape(-1, 3), axis=0)) > 10


@pytest.mark.parametrize("wrong", [{"calls": 0}, {"copy_bytes": 0}])
def test_what_must_be_positive(session: opencl.Session, wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="`calls` and `copy_bytes` must be positive"):
        roofline(street(*SIZE, CHANNELS, 1.0), **wrong)


@pytest.mark.parametrize("wrong", [{"height": 0}, {"calls": 0}, {"radii": ()}, {"radii": (1.0, -1.0)}])
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must be"):
        _roofline.main(RooflineBench(**wrong))


def test_command(session: opencl.Session, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths: dict[str, Any] = {"json": tmp_path / "r.json", "markdown": tmp_path / "r.md", "plots": tmp_path / "plots"}
    config = RooflineBench(*SIZE, CHANNELS, (1.0, 2.0), calls=1, device=session.info.index, **paths)
    _roofline.main(config)
    assert "composite_tiles" in capsys.readouterr().out
    device = json.loads(paths["json"].read_text())["devices"][0]
    assert len(device["details"]["rooflines"]) == 2
    assert "of the roof" in paths["markdown"].read_text()
    assert len(list(paths["plots"].glob("*.png"))) == 2
