"""What `vestcl forecast` is tested on: a small stereo clip, and forecasters that repeat a frame."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from data_files import write_images, write_text

from vestcl import opencl
from vestcl.data.sample import Clip
from vestcl.forecasting.result import Forecast, Rendered, View

HEIGHT, WIDTH, FRAMES = 24, 40, 6


@dataclass
class Repeater:
    """In place of a forecaster: every view is frame t + ``shift``, and the calls are kept."""

    method: str
    shift: int = 0
    calls: list[tuple[Clip, int, int, list[View]]] = field(default_factory=list)
    devices: list[str] = field(default_factory=list)
    networks: list[tuple[Any, ...]] = field(default_factory=list)

    def __call__(
        self,
        clip: Clip,
        index: int,
        steps: int,
        views: Sequence[View],
        *network: object,
        progress: Callable[[str, float], None],
        **mode: str,
    ) -> Forecast:
        self.calls.append((clip, index, steps, list(views)))
        self.devices.append(opencl.current().info.index)
        self.networks.append((*network, *mode.values()))
        image = clip[index + self.shift].read_image()
        plane = np.ones_like(image[:1])
        progress("repeat", 0.5)
        rendered = Rendered(image, 10 * plane, plane, 0 * image)
        return Forecast(self.method, [np.eye(4)] * steps, [{v.name: rendered for v in views}] * steps, {"repeat": 0.25})


def write_clip(folder: Path) -> Path:
    """A stereo clip of noise."""
    for side in ("image", "right"):
        write_images(folder / side, [f"{i:04}.png" for i in range(FRAMES)], HEIGHT, WIDTH)
    camera = {"fx": 40, "fy": 40, "cx": 19.5, "cy": 11.5, "fps": 25, "baseline": 0.5}
    write_text(folder / "camera.json", json.dumps(camera))
    return folder
