"""A forecast as one works with it: frames by view and step as arrays, a contact sheet, and files."""

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vestcl.data.sample import Clip
from vestcl.forecasting.files import FPS, Details, video_images, write_forecast
from vestcl.forecasting.page import write_page
from vestcl.forecasting.result import Forecast, Rendered, View
from vestcl.forecasting.sheets import forecast_sheet
from vestcl.io.contact_sheet import Picture
from vestcl.io.ply import write_ply
from vestcl.io.video.writing import write_mp4


@dataclass(frozen=True, eq=False)
class FutureFrame:
    """One future frame in one camera."""

    step: int
    """k of t+k, from 1."""
    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1]."""
    depth: NDArray[np.float32]
    """[1, H, W] m; 0 where unknown."""
    coverage: NDArray[np.float32]
    """[1, H, W] in [0, 1]: 0 where no frame has seen what is shown."""
    motion: NDArray[np.float32]
    """[3, H, W] m: by how much what the pixel shows moves over the interval before, in its own time's source camera."""
    K: NDArray[np.float64]
    """[3, 3] px."""
    tgt_from_cur: NDArray[np.float64]
    """[4, 4] m: from the source camera at t to this camera at t+k."""

    def __repr__(self) -> str:
        _, height, width = self.image.shape
        return f"FutureFrame(t+{self.step}, {height} x {width} px, coverage {self.coverage.mean():.1%})"


class FutureView(Sequence[FutureFrame]):
    """The frames of one camera. ``view[k]`` is the frame at t+k: steps count from 1. Iteration gives all in order."""

    def __init__(self, frames: Sequence[FutureFrame]) -> None:
        self._frames = tuple(frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[FutureFrame]:
        return iter(self._frames)

    def __getitem__(self, step: Any) -> Any:
        """The frame at t + ``step``, 1 ... len; of a slice of steps a list."""
        if isinstance(step, slice):
            steps = range(1, len(self) + 1)
            start = 1 if step.start is None else step.start
            stop = len(self) + 1 if step.stop is None else step.stop
            return [self._frames[k - 1] for k in range(start, stop, step.step or 1) if k in steps]
        if not 1 <= step <= len(self):
            raise IndexError(f"`step` must be 1 ... {len(self)}, got {step}")
        return self._frames[step - 1]

    def __repr__(self) -> str:
        return f"FutureView(t+1 ... t+{len(self)})"


class Future(Mapping[str, FutureView]):
    """The frames at t+1 ... t+steps from every camera, by the camera's name. A notebook shows its contact sheet."""

    def __init__(self, clip: Clip, index: int, views: tuple[View, ...], forecast: Forecast) -> None:
        self.clip, self.index, self.views, self.forecast = clip, index, views, forecast

    @property
    def steps(self) -> int:
        """How many frames."""
        return len(self.forecast.frames)

    @property
    def method(self) -> str:
        """What made it: "geometric", or a network's name."""
        return self.forecast.method

    def __getitem__(self, name: str) -> FutureView:
        view = self._view(name)
        K = self.clip[self.index].K if view.K is None else view.K
        return FutureView(
            [
                FutureFrame(step, one.image, one.depth, one.coverage, one.motion_xyz, K, view.tgt_from_next @ pose)
                for step, (one, pose) in enumerate(zip(self._of(name), self.forecast.future_from_cur, strict=True), 1)
            ]
        )

    def __iter__(self) -> Iterator[str]:
        return iter(view.name for view in self.views)

    def __len__(self) -> int:
        return len(self.views)

    def __repr__(self) -> str:
        frame = self.clip[self.index].name
        return f"Future({self.clip.name}, frame {frame}, {self.method}, {self.steps} steps, views {', '.join(self)})"

    def sheet(self, view: str | None = None) -> Picture:
        """[H, W, 3] uint8: a row per step with image, depth and coverage; of the first view if none is named."""
        name = self._view(view).name
        return forecast_sheet(self._of(name), f"{self.clip.name}, {self.method}, view {name}")

    def _repr_png_(self) -> bytes:
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(self.sheet()).save(file, "png")
        return file.getvalue()

    def save(self, folder: str | Path, *, exr: bool = True, gif: bool = False) -> Path:
        """Write what `vestcl forecast` writes: images, OpenEXR and a video per view, sheets, forecast.json, and a
        page to look at (index.html).

        Args:
            folder: made if it is missing.
            exr: write OpenEXR with colour, depth, coverage and motion of each frame.
            gif: write an animated GIF per view, too.

        Returns:
            The path of forecast.json.

        Raises:
            OSError: a file can't be written.
        """
        sheets = {name: self.sheet(name) for name in self}
        details = Details(self.clip.name, {"steps": self.steps, "views": list(self)}, None, sheets)
        about = write_forecast(folder, self.forecast, self.clip, self.index, self.views, details, exr=exr, gif=gif)
        write_page(folder, self.forecast, self.clip, self.index, self.views)
        return about

    def video(self, path: str | Path, view: str | None = None) -> Path:
        """Write an MP4 (H.264) of one view at natural speed: in the source camera the frames seen, then the forecast.

        Args:
            path: *.mp4.
            view: its name; None is the first.

        Raises:
            ValueError: no such view.
            OSError: the file can't be written.
        """
        camera = self._view(view)
        K = self.clip[self.index].K if camera.K is None else camera.K
        _, pixels = video_images(self.forecast, self.clip, self.index, camera)
        write_mp4(path, pixels, self.clip.fps or FPS, pixel_aspect=K[1, 1] / K[0, 0])
        return Path(path)

    def to_ply(self, path: str | Path, step: int = 1, view: str | None = None) -> Path:
        """Write the points that a view shows at t + ``step``, with colours, in that camera's axes (x right, y down, m).

        p = z K^-1 (u, v, 1) for each pixel of known depth z.

        Args:
            path: *.ply.
            step: from 1.
            view: its name; None is the first.

        Raises:
            ValueError: no such view.
            IndexError: no such step.
            OSError: the file can't be written.
        """
        frame = self[self._view(view).name][step]
        write_ply(path, *visible_points(frame.image, frame.depth, frame.K))
        return Path(path)

    def _view(self, name: str | None) -> View:
        known = {view.name: view for view in self.views}
        if name is None:
            return self.views[0]
        if name not in known:
            raise KeyError(f"`view` must be one of {', '.join(known)}, got {name!r}")
        return known[name]

    def _of(self, name: str) -> list[Rendered]:
        return [frame[name] for frame in self.forecast.frames]


def visible_points(
    image: NDArray[np.float32], depth: NDArray[np.float32], K: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points that an image shows: p = z K^-1 (u, v, 1) for each pixel of known depth z.

    Args:
        image: [3, H, W].
        depth: [1, H, W] m; 0 where unknown.
        K: [3, 3] px.

    Returns:
        Points [N, 3] m in the camera's axes, and their colours [N, 3].
    """
    _, height, width = depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.linalg.inv(K) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    known = depth.ravel() > 0
    points = (rays * depth.reshape(1, -1))[:, known].T
    return points.astype(np.float32), image.reshape(3, -1)[:, known].T
