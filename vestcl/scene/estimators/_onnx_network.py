"""An ONNX network in OpenCV's DNN module: an image in, its output at the image's size out."""

import contextlib
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.data import resize
from vestcl.scene.estimators._onnx_file import OnnxFile, Value, read_onnx
from vestcl.scene.estimators._onnx_json import Description

#: ImageNet's colours in 0 to 1, RGB.
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

#: ITU-R BT.601's weights of red, green and blue in brightness, as OpenCV has them.
_GREY: Final = (0.299, 0.587, 0.114)

#: Types of inputs that an image can be fed to.
_FED: Final = ("float32", "float16", "uint8")

_WHITE: Final = 255

#: OpenCV's message about a node that it has no layer for, or whose attributes it does not take.
_NODE: Final = re.compile(r"Node \[(?P<type>[^\]@]+)@?[^\]]*\]:\((?:onnx_node!)?(?P<name>[^)]*)\)")

#: OpenCV's level of logging at which nothing is logged.
_SILENT: Final = 0

#: Characters of OpenCV's own message that are passed on.
_REASON: Final = 200

Planes = NDArray[np.float32]


@dataclass(frozen=True)
class _Place:
    """Where the image lies in the input: rows top to top + height, columns left to left + width, px."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True, eq=False)
class OnnxNetwork:
    """A network that has run once. Threads may share it; one runs at a time."""

    description: Description
    input: Value
    size: tuple[int, int]
    """(height, width) of its input, px."""
    layout: str
    """NCHW, NHWC, CHW or HWC."""
    output: str
    output_shape: tuple[int, ...]
    _net: Any
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def load(cls, description: Description) -> "OnnxNetwork":
        """Open the file and run it once on a grey image.

        Args:
            description: of the network.

        Raises:
            ValueError: no ONNX file; dynamic axes; an input that is not an image; several inputs or outputs and none
                named; a network that OpenCV cannot read or run. The message names the remedy.
        """
        file = read_onnx(description.path)
        value = _chosen(file, file.inputs, description.input, "input")
        output = _chosen(file, file.outputs, description.output, "output")
        layout, size = _layout(description, value)
        if description.size not in (None, size):
            raise ValueError(f"{file.path}: its input is {size[0]} x {size[1]} px, and its JSON has {description.size}")
        if value.type == "uint8" and (description.scale, description.mean, description.std) != (None, None, None):
            raise ValueError(f"{file.path}: its input is uint8, which takes no scale, mean and std")
        with _explained(file.path, "read"):
            net = cv2.dnn.readNetFromONNX(str(file.path))
        unset = cls(description, value, size, layout, output.name, (), net)
        result = unset.run(np.full((3, *size), 0.5, np.float32))
        return cls(description, value, size, layout, output.name, result.shape, net)

    def run(self, image: Planes) -> NDArray[Any]:
        """The output as the network gives it.

        Args:
            image: [3, H, W] RGB in [0, 1].
        """
        blob = self._blob(image)
        with self._lock, _explained(self.description.path, "run"):
            self._net.setInput(blob, self.input.name)
            return np.array(self._net.forward(self.output))

    def at_size_of(self, image: Planes, planes: Planes) -> Planes:
        """Output planes [C, h, w] over the whole input, bilinearly at the image's pixels: [C, H, W]."""
        place = self._place(*image.shape[1:])
        rows = _sampled(image.shape[1], place.top, place.height, self.size[0], planes.shape[1])
        columns = _sampled(image.shape[2], place.left, place.width, self.size[1], planes.shape[2])
        return resize.sample_grid(planes, rows, columns)

    def nearest_at_size_of(self, image: Planes, planes: NDArray[Any]) -> NDArray[Any]:
        """The same of planes that can't be mixed: each pixel's nearest."""
        place = self._place(*image.shape[1:])
        rows = _sampled(image.shape[1], place.top, place.height, self.size[0], planes.shape[1])
        columns = _sampled(image.shape[2], place.left, place.width, self.size[1], planes.shape[2])
        # Halves go down: a network of half the image's size repeats each pixel twice.
        return planes[:, np.ceil(rows - 0.5).astype(int)[:, None], np.ceil(columns - 0.5).astype(int)]

    def _blob(self, image: Planes) -> NDArray[Any]:
        """(scale p - mean) / std in the network's layout and type."""
        settings, is_bytes = self.description, self.input.type == "uint8"
        pixels = self._placed(image)
        if settings.colour == "grey":
            pixels = np.tensordot(np.array([_GREY], np.float32), pixels, 1)
        elif settings.colour == "BGR":
            pixels = pixels[::-1]
        if is_bytes:
            values: NDArray[Any] = np.rint(pixels * _WHITE).astype(np.uint8)
        else:
            mean, std = (np.array(each, np.float32)[:, None, None] for each in self._normalisation())
            scale = _WHITE * settings.scale if settings.scale is not None else 1.0
            values = ((pixels * np.float32(scale) - mean) / std).astype(np.float32)
        if self.layout.endswith("C"):
            values = values.transpose(1, 2, 0)
        return np.ascontiguousarray(values[None] if self.layout.startswith("N") else values)

    def _normalisation(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """``mean`` and ``std``, one per channel, in the network's order."""
        settings = self.description
        channels = 1 if settings.colour == "grey" else 3
        by_default = settings.mean is None and settings.std is None and settings.scale is None
        if by_default and settings.meaning in ("logits", "classes") and channels == 3:
            return (_MEAN, _STD) if settings.colour == "RGB" else (_MEAN[::-1], _STD[::-1])
        return settings.mean or (0.0,) * channels, settings.std or (1.0,) * channels

    def _placed(self, image: Planes) -> Planes:
        """[3, h, w] of the input's size, edges repeated around the image."""
        place = self._place(*image.shape[1:])
        inner = resize.resize_image(image, place.height, place.width)
        below = self.size[0] - place.top - place.height
        right = self.size[1] - place.left - place.width
        return np.pad(inner, ((0, 0), (place.top, below), (place.left, right)), mode="edge")

    def _place(self, height: int, width: int) -> _Place:
        rows, columns = self.size
        if self.description.fit == "stretch":
            return _Place(0, 0, rows, columns)
        scale = min(rows / height, columns / width)
        inner = max(1, min(rows, round(height * scale))), max(1, min(columns, round(width * scale)))
        return _Place((rows - inner[0]) // 2, (columns - inner[1]) // 2, *inner)


def _sampled(count: int, start: int, length: int, whole: int, target: int) -> NDArray[np.float64]:
    """Where ``count`` pixels lie among ``target`` ones over the input's ``whole`` px, pixel centres at integers.

    The image covers ``length`` px from ``start`` on.
    """
    at_input = start + (np.arange(count) + 0.5) * (length / count)
    return np.clip(at_input * (target / whole) - 0.5, 0, target - 1)


def _chosen(file: OnnxFile, values: tuple[Value, ...], name: str | None, what: str) -> Value:
    if name is None and len(values) == 1:
        return values[0]
    found = [value for value in values if value.name == name]
    if not found:
        listed = ", ".join(map(str, values)) or "none"
        wanted = f'must name one {what}, as "{what}" in its JSON' if name is None else f"has no {what} {name}"
        raise ValueError(f"{file.path}: {wanted}; it has {listed}")
    return found[0]


def _layout(description: Description, value: Value) -> tuple[str, tuple[int, int]]:
    """Layout and (height, width) of an input."""
    path, shape = description.path, value.shape
    sizes = [axis for axis in shape if isinstance(axis, int)]
    if len(sizes) < len(shape):
        fixed = ",".join(str(axis) if isinstance(axis, int) else _example(axis, i) for i, axis in enumerate(shape))
        raise ValueError(
            f"{path}: its input {value} has dynamic axes, and OpenCV's DNN module needs fixed ones: export it without "
            "dynamic_axes (torch.onnx.export), or `python -m onnxruntime.tools.make_dynamic_shape_fixed "
            f"--input_name {value.name} --input_shape {fixed} {path.name} fixed.onnx`, numbers for letters"
        )
    channels = 1 if description.colour == "grey" else 3
    images = sizes[1:] if len(sizes) == 4 else sizes
    if len(images) != 3 or (len(sizes) == 4 and sizes[0] != 1) or value.type not in _FED:
        wanted = f"one image, [1, {channels}, H, W] or [1, H, W, {channels}] of {', '.join(_FED)}"
        raise ValueError(f"{path}: its input must be {wanted}, got {value}; export it with a batch of 1")
    fitting = {name: size for name, size in (("NCHW", images[0]), ("NHWC", images[2])) if size == channels}
    layout = description.layout or next(iter(fitting), None)
    if layout not in fitting:
        wanted = f"{description.layout or 'NCHW or NHWC'} with {channels} channels ({description.colour})"
        raise ValueError(f"{path}: its input must be {wanted}, got {value}")
    height, width = images[1:] if layout == "NCHW" else images[:2]
    return layout[4 - len(sizes) :], (height, width)


def _example(axis: str | None, index: int) -> str:
    """The value of a dynamic axis in the remedy: 1 for the batch, letters for a size."""
    return "1" if index == 0 else re.sub(r"\W", "", axis or "") or "N"


@contextlib.contextmanager
def _explained(path: Path, what: str) -> Iterator[None]:
    """OpenCV's errors in one line that names the node; nothing else is printed."""
    logging: Any = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging  # where OpenCV 4 and 5 have it
    level = logging.getLogLevel()
    logging.setLogLevel(_SILENT)
    try:
        yield
    except cv2.error as error:
        message = " ".join(str(error.err or error).split())
        node = _NODE.search(message)
        # The last of nested messages is the cause.
        reason = re.sub(r"OpenCV\([^)]*\) \S+: error: ", "", message)
        reason = re.sub(r"^.*?parse error: ", "", reason)[:_REASON].strip(" >")
        where = f"node {node['name'] or '?'} of type {node['type']}: " if node else ""
        raise ValueError(
            f"{path}: OpenCV {cv2.__version__} cannot {what} this network: {where}{reason}; export it with another "
            "opset (11 to 17) or simplify it (onnxsim)"
        ) from error
    finally:
        logging.setLogLevel(level)
