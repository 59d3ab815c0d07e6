"""vestcl.scene.inpainting.inpaint, .inpainters and .structure on a room whose background is known, and on streets."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from vestcl.bench.forecast.inpaint import street
from vestcl.scene.inpainting.inpaint import DEFAULT, inpaint_background
from vestcl.scene.inpainting.inpainters import METHODS, Lama, inpainter
from vestcl.scene.inpainting.structure import structure_behind

HEIGHT, WIDTH = 96, 208
QUICK = [name for name in METHODS if name not in ("fsr", "biharmonic")]


def room() -> tuple[NDArray[Any], ...]:
    """A road, 1.5 m below the camera, up to a wall at 20 m; before them a box at 6 m. And both without the box."""
    focal = 0.6 * WIDTH
    rows = np.arange(HEIGHT)[:, None] + 0.5 - HEIGHT / 2
    road = np.where(rows > 0, focal * 1.5 / np.maximum(rows, 0.5), np.inf)
    depth = np.broadcast_to(np.minimum(road, 20), (HEIGHT, WIDTH)).astype(np.float32)[None]
    image = np.where(depth < 20, np.float32([[[0.3]], [[0.3]], [[0.3]]]), np.float32([[[0.8]], [[0.6]], [[0.4]]]))
    mask = np.ones((1, HEIGHT, WIDTH), bool)
    mask[0, 30:78, 80:120] = False
    shown = np.where(mask, image, np.float32([[[0]], [[0]], [[1]]]))
    return shown, np.where(mask, depth, np.float32(6)), mask, image, depth


@pytest.mark.parametrize("method", METHODS)
def test_every_method_fills_and_leaves_no_ghost(method: str) -> None:
    image, depth, mask, true_image, _ = room()
    filled, _ = inpaint_background(image, depth, mask, method=method)
    assert filled.shape == image.shape and filled.dtype == np.float32 and np.isfinite(filled).all()
    assert np.array_equal(filled[:, mask[0]], image[:, mask[0]])
    hidden = filled[:, ~mask[0]]
    assert np.abs(hidden - true_image[:, ~mask[0]]).mean() < 0.12
    assert hidden[2].max() < 0.95  # the box is blue


def test_the_default_puts_road_below_and_wall_above() -> None:
    image, depth, mask, true_image, true_depth = room()
    filled, behind = inpaint_background(image, depth, mask)
    assert np.abs(filled - true_image).max() < 0.05
    assert np.abs(behind / true_depth - 1)[0][~mask[0]].max() < 0.05


def test_nothing_hidden_is_nearer_than_what_hides_it() -> None:
    image, depth, mask, *_ = room()
    depth = np.where(mask, depth, np.float32(50))  # a foreground that is farther than all around it
    _, behind = inpaint_background(image, depth, mask)
    assert np.array_equal(behind[~mask], (np.float32(1.01) * depth)[~mask])
    assert np.array_equal(behind[mask], depth[mask])


def test_no_foreground_gives_the_arguments_back() -> None:
    image, depth, mask, *_ = room()
    filled, behind = inpaint_background(image, depth, np.ones_like(mask))
    assert filled is image and behind is depth


def test_all_foreground_is_defined() -> None:
    image, depth, mask, *_ = room()
    filled, behind = inpaint_background(image, depth, np.zeros_like(mask))
    assert np.array_equal(filled, image)
    np.testing.assert_allclose(behind, 1.01 * depth, rtol=1e-6)


def test_a_rim_that_leaves_nothing_is_given_up() -> None:
    image, depth, mask, *_ = room()
    mask = np.zeros_like(mask)
    mask[:, :, :3] = True
    filled, behind = inpaint_background(image, depth, mask)
    assert np.isfinite(filled).all() and (behind > 0).all()


def test_the_rim_is_not_taken_for_background() -> None:
    image, depth, mask, *_ = room()
    image = image.copy()
    image[:, 28:80, 78:122] = np.float32([0, 0, 1])[:, None, None]  # two pixels of blur around the box
    inside = np.zeros_like(mask)
    inside[0, 40:70, 90:110] = True
    ghost = inpaint_background(image, depth, mask, dilate=0)[0][2][inside[0]]
    clean = inpaint_background(image, depth, mask)[0][2][inside[0]]
    assert clean.max() < 0.5 and ghost.mean() > clean.mean() + 0.1


@pytest.mark.parametrize(("width", "radius"), [(832, 10), (1024, 12), (416, 5)])
def test_holes_are_dilated_by_ten_pixels_at_832_columns(width: int, radius: int) -> None:
    """And in proportion at other widths."""
    mask, seen = np.ones((1, 64, width), bool), []
    mask[0, 30:34, 100:104] = False

    def fill(image: np.ndarray, hole: np.ndarray, road: np.ndarray) -> np.ndarray:
        seen.append(hole[0])
        return image

    inpaint_background(np.zeros((3, 64, width), np.float32), np.full((1, 64, width), 9, np.float32), mask, method=fill)
    rows, columns = seen[0].nonzero()
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (
        30 - radius, 33 + radius, 100 - radius, 103 + radius,
    )  # fmt: skip


def test_the_sky_stays_the_sky() -> None:
    image, depth, mask, *_ = room()
    depth = np.where(np.arange(HEIGHT)[None, :, None] < 20, np.float32(10_000), depth)
    mask = mask.copy()
    mask[0, 5:30, 80:120] = False
    _, behind = inpaint_background(image, np.where(mask, depth, np.float32(6)), mask)
    assert behind[0, 10, 100] == pytest.approx(10_000, rel=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": 0.0}, "`depth` must have a valid pixel"),
        ({"image": np.nan}, "`image` must be finite"),
        ({"dilate": -1}, "`dilate` must be 0 px or more"),
        ({"method": "magic"}, "`method` must be one of regions"),
        ({"method": "lama:nowhere.pt"}, "no such file"),
    ],
)
def test_bad_arguments(change: dict[str, Any], message: str) -> None:
    image, depth, mask, *_ = room()
    arguments = {"image": image, "depth": depth, "mask": mask, "dilate": None, "method": None}
    for name, value in change.items():
        whole = arguments[name]
        arguments[name] = np.full_like(whole, value) if isinstance(whole, np.ndarray) else value
    with pytest.raises(ValueError, match=message):
        inpaint_background(
            arguments["image"],
            arguments["depth"],
            arguments["mask"],
            dilate=arguments["dilate"],
            method=arguments["method"],
        )


def test_a_pixel_without_depth_is_refused() -> None:
    image, depth, mask, *_ = room()
    depth = depth.copy()
    depth[0, 0, 0] = 0
    with pytest.raises(ValueError, match="above 0 m everywhere, got 1 pixels"):
        inpaint_background(image, depth, mask)


class _Mean(torch.nn.Module):
    """Stands in for LaMa: paints the mean of what is known. Refuses sizes that LaMa refuses."""

    def forward(self, image: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        assert image.shape[2] % 8 == 0 and image.shape[3] % 8 == 0
        known = 1 - mask
        mean = (image * known).sum(dim=(2, 3), keepdim=True) / known.sum(dim=(2, 3), keepdim=True)
        return image * known + mean * mask


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_lama_from_a_file(tmp_path: Path) -> None:
    torch.jit.script(_Mean()).save(str(tmp_path / "big-lama.pt"))
    image, depth, mask, *_ = (array[..., :90, :201] for array in room())
    filled, _ = inpaint_background(image, depth, mask, method=f"lama:{tmp_path / 'big-lama.pt'}")
    assert filled.shape == (3, 90, 201)
    hidden = filled[:, ~mask[0]]
    assert np.ptp(hidden, axis=1).max() < 1e-6 and 0.3 < hidden[0, 0] < 0.8


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_a_file_that_is_no_lama(tmp_path: Path) -> None:
    (tmp_path / "big-lama.pt").write_bytes(b"no weights")
    with pytest.raises(ValueError, match="is not a TorchScript module"):
        Lama(tmp_path / "big-lama.pt")


def test_an_inpainter_from_the_user() -> None:
    image, depth, mask, *_ = room()
    filled, _ = inpaint_background(image, depth, mask, method=lambda colour, hole, road: np.zeros_like(colour))
    assert (filled[:, ~mask[0]] == 0).all()
    assert inpainter(METHODS["telea"]) is METHODS["telea"]


def test_structure_without_a_road_still_has_walls() -> None:
    inverse = np.full((1, HEIGHT, WIDTH), 1 / 15, np.float32)
    hole = np.zeros((1, HEIGHT, WIDTH), bool)
    hole[0, 40:60, 100:120] = True
    behind = structure_behind(inverse, hole)
    np.testing.assert_allclose(behind.inverse, 1 / 15, rtol=1e-6)
    assert not behind.road.any()


def test_streets_default_is_no_worse_than_the_other_quick_ones() -> None:
    """What the README's table says, on two streets: mean squared error over the hidden pixels."""
    errors = dict.fromkeys(QUICK, 0.0)
    for seed in (3, 4):
        image, depth, mask, truth, _ = street(seed, 128, 416)
        for method in QUICK:
            filled, _ = inpaint_background(image, depth, mask, method=method)
            errors[method] += float(np.square(filled - truth)[:, ~mask[0]].mean())
    assert errors[DEFAULT] <= 1.02 * min(errors.values())


def test_same_bits_twice() -> None:
    image, depth, mask, *_ = street(5, 64, 208)
    first, second = (inpaint_background(image, depth, mask) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
