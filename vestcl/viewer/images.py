"""What the viewer sends to the browser: images in a colour mode, panels, and files."""

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.forecasting.future import visible_points
from vestcl.forecasting.result import Rendered
from vestcl.io.contact_sheet import depth_map, grey, heat, rgb
from vestcl.io.exr import ExrFrame, write_exr_frame
from vestcl.io.images import write_pixels
from vestcl.io.ply import write_ply
from vestcl.io.video.writing import write_mp4

Pixels = NDArray[np.uint8]

#: What the image shows.
COLOURS: Final = ("colour", "depth", "coverage", "motion")
Colour = Literal["colour", "depth", "coverage", "motion"]

#: Metres per interval that are white where motion is shown.
_FASTEST: Final = 3.0

#: Px, of a panel's image.
_PANEL: Final = 480


def pixels_of(rendered: Rendered, colour: str) -> Pixels:
    """[H, W, 3] RGB of a view: its colour, depth, coverage, or the length of its 3D motion.

    Args:
        rendered: the view.
        colour: one of `COLOURS`.
    """
    if colour == "depth":
        return depth_map(rendered.depth)
    if colour == "coverage":
        return grey(rendered.coverage)
    if colour == "motion":
        return heat(np.linalg.norm(rendered.motion_xyz, axis=0, keepdims=True), _FASTEST)
    return rgb(rendered.image)


def panels(rendered: Rendered, truth: NDArray[np.float32] | None) -> dict[str, Pixels]:
    """The panels' images by name: truth and error are black where there is no truth.

    Args:
        rendered: in the source camera.
        truth: [3, H, W], the true frame.
    """
    black = np.zeros_like(rendered.image[:1])
    error = black if truth is None else np.abs(rendered.image - truth).mean(0, keepdims=True)
    found = {
        "truth": rgb(np.zeros_like(rendered.image) if truth is None else truth),
        "error": heat(error),
        "depth": depth_map(rendered.depth),
        "coverage": grey(rendered.coverage),
    }
    return {name: _shrunk(image) for name, image in found.items()}


def _shrunk(image: Pixels) -> Pixels:
    height, width, _ = image.shape
    if width <= _PANEL:
        return image
    size = (_PANEL, max(round(height * _PANEL / width), 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def file_of(rendered: Rendered, K: NDArray[np.float64], suffix: str) -> bytes:
    """A view as a file's content.

    Args:
        rendered: the view.
        K: [3, 3] px, of the view.
        suffix: ".png", ".exr" (colour, depth, coverage, motion), or ".ply" (its points in its camera's axes).
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"view{suffix}"
        if suffix == ".png":
            write_pixels(path, rgb(rendered.image))
        elif suffix == ".exr":
            write_exr_frame(path, ExrFrame(rendered.image, rendered.depth, rendered.coverage, rendered.motion_xyz))
        else:
            write_ply(path, *visible_points(rendered.image, rendered.depth, K))
        return path.read_bytes()


def video_of(images: Iterable[Pixels], fps: float, pixel_aspect: float) -> bytes:
    """An MP4's content; arguments as of `vestcl.io.video.writing.write_mp4`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "path.mp4"
        write_mp4(path, images, fps, pixel_aspect=pixel_aspect)
        return path.read_bytes()
