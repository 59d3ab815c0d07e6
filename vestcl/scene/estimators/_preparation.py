"""From an image to a network's input: reflected edges, another size, other units."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch.nn import functional

#: Height and width from which ZoeDepth's padding, 3 sqrt(size / 2), is less than the size, as a reflection must be.
SMALLEST: Final = 5

#: How far outside [0, 1] an image may be: rounding after a resize, but not an image in 0 ... 255.
_SLACK: Final = 1e-3

#: Pillow's numbers for its filters.
_FILTERS: Final = {2: "bilinear", 3: "bicubic"}

#: Padding by ZoeDepth's protocol: This many times sqrt(size / 2) on either side.
_PADDING: Final = 3

#: What images are in for image processors, which rescale them to [0, 1].
_WHITE: Final = 255

Fit = Literal["exact", "nearest", "within"]
"""``size`` itself; the image's proportions, as tall or as wide as ``size``, whichever changes the image less; or
the image's proportions with a short side of size[0] and a long side of no more than size[1]."""


@dataclass(frozen=True)
class Preparation:
    """(gain x - mean) / std of the resized image x in [0, 1]."""

    size: tuple[int, int]
    """(height, width), or (short side, long side) where ``fit`` is "within"."""
    fit: Fit
    multiple: int
    """Both sides become multiples of it."""
    round_up: bool
    """Whether to the next multiple, not to the nearest."""
    mode: str
    """Mode of torch's interpolate."""
    gain: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    zoe: bool = False
    """Whether edges are reflected and corners aligned."""

    @classmethod
    def read(cls, name: str, config: Mapping[str, Any], *, zoe: bool, size: tuple[int, int] | None) -> "Preparation":
        """The content of preprocessor_config.json.

        Args:
            name: of the checkpoint, for messages.
            config: the file's object.
            zoe: whether it is ZoeDepth's.
            size: (height, width) px instead of the file's.

        Raises:
            ValueError: a key is missing or has a value that no network here is published with.
        """
        missing = [key for key in ("size", "image_mean", "image_std", "resample") if key not in config]
        if missing:
            raise ValueError(f"{name}: preprocessor_config.json must have {missing[0]}, got {', '.join(config)}")
        if config["resample"] not in _FILTERS:
            wanted = "2 (bilinear) or 3 (bicubic)"
            raise ValueError(f"{name}: resample must be {wanted}, got {config['resample']}")
        if size is not None and not all(isinstance(side, int) and side > 0 for side in size):
            raise ValueError(f"`size` must be (height, width) in px, got {size}")
        wanted_size, fit = _size(name, config) if size is None else (size, "exact")
        divisor = int(config.get("size_divisor") or 0)
        normalised = config.get("do_normalize", True)
        return cls(
            wanted_size, fit, divisor or max(1, int(config.get("ensure_multiple_of") or 1)), divisor > 0,
            _FILTERS[config["resample"]],
            _WHITE * config.get("rescale_factor", 1 / _WHITE) if config.get("do_rescale", True) else float(_WHITE),
            tuple(config["image_mean"]) if normalised else (0.0, 0.0, 0.0),
            tuple(config["image_std"]) if normalised else (1.0, 1.0, 1.0),
            zoe=zoe and config.get("do_pad", True),
        )  # fmt: skip

    def padding(self, height: int, width: int) -> tuple[int, int]:
        """Rows above and below, columns left and right that are reflected, px."""
        if not self.zoe:
            return 0, 0
        return int(math.sqrt(height / 2) * _PADDING), int(math.sqrt(width / 2) * _PADDING)

    def network_size(self, height: int, width: int) -> tuple[int, int]:
        """(height, width) at which the network sees an image, px."""
        scaled: tuple[float, float] = self.size
        if self.fit == "within":
            short, long = self.size
            factor = min(short / min(height, width), long / max(height, width))
            scaled = float(int(round(height * factor, 6))), float(int(round(width * factor, 6)))
        elif self.fit == "nearest":
            factor = min(self.size[0] / height, self.size[1] / width, key=lambda value: abs(1 - value))
            scaled = height * factor, width * factor
        whole = math.ceil if self.round_up else round
        rows, columns = (max(1, whole(side / self.multiple)) * self.multiple for side in scaled)
        return rows, columns

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        """What the network sees.

        Args:
            images: [B, 3, H, W] RGB in [0, 1], H and W of SMALLEST or more.

        Returns:
            [B, 3, h, w] with (h, w) = network_size of the padded image.
        """
        rows, columns = self.padding(*images.shape[-2:])
        if rows or columns:
            images = functional.pad(images, (columns, columns, rows, rows), mode="reflect")
        size = self.network_size(*images.shape[-2:])
        if size != tuple(images.shape[-2:]):  # ZoeDepth's protocol aligns corners, Pillow averages where it shrinks
            images = functional.interpolate(
                images, size, mode=self.mode, align_corners=self.zoe, antialias=not self.zoe
            )
        mean, std = (images.new_tensor(values).view(-1, 1, 1) for values in (self.mean, self.std))
        return (images.clamp(0, 1) * self.gain - mean) / std


def image_array(images: ArrayLike) -> NDArray[np.float32]:
    """``images`` as [B, 3, H, W] float32.

    Raises:
        ValueError: another shape, images of less than SMALLEST px, or numbers outside [0, 1], NaN included.
    """
    array = np.asarray(images)
    if array.ndim != 4 or array.shape[1] != 3 or not len(array) or min(array.shape[2:]) < SMALLEST:
        wanted = f"[B, 3, H, W] with H and W of {SMALLEST} or more"
        raise ValueError(f"`images` must be {wanted}, got {list(array.shape)}")
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"`images` must be floating-point numbers in [0, 1], got {array.dtype}")
    if not (array.min() >= -_SLACK and array.max() <= 1 + _SLACK):
        raise ValueError(f"`images` must be in [0, 1], got {array.min():g} to {array.max():g}")
    return np.ascontiguousarray(array, np.float32)


def one_image(image: ArrayLike) -> NDArray[np.float32]:
    """``image`` as [1, 3, H, W] float32.

    Raises:
        ValueError: another shape than [3, H, W], or as `images`.
    """
    array = np.asarray(image)
    if array.ndim != 3:
        raise ValueError(f"`image` must be [3, H, W], got {list(array.shape)}")
    return image_array(array[None])


def _size(name: str, config: Mapping[str, Any]) -> tuple[tuple[int, int], Fit]:
    size = config["size"]
    if isinstance(size, int) and not isinstance(size, bool):  # before transformers 4.26
        longest = config.get("max_size")
        return ((size, size), "exact") if longest is None else ((size, longest), "within")
    if isinstance(size, dict) and {"height", "width"} <= size.keys():
        return (size["height"], size["width"]), "nearest" if config.get("keep_aspect_ratio") else "exact"
    if isinstance(size, dict) and {"shortest_edge", "longest_edge"} <= size.keys():
        return (size["shortest_edge"], size["longest_edge"]), "within"
    raise ValueError(f"{name}: size must have height and width, or shortest_edge and longest_edge, got {size}")
