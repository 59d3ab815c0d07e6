"""Ways to fill holes of an image, by name: OpenCV's, scikit-image's, LaMa, and our own."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from vestcl.scene import checked
from vestcl.scene.inpainting.holes import push_pull

#: Radius of the surroundings that OpenCV's methods look at, px.
_RADIUS: Final = 5

#: Frequency-selective and biharmonic filling take seconds for 10,000 pixels: holes are solved in images of at most
#: that height, and enlarged.
_SLOW_HEIGHT: Final = 96

#: LaMa's network halves the size three times.
_LAMA_MULTIPLE: Final = 8


class Inpainter(Protocol):
    """Fills holes of an image from what surrounds them."""

    def __call__(
        self, colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """``colour`` [3, H, W] in [0, 1] with ``hole`` [1, H, W] filled.

        ``road`` [1, H, W] is True where the road's plane is seen or, in the hole, would be; a method may ignore it.
        """


def regions(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Push and pull, the road from the road only and the static objects on it from the rest."""
    filled = colour
    for part in (road, ~road):
        known = part & ~hole
        filled = np.where(hole & part, push_pull(colour, (known if known.any() else ~hole)[0]), filled)
    return filled


def pushed(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Push and pull from all sides (Gortler et al., The Lumigraph, 1996)."""
    return push_pull(colour, ~hole[0])


def telea(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Fast marching (Telea, 2004)."""
    return _planes(cv2.inpaint(checked.pixels(colour), hole[0].astype(np.uint8), _RADIUS, cv2.INPAINT_TELEA))


def navier_stokes(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Isophotes continued (Bertalmio et al., Navier-Stokes, Fluid Dynamics, and Image and Video Inpainting, 2001)."""
    return _planes(cv2.inpaint(checked.pixels(colour), hole[0].astype(np.uint8), _RADIUS, cv2.INPAINT_NS))


def frequency_selective(
    colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Frequency-selective reconstruction, "fast" (Genser et al., 2018), at a reduced size."""

    def solve(small: NDArray[np.float32], gap: NDArray[np.bool_]) -> NDArray[np.float32]:
        filled = np.zeros((*gap.shape, 3), np.uint8)
        cv2.xphoto.inpaint(checked.pixels(small), (~gap).astype(np.uint8) * 255, filled, cv2.xphoto.INPAINT_FSR_FAST)
        return _planes(filled)

    return _reduced(colour, hole, solve)


def biharmonic(colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The biharmonic equation (Chui and Mhaskar, 2010), at a reduced size."""
    from skimage.restoration import inpaint_biharmonic  # loads SciPy's sparse solvers

    def solve(small: NDArray[np.float32], gap: NDArray[np.bool_]) -> NDArray[np.float32]:
        filled = inpaint_biharmonic(small.transpose(1, 2, 0), gap, split_into_regions=True, channel_axis=-1)
        return np.asarray(filled, np.float32).transpose(2, 0, 1).clip(0, 1)

    return _reduced(colour, hole, solve)


class Lama:
    """LaMa (Suvorov et al., Resolution-robust Large Mask Inpainting, 2022) from a TorchScript file, big-lama.pt.

    The module takes image [1, 3, H, W] in [0, 1] and mask [1, 1, H, W] of 0 and 1 = to fill, and gives the image.
    """

    def __init__(self, path: str | Path) -> None:
        """Load ``path``.

        Raises:
            ValueError: no such file, or no TorchScript module.
        """
        if not Path(path).is_file():
            raise ValueError(f"{path}: no such file; LaMa's weights are a TorchScript export called big-lama.pt")
        try:
            self._module = torch.jit.load(str(path), map_location="cpu").eval()
        except RuntimeError as error:
            raise ValueError(f"{path}: is not a TorchScript module ({str(error).splitlines()[0]})") from error

    def __call__(
        self, colour: NDArray[np.float32], hole: NDArray[np.bool_], road: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """As `Inpainter`.

        Raises:
            ValueError: the module gives another shape than LaMa does.
        """
        below, right = (-size % _LAMA_MULTIPLE for size in colour.shape[1:])
        planes = [torch.from_numpy(np.ascontiguousarray(array, np.float32))[None] for array in (colour, hole)]
        image, mask = (functional.pad(plane, (0, right, 0, below), mode="replicate") for plane in planes)
        with torch.inference_mode():
            filled = self._module(image, (mask > 0).float())
        if filled.shape != image.shape:
            raise ValueError(f"LaMa must give {list(image.shape)}, got {list(filled.shape)}")
        return filled[0, :, : colour.shape[1], : colour.shape[2]].clamp(0, 1).numpy()


#: What begins the name of LaMa with its file.
LAMA: Final = "lama:"

#: By name; "lama:PATH" is one more.
METHODS: Final[Mapping[str, Inpainter]] = MappingProxyType(
    {
        "regions": regions,
        "push-pull": pushed,
        "telea": telea,
        "ns": navier_stokes,
        "fsr": frequency_selective,
        "biharmonic": biharmonic,
    }
)


def inpainter(method: str | Inpainter, argument: str = "method") -> Inpainter:
    """A method by name, or itself.

    Args:
        method: a name of METHODS, "lama:PATH", or a function.
        argument: what messages call it.

    Raises:
        ValueError: no such name, or LaMa's file can't be loaded.
    """
    if not isinstance(method, str):
        return method
    if method.startswith(LAMA):
        return Lama(method.removeprefix(LAMA))
    if method not in METHODS:
        raise ValueError(f"`{argument}` must be one of {', '.join(METHODS)} or lama:PATH, got {method!r}")
    return METHODS[method]


def _planes(pixels: object) -> NDArray[np.float32]:
    return np.ascontiguousarray(np.asarray(pixels, np.float32).transpose(2, 0, 1)) / np.float32(255)


def _reduced(
    colour: NDArray[np.float32],
    hole: NDArray[np.bool_],
    solve: Callable[[NDArray[np.float32], NDArray[np.bool_]], NDArray[np.float32]],
) -> NDArray[np.float32]:
    """The holes of ``colour`` from the solution of an image that is no higher than _SLOW_HEIGHT."""
    height, width = hole.shape[1:]
    scale = min(1.0, _SLOW_HEIGHT / height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    filled_image = push_pull(colour, ~hole[0]).transpose(1, 2, 0)
    small = cv2.resize(filled_image, size, interpolation=cv2.INTER_AREA).transpose(2, 0, 1)
    gap = np.asarray(cv2.resize(hole[0].astype(np.float32), size, interpolation=cv2.INTER_AREA)) > 0
    solved = solve(np.ascontiguousarray(small, np.float32), gap).transpose(1, 2, 0)
    return np.where(
        hole, cv2.resize(solved, (width, height), interpolation=cv2.INTER_LINEAR).transpose(2, 0, 1), colour
    )
