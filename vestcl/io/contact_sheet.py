"""Images of images: colour maps for depth and error, and sheets of labelled images in rows and columns.

An image here is [H, W, 3] uint8 RGB, ready for `vestcl.io.write_pixels`.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import matplotlib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from vestcl.io.images import to_pixels

Picture = NDArray[np.uint8]
"""[H, W, 3] RGB."""

#: Depths are shown by their inverse, from this one (blue) to that one (red), metres: what lies in a street.
FAR: Final = 80.0
NEAR: Final = 4.0

#: The error, in a colour range of 0 to 1, that is drawn in the brightest colour: larger ones are plain to see anyway.
WORST_ERROR: Final = 0.25

#: Colour maps of matplotlib's. Both get lighter all the way or pass through all hues, so that they can be read back.
DEPTH_COLOURS: Final = "turbo"
ERROR_COLOURS: Final = "inferno"

#: Widest image of a sheet, px: five in a row still fit a screen of 2,560.
CELL_WIDTH: Final = 500

#: What images lie on: light, so that letters can be read, and not white, so that a white image shows its edge.
PAPER: Final = (232, 232, 232)

#: Letters and the strip they are in, px: legible where the sheet is shown at half its size.
_FONT_SIZE: Final = 17
_LINE: Final = 24
_GAP: Final = 6
_INDENT: Final = 4
#: A colour scale's strip, px, and the widest that it gets with its words: an eye takes it in at once.
_BAR_HEIGHT: Final = 14
_BAR_WIDTH: Final = 900
#: Its shortest strip, px: below, its colours can't be distinguished.
_BAR_SHORTEST: Final = 64


@dataclass(frozen=True, eq=False)
class Cell:
    """An image of a sheet and the line above it."""

    picture: Picture
    label: str = ""


def rgb(image: ArrayLike) -> Picture:
    """round(255 clip(image, 0, 1)).

    Args:
        image: [3, H, W] RGB, floating.

    Returns:
        [H, W, 3].

    Raises:
        ValueError: another shape, or NaN.
    """
    planes = np.asarray(image)
    if planes.ndim != 3 or len(planes) != 3:
        raise ValueError(f"`image` must be [3, H, W], got {list(planes.shape)}")
    return to_pixels(planes).astype(np.uint8, copy=False)


def grey(values: ArrayLike) -> Picture:
    """0 black, 1 white.

    Args:
        values: [1, H, W] in [0, 1]; what is outside is clipped.

    Returns:
        [H, W, 3].

    Raises:
        ValueError: another shape, or NaN.
    """
    plane = _plane("values", values)
    return rgb(np.broadcast_to(plane, (3, *plane.shape)))


def depth_map(depth: ArrayLike, near: float = NEAR, far: float = FAR) -> Picture:
    """turbo((1 / depth - 1 / far) / (1 / near - 1 / far)): near red, far blue, unknown black.

    Inverse depth, so that what is near differs most.

    Args:
        depth: [1, H, W] m; 0 and below, and what is not finite, is unknown.
        near: m, shown in the darkest red.
        far: m, shown in the darkest blue.

    Returns:
        [H, W, 3].

    Raises:
        ValueError: another shape, or not 0 < near < far.
    """
    if not 0 < near < far:
        raise ValueError(f"`near` and `far` must be 0 < near < far, got {near} and {far}")
    metres = _plane("depth", depth)
    known = np.isfinite(metres) & (metres > 0)
    inverse = 1 / np.where(known, metres, far)
    return _coloured((inverse - 1 / far) / (1 / near - 1 / far), DEPTH_COLOURS) * known[..., None].astype(np.uint8)


def heat(error: ArrayLike, worst: float = WORST_ERROR) -> Picture:
    """inferno(error / worst): 0 black, ``worst`` and more light yellow.

    Args:
        error: [1, H, W], 0 or more.
        worst: of the same unit, positive.

    Returns:
        [H, W, 3].

    Raises:
        ValueError: another shape, NaN, or ``worst`` not positive.
    """
    if not worst > 0:
        raise ValueError(f"`worst` must be positive, got {worst}")
    plane = _plane("error", error)
    if np.isnan(plane).any():
        raise ValueError("`error` must not have NaN")
    return _coloured(plane / worst, ERROR_COLOURS)


def scale_bar(width: int, low: str, high: str, colours: str = ERROR_COLOURS) -> Picture:
    """A strip of a colour map from left to right, with the words for its ends next to it.

    Args:
        width: px, of all of it.
        low: label at the colour of 0.
        high: label at the colour of 1.
        colours: a colour map of matplotlib's.

    Returns:
        [height, width, 3] on PAPER.

    Raises:
        ValueError: no space for the strip between the words, or no such colour map.
    """
    if colours not in matplotlib.colormaps:
        raise ValueError(f"`colours` must be a colour map of matplotlib's, got {colours!r}")
    left, right = _beside_bar(low), _beside_bar(high)
    width_left = width - left - right
    if width_left < _BAR_SHORTEST:
        raise ValueError(f"`width` must be {_narrowest_bar(low, high)} or more for these words, got {width}")
    canvas = Image.new("RGB", (width, _LINE), PAPER)
    draw = ImageDraw.Draw(canvas)
    draw.text((_GAP, _LINE / 2), low, fill="black", font=_font(), anchor="lm")
    draw.text((width - _GAP, _LINE / 2), high, fill="black", font=_font(), anchor="rm")
    ramp = np.broadcast_to(np.linspace(0, 1, width_left), (_BAR_HEIGHT, width_left))
    canvas.paste(Image.fromarray(_coloured(ramp, colours)), (left, (_LINE - _BAR_HEIGHT) // 2))
    return np.asarray(canvas)


def _narrowest_bar(low: str, high: str) -> int:
    return _beside_bar(low) + _BAR_SHORTEST + _beside_bar(high)


def _beside_bar(word: str) -> int:
    """Px."""
    return int(_font().getlength(word)) + 2 * _GAP


def sheet(
    rows: Sequence[Sequence[Cell | None]],
    *,
    title: str = "",
    bar: tuple[str, str] | tuple[str, str, str] | None = None,
    cell_width: int = CELL_WIDTH,
) -> Picture:
    """Rows of images on PAPER, each with its label above it.

    Args:
        rows: of one length; None leaves a place empty. Images of one column may differ in height.
        title: a line above all.
        bar: words for the ends of a colour scale below, and its colour map where that is not `heat`'s. Narrow images
            get PAPER next to them where it is wider.
        cell_width: px; wider images shrink to it (mean over area), narrower ones stay.

    Returns:
        [H, W, 3].

    Raises:
        ValueError: no image, rows of several lengths, an image of another shape or dtype, or ``cell_width`` below 1.
    """
    _check_rows(rows, cell_width)
    cells = [[None if cell is None else _shrunk(cell, cell_width) for cell in row] for row in rows]
    widths = [max((c.picture.shape[1] for c in column if c), default=0) for column in zip(*cells, strict=True)]
    heights = [max((c.picture.shape[0] for c in row if c), default=0) for row in cells]
    width = sum(widths) + _GAP * (len(widths) - 1)
    scale = (
        scale_bar(max(min(width, _BAR_WIDTH), _narrowest_bar(*bar[:2])), *bar) if bar else np.empty((0, 0, 3), np.uint8)
    )
    head, foot = (_LINE if title else 0), (len(scale) + _GAP if bar else 0)
    height = head + sum(heights) + _LINE * len(heights) + _GAP * (len(heights) - 1) + foot
    canvas = Image.new("RGB", (max(width, scale.shape[1]), height), PAPER)
    if title:
        _write(ImageDraw.Draw(canvas), 0, 0, title, canvas.width)
    _draw(canvas, head, cells, widths, heights)
    if bar:
        canvas.paste(Image.fromarray(scale), (0, height - len(scale)))
    return np.array(canvas)


def _draw(canvas: Image.Image, y: int, cells: list[list[Cell | None]], widths: list[int], heights: list[int]) -> None:
    """The cells from row ``y`` of the canvas on."""
    draw = ImageDraw.Draw(canvas)
    for row, row_height in zip(cells, heights, strict=True):
        x = 0
        for cell, column_width in zip(row, widths, strict=True):
            if cell is not None:
                _write(draw, x, y, cell.label, column_width)
                canvas.paste(Image.fromarray(cell.picture), (x, y + _LINE))
            x += column_width + _GAP
        y += _LINE + row_height + _GAP


def _check_rows(rows: Sequence[Sequence[Cell | None]], cell_width: int) -> None:
    lengths = sorted({len(row) for row in rows})
    if len(lengths) != 1 or not any(cell for row in rows for cell in row):
        raise ValueError(f"`rows` must be of one length and have an image, got lengths {lengths}")
    if cell_width < 1:
        raise ValueError(f"`cell_width` must be 1 or more, got {cell_width}")
    for picture in (cell.picture for row in rows for cell in row if cell):
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or not picture.size:
            got = f"{picture.dtype} {list(picture.shape)}"
            raise ValueError(f"`rows` must have images [H, W, 3] uint8, got {got}")


def _shrunk(cell: Cell, width: int) -> Cell:
    height, old, _ = cell.picture.shape
    if old <= width:
        return cell
    size = (width, max(1, round(height * width / old)))
    return Cell(np.asarray(Image.fromarray(cell.picture).resize(size, Image.Resampling.BOX)), cell.label)


def _write(draw: ImageDraw.ImageDraw, x: int, y: int, text: str, width: int) -> None:
    """A line of text, its letters shrunk where the strip is too narrow for them."""
    wanted = _font().getlength(text) + 2 * _INDENT
    size = _FONT_SIZE if wanted <= width else max(1, int(_FONT_SIZE * width / wanted))
    draw.text((x + _INDENT, y + _LINE / 2), text, fill="black", font=_font(size), anchor="lm")


def _font(size: int = _FONT_SIZE) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)


def _coloured(values: NDArray[np.floating], colours: str) -> Picture:
    """[H, W], clipped to [0, 1], to [H, W, 3] by a colour map of matplotlib's."""
    table = _table(colours)
    levels = (values.clip(0, 1) * np.float32(len(table))).astype(np.intp)
    return table.take(levels, axis=0, mode="clip")


@functools.cache
def _table(colours: str) -> NDArray[np.uint8]:
    """[256, 3], the colours of one of matplotlib's maps."""
    colour_map = matplotlib.colormaps[colours]
    return np.rint(colour_map(np.arange(colour_map.N))[:, :3] * 255).astype(np.uint8)


def _plane(name: str, value: ArrayLike) -> NDArray[np.floating]:
    planes = np.asarray(value)
    if planes.ndim != 3 or len(planes) != 1 or not planes.size:
        raise ValueError(f"`{name}` must be [1, H, W], got {list(planes.shape)}")
    return planes[0].astype(np.result_type(planes, np.float32), copy=False)
