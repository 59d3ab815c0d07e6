"""vestcl.scene.layers: complete layers from a frame with gaps, and several frames side by side."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.scene.layers import LayerBatch, Layers, batch, build_layers

HEIGHT, WIDTH = 48, 96


def frame() -> dict[str, Any]:
    """A wall at 20 m, sky over it, a car at 6 m before it, and a gap of depth in the wall."""
    depth = np.full((1, HEIGHT, WIDTH), 20, np.float32)
    depth[:, 30:34, 10:20] = 0
    mask = np.ones((1, HEIGHT, WIDTH), bool)
    mask[:, 20:40, 40:60] = False
    sky = np.zeros((1, HEIGHT, WIDTH), bool)
    sky[:, :10] = True
    image = np.random.default_rng(0).random((3, HEIGHT, WIDTH), np.float32)
    return {"image": image, "depth": np.where(mask, depth, np.float32(6)), "mask": mask, "sky": sky}


def test_everything_is_there() -> None:
    given = frame()
    layers = build_layers(**given)
    for name in ("depth", "background_depth"):
        metres = getattr(layers, name)
        assert metres.shape == (1, HEIGHT, WIDTH) and metres.dtype == np.float32
        assert np.isfinite(metres).all() and (metres > 0).all() and (metres <= SKY_DEPTH).all()
    known = (given["depth"] > 0) & ~given["sky"]
    assert np.array_equal(layers.depth[known], given["depth"][known])
    np.testing.assert_allclose(layers.depth[:, 30:34, 10:20], 20, rtol=0.01)
    assert np.array_equal(layers.depth == SKY_DEPTH, given["sky"])


def test_the_background_equals_the_frame_outside_the_foreground() -> None:
    given = frame()
    layers = build_layers(**given)
    outside = given["mask"][0]
    assert np.array_equal(layers.background_image[:, outside], given["image"][:, outside])
    assert np.array_equal(layers.background_depth[:, outside], layers.depth[:, outside])


def test_behind_the_car_is_the_wall() -> None:
    given = frame()
    layers = build_layers(**given)
    behind = ~given["mask"]
    assert (layers.background_depth[behind] >= 1.01 * layers.depth[behind] - 1e-4).all()
    np.testing.assert_allclose(np.median(layers.background_depth[behind]), 20, rtol=0.05)


def test_no_foreground_leaves_nothing_to_fill() -> None:
    given = frame() | {"mask": np.ones((1, HEIGHT, WIDTH), bool)}
    layers = build_layers(**given)
    assert np.array_equal(layers.background_image, given["image"])
    assert np.array_equal(layers.background_depth, layers.depth)


def test_sky_from_the_depth_where_none_is_given() -> None:
    given = frame()
    given["depth"] = np.where(given["sky"], np.float32(2 * SKY_DEPTH), given["depth"])
    with_sky, without = build_layers(**given), build_layers(**given | {"sky": None})
    assert np.array_equal(without.depth, with_sky.depth)


def test_the_inpainter_that_is_asked_for() -> None:
    red = np.array([1, 0, 0], np.float32)[:, None, None]

    def paint(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
        return np.where(hole, red, colour)

    given = frame()
    layers = build_layers(**given, inpaint=paint)
    assert np.array_equal(layers.background_image, np.where(given["mask"], given["image"], red))


def test_nothing_but_sky() -> None:
    given = frame() | {"mask": np.ones((1, HEIGHT, WIDTH), bool), "sky": np.ones((1, HEIGHT, WIDTH), bool)}
    assert (build_layers(**given).depth == SKY_DEPTH).all()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("image", np.zeros((1, HEIGHT, WIDTH)), r"`image` must be \[3, H, W\]"),
        ("image", np.full((3, HEIGHT, WIDTH), np.nan), "`image` must be finite"),
        ("depth", np.ones((1, HEIGHT, WIDTH - 1)), rf"`depth` must be \[1, {HEIGHT}, {WIDTH}\]"),
        ("depth", np.zeros((1, HEIGHT, WIDTH)), "`depth` must have a valid pixel"),
        ("depth", np.full((1, HEIGHT, WIDTH), -1.0), "`depth` must be 0"),
        ("mask", np.ones((1, HEIGHT, WIDTH)), "`mask` must be bool"),
        ("sky", np.zeros((1, 2, 2), bool), rf"`sky` must be \[1, {HEIGHT}, {WIDTH}\]"),
    ],
)
def test_arguments(name: str, value: NDArray[Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_layers(**frame() | {name: value})


def test_depth_only_in_the_sky_is_none() -> None:
    given = frame()
    given["depth"] = np.where(given["sky"], np.float32(50), np.float32(0))
    with pytest.raises(ValueError, match="`depth` must have a valid pixel outside the sky"):
        build_layers(**given)


def layers_of(seed: int, width: int = WIDTH) -> Layers:
    rng = np.random.default_rng(seed)
    image, background = rng.random((2, 3, HEIGHT, width), np.float32)
    depth, behind = 1 + rng.random((2, 1, HEIGHT, width), np.float32)
    return Layers(image, depth, rng.random((1, HEIGHT, width)) < 0.5, background, behind)


def test_side_by_side() -> None:
    frames = [layers_of(seed) for seed in range(3)]
    together = batch(frames)
    for name in LayerBatch._fields:
        tensor = getattr(together, name)
        assert tensor.dtype == torch.float32 and tensor.is_contiguous()
        for index, one in enumerate(frames):
            assert np.array_equal(tensor[index].numpy(), getattr(one, name))


def test_a_batch_has_its_own_memory() -> None:
    one = layers_of(0)
    before = one.image.copy()
    batch([one]).image.zero_()
    assert np.array_equal(one.image, before)


def test_a_batch_of_float64_is_float32() -> None:
    one = layers_of(0)
    assert batch([replace(one, depth=one.depth.astype(np.float64))]).depth.dtype == torch.float32


def test_batches_of_nothing_or_of_several_sizes() -> None:
    with pytest.raises(ValueError, match="`frames` must be one or more, got none"):
        batch([])
    with pytest.raises(
        ValueError, match=f"`frames` must be of one size, got {HEIGHT}x{WIDTH - 1} and {HEIGHT}x{WIDTH}"
    ):
        batch([layers_of(0), layers_of(1, WIDTH - 1)])
