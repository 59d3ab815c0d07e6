"""A frame and its future as the viewer shows it: its clouds at any time, from any camera, coarse or full."""

import collections
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.data import calibration
from vestcl.data.sample import Clip
from vestcl.forecasting.geometric.clouds import frame_clouds
from vestcl.forecasting.geometric.forecast import render_clouds
from vestcl.forecasting.geometric.frame_cloud import FrameCloud
from vestcl.forecasting.geometric.memory import MEMORY, remember
from vestcl.forecasting.result import Rendered, View
from vestcl.scene.perception import Perception
from vestcl.viewer.motion import MOST_AHEAD, Matrix, Motion, on_tick

#: Times whose clouds are kept.
_TIMES: Final = 2

#: Metres per interval: slower objects have no arrow.
_SLOWEST: Final = 0.05

#: An arrow's length is an object's path over so many intervals.
_ARROW: Final = 5

#: Frames before t whose cameras are shown.
_PAST: Final = 4


@dataclass(frozen=True, eq=False)
class CameraPaths:
    """Where cameras are, [4, 4] m each, ``cur_from_cam``: in the axes of the camera at t."""

    past: list[Matrix]
    """Of the frames before t, as they were measured, the oldest first."""
    forecast: list[Matrix]
    """At t+1 ... t+10."""
    true: list[Matrix]
    """At t+1 ..., as the clip's own poses have them; none where it has no poses or no more frames."""


class Scene:
    """Frame t of a clip under one method.

    Args:
        perception: of the clip; nothing is asked of it later, except by a network's refinement.
        index: the frame t, 1 or more.
        motion: from t on.
        memory: frames before t-1 that are remembered.
    """

    def __init__(self, perception: Perception, index: int, motion: Motion, memory: int = MEMORY) -> None:
        clip, working = perception.recorded, perception.clip[index]
        self.index, self.motion, self.K = index, motion, clip[index].K
        self.size, self._working = (clip[index].height, clip[index].width), (working.height, working.width)
        remembered = remember(perception, index, memory)
        self._clouds = frame_clouds(perception, index, motion.paths, remembered)
        self._moved: collections.OrderedDict[tuple[float, int], list[FrameCloud]] = collections.OrderedDict()
        self.cameras = CameraPaths(
            _past(perception, index),
            [calibration.invert(motion.camera(ahead)) for ahead in range(1, MOST_AHEAD + 1)],
            _true(clip, index),
        )
        self._objects = _objects(perception, index)

    def render(self, ahead: float, view: View) -> Rendered:
        """The view at full quality: at whole intervals, 1 and more, exactly what `vestcl.forecast` gives.

        Args:
            ahead: intervals after t, -1 to 10; tenths of them.
            view: a camera, placed from the source camera at that time.
        """
        rendered = self._rendered(ahead, view, 1)
        whole = round(ahead)
        if self.motion.refine is not None and whole >= 1 and whole == on_tick(ahead):
            rendered = self.motion.refine(rendered, whole, self._working_view(view, 1))
        return rendered.at_size(*self.size)

    def render_coarse(self, ahead: float, view: View, stride: int) -> Rendered:
        """The view by each ``stride``-th point of rows and columns, at a size that is smaller by as much.

        Args:
            ahead: as of `render`.
            view: as of `render`.
            stride: 1 or more.
        """
        return self._rendered(ahead, view, stride)

    def _rendered(self, ahead: float, view: View, stride: int) -> Rendered:
        """At the working size, or the ``stride``-th part of it."""
        shown = self._working_view(view, stride)
        assert shown.K is not None
        return render_clouds(self.moved(ahead, stride), shown.K, shown, *self._working_size(stride))

    def _working_size(self, stride: int) -> tuple[int, int]:
        height, width = (max(side // stride, 1) for side in self._working)
        return height, width

    def _working_view(self, view: View, stride: int) -> View:
        """The view with its K at `_working_size`."""
        whole = replace(view, K=self.K) if view.K is None else view
        return whole.resized(self.size, self._working_size(stride))

    def moved(self, ahead: float, stride: int = 1) -> list[FrameCloud]:
        """The clouds at a time, kept for the next view: all points, or every ``stride``-th of rows and columns."""
        ahead = on_tick(ahead)
        key = ahead, stride
        if key not in self._moved:
            if stride == 1:
                found = [cloud(ahead, self.motion.camera) for cloud in self._clouds]
            else:
                found = [_thinned(cloud, stride) for cloud in _without_memory(self.moved(ahead))]
            self._moved[key] = found
            while len(self._moved) > 2 * _TIMES:
                self._moved.popitem(last=False)
        self._moved.move_to_end(key)
        return self._moved[key]

    def points(self, ahead: float, most: int = 60_000) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Points [N, 3] m in the source camera at a time, but the sky's, and their colours [N, 3], RGB.

        Args:
            ahead: as of `render`.
            most: the largest N.
        """
        clouds = self.moved(ahead)
        points = np.concatenate([cloud.points_xyz for cloud in (clouds[0], clouds[-1])])
        colours = np.concatenate([cloud.image[:, cloud.rows, cloud.columns].T for cloud in (clouds[0], clouds[-1])])
        near = np.flatnonzero((points[:, 2] > 0) & (points[:, 2] < SKY_DEPTH / 50))
        near = near[:: max(-(-len(near) // most), 1)]
        return points[near], np.rint(colours[near].clip(0, 1) * 255).astype(np.uint8)

    def velocities(self, ahead: float) -> NDArray[np.float32]:
        """Of each object that moves, [N, 2, 3] m: where it is in the source camera at a time, and some intervals on."""
        camera, (centre, velocity) = self.motion.camera(ahead), self._objects
        start = centre + on_tick(ahead) * velocity
        ends = np.stack([start, start + _ARROW * velocity], axis=1)
        return np.asarray(ends @ camera[:3, :3].T + camera[:3, 3], np.float32)


def _without_memory(clouds: Sequence[FrameCloud]) -> list[FrameCloud]:
    """Frame t, frame t-1 and the background: what `render_clouds` takes at least."""
    return [*clouds[:2], clouds[-1]]


def _thinned(cloud: FrameCloud, stride: int) -> FrameCloud:
    """Each ``stride``-th pixel of rows and columns, as a cloud of the smaller image that these pixels make."""
    kept = (cloud.rows % stride == 0) & (cloud.columns % stride == 0)
    smooth = [cv2.blur(plane, (stride, stride))[::stride, ::stride] for plane in cloud.image]
    return FrameCloud(
        cloud.points_xyz[kept],
        cloud.z_src[kept],
        np.ascontiguousarray(np.stack(smooth)),
        cloud.step_xyz[kept],
        cloud.rows[kept] // stride,
        cloud.columns[kept] // stride,
        focal=None if cloud.focal is None else cloud.focal / stride,
    )


def _past(perception: Perception, index: int) -> list[Matrix]:
    frames = range(max(index - _PAST + 1, 1), index + 1)
    cur_from_cam, found = np.eye(4), list[Matrix]()
    for motion in reversed(perception.motions(frames)):
        cur_from_cam = cur_from_cam @ np.linalg.inv(motion)
        found.append(cur_from_cam)
    return found[::-1]


def _true(clip: Clip, index: int) -> list[Matrix]:
    start, found = clip[index].world_from_cam, list[Matrix]()
    if start is None:
        return found
    for frame in clip.after(index, MOST_AHEAD):
        there = clip[frame].world_from_cam
        if there is None:
            break
        found.append(np.linalg.inv(start) @ there)
    return found


def _objects(perception: Perception, index: int) -> NDArray[np.float64]:
    """[2, N, 3]: median place, m, and velocity, m per interval, of each object that moves, in the camera's axes."""
    moving, frame = perception.moving(index), perception.frame(index)
    _, height, width = frame.depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.tensordot(np.linalg.inv(frame.K), np.stack([u, v, np.ones_like(u)]), 1)
    places, velocities = rays * frame.depth, moving.velocity
    found = []
    for label in range(1, int(moving.instances.max()) + 1):
        which = moving.instances == label
        if not which.any():
            continue
        velocity = np.median(velocities[:, which], axis=1)
        if np.linalg.norm(velocity) >= _SLOWEST:
            found.append((np.median(places[:, which], axis=1), velocity))
    return np.array(found, np.float64).reshape(-1, 2, 3).transpose(1, 0, 2)
