"""vestcl.bench.splat.roofline: what is counted, and that table, figures and plot agree with it."""

import pytest
import torch

from vestcl import opencl
from vestcl.bench.splat.kernels import Facts, facts_of
from vestcl.bench.splat.roofline import bytes_of, flops_of, roofline
from vestcl.bench.splat.scenes import Scene, street

SIZE = (32, 48)
CHANNELS = 4
COPY_BYTES = 1 << 16


def test_each_kernel_once_with_a_share(mapped_session: opencl.Session) -> None:
    section = roofline(street(*SIZE, CHANNELS, 1.0), calls=2, copy_bytes=COPY_BYTES)
    wide = section.frame.pivot(index="row", columns="column")
    names = [*section.frame[section.frame["column"] == "launches"]["row"]]
    wanted = {"tile": ["sort_tiles", "composite_tiles"], "pixel": ["sort_tiles_together", "composite_pixels"]}
    assert names[:2] == ["count_tiles", "fill_tiles"]
    assert set(wanted[mapped_session.mapping]) <= set(names)
    assert len(set(names)) == len(names)
    for name in names:
        share, least = wide["median"]["of the roof"][name], wide["median"]["least ms"][name]
        assert wide["low"]["of the roof"][name] <= share <= wide["high"]["of the roof"][name]
        assert least / wide["high"]["ms"][name] <= wide["high"]["of the roof"][name] * 1.001
        assert wide["text"]["bound by"][name] in ("memory", "compute")
    assert [row[0] for row in section.grid().rows] == [*names, "all kernels", "no kernel running"]
    figures = [row.name for row in section.rows if row.name]
    assert len({*figures}) == len(figures) == 2 + len(names)
    ((name, draw),) = section.plots.items()
    (axes,) = draw(section.frame, name).axes
    assert len(axes.get_yticklabels()) == len(names) + 2


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


@pytest.mark.parametrize("wrong", [{"calls": 0}, {"copy_bytes": 0}])
def test_what_must_be_positive(session: opencl.Session, wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="`calls` and `copy_bytes` must be positive"):
        roofline(street(*SIZE, CHANNELS, 1.0), **wrong)
