"""Colour maps by their ends and their order, sheets by where objects lie."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import matplotlib
import numpy as np
import pytest

from vestcl.forecasting.result import Rendered
from vestcl.forecasting.sheets import forecast_sheet
from vestcl.io import contact_sheet as sheet
from vestcl.io.contact_sheet import Cell


def colour(name: str, value: float) -> list[int]:
    return [round(255 * part) for part in matplotlib.colormaps[name](value)[:3]]


def plain(height: int, width: int, *rgb: int) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.uint8), (height, width, 3))


def test_rgb_and_grey() -> None:
    image = np.array([0.0, 0.5, 2.0], np.float32).reshape(3, 1, 1)
    assert sheet.rgb(image).tolist() == [[[0, 128, 255]]]
    assert sheet.grey(image[1:2]).tolist() == [[[128, 128, 128]]]


def test_depth_by_its_inverse() -> None:
    middle = 1 / (1 / sheet.FAR + 0.502 * (1 / sheet.NEAR - 1 / sheet.FAR))
    shown = sheet.depth_map(np.array([[[sheet.NEAR, middle, sheet.FAR, 1.0, 1e4, 0.0, -1.0, np.inf]]], np.float32))[0]
    near, far = colour("turbo", 1.0), colour("turbo", 0.0)
    assert shown[:5].tolist() == [near, colour("turbo", 0.502), far, near, far]
    assert not shown[5:].any()


def test_heat_is_brighter_for_more_error() -> None:
    shown = sheet.heat(np.linspace(0, 0.5, 11, dtype=np.float32).reshape(1, 1, 11), worst=0.5)[0]
    assert shown[0].tolist() == colour("inferno", 0.0)
    assert shown[-1].tolist() == colour("inferno", 1.0)
    assert (np.diff(shown.astype(float) @ [0.2126, 0.7152, 0.0722]) > 0).all()
    assert np.array_equal(sheet.heat(np.ones((1, 1, 1)), worst=0.5)[0, 0], shown[-1])


def test_scale_bar_runs_from_low_to_high() -> None:
    bar = sheet.scale_bar(300, "0", "0.25 and more")
    assert bar.shape[1] == 300
    middle = bar[bar.shape[0] // 2]
    ramp = [tuple(pixel) for pixel in middle.tolist()]
    start, end = ramp.index(tuple(colour("inferno", 0.0))), ramp.index(tuple(colour("inferno", 1.0)))
    assert 0 < start < end < 299
    assert (bar[0] == sheet.PAPER).all()


def test_cells_lie_in_rows_and_columns() -> None:
    red, green, blue = plain(20, 30, 255, 0, 0), plain(20, 40, 0, 255, 0), plain(10, 30, 0, 0, 255)
    made = sheet.sheet([[Cell(red, "red"), Cell(green)], [Cell(blue), None]])
    line, gap = 24, 6
    assert made.shape == (2 * line + 20 + gap + 10, 30 + gap + 40, 3)
    assert np.array_equal(made[line : line + 20, :30], red)
    assert np.array_equal(made[line : line + 20, 36:], green)
    assert np.array_equal(made[2 * line + 26 :, :30], blue)
    assert (made[line + 20 :, 36:] == sheet.PAPER).all()
    assert (made[:line, :30] < 128).any()  # a label
    assert (made[:line, 36:] == sheet.PAPER).all()  # none


def test_title_and_bar_take_a_line_each() -> None:
    cell = Cell(plain(20, 300, 9, 9, 9))
    bare, titled = sheet.sheet([[cell]]), sheet.sheet([[cell]], title="street", bar=("0", "1"))
    assert titled.shape == (bare.shape[0] + 24 + 24 + 6, 300, 3)
    assert (titled[:24] < 128).any()
    assert np.array_equal(titled[24 : 24 + bare.shape[0]], bare)
    assert np.array_equal(titled[-24:], sheet.scale_bar(300, "0", "1"))


def test_a_bar_wider_than_its_images_widens_the_sheet() -> None:
    red = plain(20, 30, 255, 0, 0)
    shown = sheet.sheet([[Cell(red)]], bar=("none", "as much as can be"))
    assert shown.shape[1] > 200
    assert np.array_equal(shown[24:44, :30], red)
    assert (shown[24:44, 30:] == sheet.PAPER).all()


def test_sheet_of_a_forecast() -> None:
    depth = np.full((1, 20, 200), sheet.NEAR, np.float32)
    seen = np.ones((1, 20, 200), np.float32)
    image = np.full((3, 20, 200), 0.2, np.float32)
    frame = Rendered(image, depth, seen, 0 * image)
    shown = forecast_sheet([frame, replace(frame, image=image + 0.6)], "street")
    line, gap = 24, 6
    assert shown.shape == (line + 2 * (line + 20) + gap + gap + line, 3 * 200 + 2 * gap, 3)
    first, second = shown[2 * line : 2 * line + 20], shown[3 * line + 20 + gap : 3 * line + 40 + gap]
    assert (first[:, :200] == 51).all() and (second[:, :200] == 204).all()
    for row in (first, second):
        assert (row[:, 206:406] == colour("turbo", 1.0)).all()
        assert (row[:, 412:] == 255).all()
    ramp = {tuple(pixel) for pixel in shown[-line // 2].tolist()}
    assert {tuple(colour("turbo", 0.0)), tuple(colour("turbo", 1.0))} <= ramp


def test_wide_images_shrink_by_the_mean() -> None:
    stripes = np.zeros((8, 40, 3), np.uint8)
    stripes[:, ::2] = 200
    shown = sheet.sheet([[Cell(stripes)]], cell_width=20)
    assert shown.shape == (24 + 4, 20, 3)
    assert (shown[24:] == 100).all()


def test_long_labels_stay_above_their_image() -> None:
    label = "a label that is much too long for so narrow an image"
    shown = sheet.sheet([[Cell(plain(9, 60, 1, 1, 1), label), Cell(plain(9, 60, 2, 2, 2))]])
    assert (shown[:24, :60] < 200).any()
    assert (shown[:24, 60:] == sheet.PAPER).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sheet.rgb(np.zeros((1, 2, 2))), r"`image` must be \[3, H, W\], got \[1, 2, 2\]"),
        (lambda: sheet.rgb(np.full((3, 2, 2), np.nan)), "`image` must not have NaN"),
        (lambda: sheet.grey(np.zeros((2, 2))), r"`values` must be \[1, H, W\], got \[2, 2\]"),
        (lambda: sheet.depth_map(np.zeros((3, 2, 2))), r"`depth` must be \[1, H, W\], got \[3, 2, 2\]"),
        (lambda: sheet.depth_map(np.ones((1, 2, 2)), near=5, far=5), "0 < near < far, got 5 and 5"),
        (lambda: sheet.heat(np.ones((1, 2, 2)), worst=0), "`worst` must be positive, got 0"),
        (lambda: sheet.heat(np.full((1, 2, 2), np.nan)), "`error` must not have NaN"),
        (lambda: sheet.scale_bar(20, "0", "much"), "`width` must be [0-9]+ or more for these words, got 20"),
        (lambda: sheet.scale_bar(200, "0", "1", "mud"), "`colours` must be .* got 'mud'"),
        (lambda: sheet.sheet([]), r"`rows` must be of one length and have an image, got lengths \[\]"),
        (lambda: sheet.sheet([[None]]), "have an image"),
        (lambda: sheet.sheet([[Cell(plain(1, 1, 0, 0, 0))], []]), r"got lengths \[0, 1\]"),
        (lambda: sheet.sheet([[Cell(plain(1, 1, 0, 0, 0))]], cell_width=0), "`cell_width` must be 1 or more, got 0"),
        (lambda: sheet.sheet([[Cell(cast(Any, np.zeros((2, 2, 3))))]]), r"uint8, got float64 \[2, 2, 3\]"),
    ],
)
def test_mistakes_are_reported(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
