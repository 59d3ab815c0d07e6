"""Depth and classes of an image by an ONNX file, through OpenCV's DNN module."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vestcl.scene.estimators._class_tables import of_movable, to_train_ids
from vestcl.scene.estimators._onnx_file import read_onnx
from vestcl.scene.estimators._onnx_json import Description, network_of, read_description
from vestcl.scene.estimators._onnx_network import OnnxNetwork
from vestcl.scene.estimators._preparation import one_image
from vestcl.scene.estimators.depth import NEAREST

#: Metres. What a disparity of 0 or less becomes, and a larger depth: nothing but the sky is farther.
FARTHEST: Final = 500.0

#: Share of the largest inverse depth that a network without a unit gives, and no smaller one is used.
_SMALLEST: Final = 1e-4

#: Metres that the median of a depth without a unit is brought to.
_MEDIAN: Final = 10.0

_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class OnnxDepth:
    """Depth of an image; `load` makes one."""

    network: OnnxNetwork

    @classmethod
    def load(cls, path: str | Path) -> "OnnxDepth":
        """Open an ONNX file, with the JSON of the same stem next to it if there is one, and run it once.

        Args:
            path: NETWORK.onnx, or the JSON. `vestcl.scene.estimators._onnx_json` lists its keys; without one the output
                is taken as metres, of RGB in 0 to 1 stretched to the input's size, and that is logged.

        Raises:
            ValueError: no such file, no ONNX, dynamic axes, a layer that OpenCV does not have, a JSON with an unknown
                key, or an output that is not a depth map; the message names the remedy.

        Source: SPEC, "Estimators by file".
        """
        network = OnnxNetwork.load(_described(path, "depth"))
        _plane(network, np.zeros(network.output_shape, np.float32))
        return cls(network)

    @property
    def metric(self) -> bool:
        """Whether the depth is in metres; else 1/z is a v + b with a and b unknown, and the median of z is 10."""
        return self.network.description.meaning != "inverse_depth"

    def __call__(self, image: ArrayLike) -> NDArray[np.float32]:
        """Depth of one image.

        Args:
            image: [3, H, W] RGB in [0, 1].

        Returns:
            [1, H, W] m, finite, 0.1 to 500.

        Raises:
            ValueError: another shape, numbers outside [0, 1], or a network that answers with NaN.
        """
        frame, settings = one_image(image)[0], self.network.description
        values = _plane(self.network, self.network.run(frame))
        if not np.isfinite(values).all():
            raise ValueError(f"{settings.path}: must give finite depths, got NaN or infinity")
        values = self.network.at_size_of(frame, values)
        if settings.meaning == "depth_m":
            depth = values * np.float32(settings.metres)
        elif settings.meaning == "disparity":
            depth = settings.metres / np.maximum(values + np.float32(settings.offset), settings.metres / FARTHEST)
        else:
            depth = 1 / np.maximum(values, max(_SMALLEST * float(values.max()), 1e-9))
            depth *= _MEDIAN / np.median(depth)
        return np.clip(depth, NEAREST, FARTHEST).astype(np.float32)


@dataclass(frozen=True, eq=False)
class OnnxSegmentation:
    """Cityscapes train ids of an image; `load` makes one."""

    network: OnnxNetwork
    table: tuple[int, ...]
    """Train id of each class of the network."""

    @classmethod
    def load(cls, path: str | Path) -> "OnnxSegmentation":
        """Open an ONNX file, with the JSON of the same stem next to it if there is one, and run it once.

        Args:
            path: NETWORK.onnx, or the JSON. `vestcl.scene.estimators._onnx_json` lists its keys; without one the output
                is taken as scores of Cityscapes' 19 train ids, of RGB normalised as ImageNet's and stretched to the
                input's size, and that is logged.

        Raises:
            ValueError: as `OnnxDepth.load`, or another number of classes than the JSON's.
        """
        description = _described(path, "classes")
        network = OnnxNetwork.load(description)
        result = np.zeros(network.output_shape, np.float32)
        if description.meaning == "classes":
            _plane(network, result)
            last = max((*description.movable, *description.sky), default=0)
            return cls(network, description.classes or of_movable(last + 1, description.movable, description.sky))
        if description.classes is not None:
            _scores(network, result, len(description.classes))
            return cls(network, description.classes)
        count = _class_count(network)
        return cls(network, of_movable(count, description.movable, description.sky))

    def __call__(self, image: ArrayLike) -> NDArray[np.uint8]:
        """Classes of one image.

        Args:
            image: [3, H, W] RGB in [0, 1].

        Returns:
            [1, H, W] uint8 train ids, 255 = void. Scores are brought to the image's size bilinearly.

        Raises:
            ValueError: another shape, numbers outside [0, 1], or a network that answers with NaN or with a fraction.
        """
        frame, settings = one_image(image)[0], self.network.description
        result = self.network.run(frame)
        if not np.isfinite(result).all():
            raise ValueError(f"{settings.path}: must give finite scores, got NaN or infinity")
        if settings.meaning == "logits":
            scores = self.network.at_size_of(frame, _scores(self.network, result, len(self.table)))
            return to_train_ids(scores.argmax(0)[None].astype(np.int64), self.table)
        values = _plane(self.network, result)
        if (values != np.rint(values)).any():
            raise ValueError(f"{settings.path}: meaning classes must be whole numbers, got {values.flat[0]:g}; logits?")
        return to_train_ids(self.network.nearest_at_size_of(frame, values.astype(np.int64)), self.table)


def network_files(path: str | Path) -> list[Path]:
    """The files that a network is: ONNX, JSON, and weights where they lie outside.

    Args:
        path: NETWORK.onnx, or the JSON.

    Raises:
        ValueError: no such file, or no ONNX.
    """
    path = Path(path)
    network = network_of(path)
    file = path if path != network else path.with_suffix(".json")
    return [network, *(found for found in (file, *read_onnx(network).weights) if found.is_file())]


def _described(path: str | Path, kind: Any) -> Description:
    description = read_description(path, kind)
    if not description.given:
        file = description.path.with_suffix(".json").name
        assumed = (
            "metres, RGB in 0 to 1" if kind == "depth" else "scores of Cityscapes' classes, ImageNet's normalisation"
        )
        _LOG.warning("%s: without %s its output is taken as %s", description.path, file, assumed)
    return description


def _plane(network: OnnxNetwork, result: NDArray[Any]) -> NDArray[np.float32]:
    """The output [1, h, w], of one value per pixel."""
    sizes = [size for size in result.shape if size != 1]
    if result.ndim < 2 or result.ndim > 4 or len(sizes) > 2:
        wanted = f"meaning {network.description.meaning} must be one value per pixel, [1, 1, H, W]"
        raise ValueError(f"{network.description.path}: {wanted}, got {network.output} {list(result.shape)}")
    height, width = sizes if len(sizes) == 2 else result.shape[-2:]
    return np.ascontiguousarray(result, np.float32).reshape(1, height, width)


def _scores(network: OnnxNetwork, result: NDArray[Any], count: int) -> NDArray[np.float32]:
    """The output [C, h, w] of scores of ``count`` classes, whichever axis they are on."""
    shape = result.shape[1:] if result.ndim == 4 and result.shape[0] == 1 else result.shape
    axes = [axis for axis in (0, 2) if len(shape) == 3 and shape[axis] == count]
    if not axes:
        wanted = f"must give scores of {count} classes, [1, {count}, H, W] or [1, H, W, {count}]"
        hint = 'its JSON\'s "classes" names others, and "meaning": "classes" is for indices'
        raise ValueError(f"{network.description.path}: {wanted}, got {network.output} {list(result.shape)}; {hint}")
    last = axes == [2] or (len(axes) == 2 and network.layout.endswith("C"))
    values = np.asarray(result, np.float32).reshape(shape)
    return np.ascontiguousarray(values.transpose(2, 0, 1) if last else values)


def _class_count(network: OnnxNetwork) -> int:
    """The size of the axis of classes of a network whose JSON has only ``movable`` and ``sky``."""
    shape = network.output_shape[1:] if len(network.output_shape) == 4 else network.output_shape
    if len(shape) != 3:
        raise ValueError(
            f"{network.description.path}: must give [1, C, H, W] scores, got {network.output} {list(shape)}"
        )
    count = shape[2] if network.layout.endswith("C") else shape[0]
    listed = max((*network.description.movable, *network.description.sky), default=0)
    if listed >= count:
        raise ValueError(f"{network.description.path}: has {count} classes, and its JSON lists class {listed}")
    return count
