"""Which velocities the images confirm: what moves by v looks in the frame before, at x - v, as it does now.

Flow is wrong where it is large, on cars that pass close by above all, and makes parked cars appear to move.
What an image shows of a wrong motion is something else.
"""

from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene import checked
from vestcl.scene.depth.completion import smooth
from vestcl.scene.depth.road_plane import linear, rays_of
from vestcl.scene.exposure import STRIDE, nearest, tone_curve
from vestcl.scene.flow.correspondence import sample
from vestcl.scene.motion.objects import pixels_by_instance, some_points
from vestcl.scene.regions import mean_by_region, superpixels

Array = NDArray[np.float64]

#: Differences of colour beyond that are of something else, and count no more.
_OTHER: Final = 0.15

#: A motion is trusted if it leaves so much of the difference at most ...
_LEFT: Final = 0.9

#: ... and takes that much from it at least: noise of an image.
_NOISE: Final = 0.002

#: Metres per frame: what is slower is static. Half of a walk at 10 Hz.
_SLOWEST: Final = 0.05

#: Objects are searched along the camera's axes x and z up to this many metres per frame: at 10 Hz 8 m/s across and 32
#: m/s against us, by steps of a pixel or as many as this to either side.
_AXES: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_FARTHEST, _MOST = np.array([0.8, 3.2]), 60

#: Flow on a wrong depth gives speeds that nothing has: at 10 Hz 45 m/s, or half of the way to the camera in a frame.
_FASTEST, _CLOSER = 4.5, 0.5

#: Then around the best in both at once: This many pixels, in turn.
_SIZES: Final = (2.0, 2.0, 1.0, 1.0, 0.5, 0.5, 0.25, 0.12)
_AROUND: Final = np.array([[x, z] for x in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)])

#: Pixels of an object that take part in the search and in what decides, evenly chosen. With fewer nothing is searched.
_SEARCHED, _COMPARED, _FEWEST = 300, 1500, 30

#: This many of an object's pixels must have been inside the frame before.
_INSIDE: Final = 0.5

#: Differences are averaged over windows of this many pixels, then up to edges and over superpixels of that area.
#: Against edges only, superpixels at 416 columns changed PSNR at t+1, t+2 and t+3 by 0.00, 0.02 and 0.01 dB in the mean
#: over 12 sets of windows (22 windows), by -0.05 to 0.09 dB in each.
_WINDOW, _AREA = 5, 25.0


class Pair(NamedTuple):
    """Two frames of one camera."""

    image: NDArray[np.float32]
    """[3, H, W] RGB in [0, 1] at t."""
    image_prev: NDArray[np.float32]
    """The same at t - 1."""
    prev_from_cur: Array
    """[4, 4] m, the camera's motion."""
    K: Array
    """[3, 3] px."""

    def unlikeness(self, points: Array, colours: NDArray[np.float32]) -> NDArray[np.float32]:
        """Mean over RGB of |colour - colour of the frame before where the point is seen there|; NaN outside of it.

        Args:
            points: [3, n, m] m in the camera's axes at t, where they would be at t - 1 had the camera not moved.
            colours: [3, n, m] at t.

        Returns:
            [n, m].
        """
        shift = self.K @ self.prev_from_cur[:3, 3]
        x, y, z = linear(self.K @ self.prev_from_cur[:3, :3], points) + shift[:, None, None]
        far = np.maximum(z, 0.1)
        seen = sample(self.image_prev, x / far - 0.5, y / far - 0.5, outside=np.nan)
        difference = np.abs(seen - colours).mean(0)
        return np.where(z > 0.1, difference, np.float32(np.nan))

    def equally_exposed(self, depth: NDArray[np.float32], velocity: NDArray[np.float32] | None = None) -> "Pair":
        """The pair with the frame before as the frame at t is exposed, by the colours of points in both.

        Args:
            depth: [1, H, W] m at t; 0 = unknown.
            velocity: [3, H, W] m per frame; None is 0 everywhere. Points that move otherwise are wrong matches, which
                the median tolerates.
        """
        grid = np.s_[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        rows, columns = (np.arange(STRIDE // 2, size, STRIDE) + 0.5 for size in depth.shape[1:])
        u, v = np.meshgrid(columns, rows)
        points = np.tensordot(np.linalg.inv(self.K), np.stack([u, v, np.ones_like(u)]), 1) * depth[grid]
        points = (points if velocity is None else points - velocity[grid]).reshape(3, -1)
        x, y, z = self.K @ (self.prev_from_cur[:3, :3] @ points + self.prev_from_cur[:3, 3:])
        known = (depth[grid].ravel() > 0) & (z > 0.1)
        x, y = (np.where(known, at / np.maximum(z, 0.1) - 0.5, np.nan) for at in (x, y))
        curve = tone_curve(nearest(self.image_prev, x, y), self.image[grid].reshape(3, -1))
        return self._replace(image_prev=curve(self.image_prev))


def search(instances: NDArray[np.int32], by_flow: Array, depth: NDArray[np.float32], pair: Pair) -> Array:
    """v_n [n + 1, 3] m per frame for each object: of 0, the velocity by flow, and steps ahead and aside, what matches
    best.

    min over v of the mean over pixels of min(|I(p) - I_prev(project(K (R (x - v) + t)))|, OTHER), first along the
    camera's axes x and z, then around the best by ever smaller steps. Unless that is LEFT times what v = 0 gives or
    less, the object is static. I_prev is shown as I is exposed, by the colours of the static background.

    Args:
        objects: [H, W], 0 = background.
        by_flow: [n + 1, 3] m per frame, `vestcl.scene.motion.objects.velocities`.
        depth: [1, H, W] m at t; 0 = invalid.
        pair: both frames.

    Returns:
        Row 0 is 0, as are static objects, and all that are too small to measure.
    """
    found = np.zeros_like(by_flow)
    pair = pair.equally_exposed(np.where(instances > 0, np.float32(0), depth))
    valid = (instances > 0) & (depth[0] > 0)
    before = np.ascontiguousarray(pair.image_prev.transpose(1, 2, 0))
    for instance, here in enumerate(pixels_by_instance(instances, valid, len(found))):
        if instance == 0 or len(here) < _FEWEST:
            continue
        y, x, points = some_points(here, _COMPARED, depth, pair.K)
        found[instance] = _search(_Points(points, pair.image[:, y, x].T, before, pair), by_flow[instance])
    return found


class _Points(NamedTuple):
    """Points of an object that are looked for in the frame before."""

    points: Array
    """[m, 3] m at t."""
    colours: NDArray[np.float32]
    """[m, 3] at t."""
    before: NDArray[np.float32]
    """[H, W, 3], the frame before."""
    pair: Pair

    def every(self, stride: int) -> "_Points":
        return self._replace(points=self.points[::stride], colours=self.colours[::stride])

    def unlikeness(self, tries: Array) -> NDArray[np.float32]:
        """`Pair.unlikeness` [n, m] of the points moved by each of ``tries`` [n, 3] m: K (R x + t) - K R v."""
        turn = self.pair.K @ self.pair.prev_from_cur[:3, :3]
        start, shift = self.points @ turn.T + self.pair.K @ self.pair.prev_from_cur[:3, 3], tries @ turn.T
        x, y, z = (start[:, axis] - shift[:, axis, None] for axis in range(3))
        far = np.maximum(z, 0.1)
        column, row = ((at / far - 0.5).astype(np.float32) for at in (x, y))
        seen = cv2.remap(self.before, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        red, green, blue = np.moveaxis(np.abs(seen.reshape(*z.shape, 3) - self.colours), -1, 0)
        height, width = self.before.shape[:2]
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1) & (z > 0.1)
        return np.where(inside, (red + green + blue) / np.float32(3), np.float32(np.nan))


def _search(instance: _Points, by_flow: Array) -> Array:
    """One object's v [3]."""
    few = instance.every(-(-len(instance.points) // _SEARCHED))
    pixel = _of_a_pixel(few.points, instance.pair.K)
    lines = [
        np.arange(-count, count + 1)[:, None] * step * axis
        for axis, step, count in zip(_AXES, pixel, np.minimum(_FARTHEST / pixel, _MOST).astype(int), strict=True)
    ]
    is_possible = np.linalg.norm(by_flow) < _FASTEST and -by_flow[2] < _CLOSER * np.median(instance.points[:, 2])
    tries = np.concatenate([np.zeros((1, 3)), by_flow[None] * is_possible, *lines])
    best = tries[_costs(few, tries).argmin()]
    for size in _SIZES:
        around = best + size * (_AROUND * pixel) @ _AXES
        best = around[_costs(few, around).argmin()]
    still, moving = _costs(instance, np.stack([np.zeros(3), best]))
    moves = np.linalg.norm(best) >= _SLOWEST and moving < min(_LEFT * still, still - _NOISE)
    return best if moves else np.zeros(3)


def _of_a_pixel(points: Array, K: Array) -> Array:
    """Metres aside and ahead that shift an object's pixels by about one, or this many that MOST reach FARTHEST, [2]."""
    x, y, z = np.median(points, axis=0)
    spread = np.hypot(x, y) + np.abs(points[:, :2] - (x, y)).max()
    return np.asarray(np.maximum(np.array([z, z**2 / spread]) / K[0, 0], _FARTHEST / _MOST), np.float64)


def _costs(instance: _Points, tries: Array) -> NDArray[np.float32]:
    """Mean unlikeness of each of ``tries`` [n, 3], infinite where too little is inside the frame before; but for v = 0
    a single point will do."""
    difference = np.minimum(instance.unlikeness(tries), np.float32(_OTHER))
    inside = np.isfinite(difference)
    count = inside.sum(1)
    mean = np.where(inside, difference, 0).sum(1) / np.maximum(count, 1)
    enough = (count >= _INSIDE * len(instance.points)) | ((count > 0) & ~tries.any(1))
    return np.where(enough, mean, np.float32(np.inf))


def confirmed(
    corrected: NDArray[np.float32], velocity: NDArray[np.float32], depth: NDArray[np.float32], pair: Pair
) -> NDArray[np.float32]:
    """v + g (c - v): ``velocity`` v, corrected to c as far as the images then match better.

    g = (d_v - d_c) / ((1 - LEFT) d_v + NOISE / 2), between 0 and 1, where d is the difference of both frames' colours
    under a velocity: the mean of what it is when smoothed up to the image's edges and when averaged over superpixels,
    which keep to one depth, too.

    Args:
        corrected: c [3, H, W] m per frame, from `vestcl.scene.motion.objects.follow_flow`.
        velocity: v [3, H, W] m per frame.
        depth: [1, H, W] m at t, above 0.
        pair: both frames, which may be exposed differently.

    Returns:
        [3, H, W] m per frame.
    """
    pair = pair.equally_exposed(depth, velocity)
    guide, regions = checked.pixels(pair.image), superpixels(pair.image, depth, area=_AREA)
    differences = (_difference(v, depth, pair) for v in (velocity, corrected))
    before, after = ((smooth(guide, each) + mean_by_region(each, regions)) / 2 for each in differences)
    share = ((before - after) / ((1 - _LEFT) * before + _NOISE / 2)).clip(0, 1).astype(np.float32)
    return velocity + share * (corrected - velocity)


def _difference(velocity: NDArray[np.float32], depth: NDArray[np.float32], pair: Pair) -> NDArray[np.float32]:
    """[H, W], averaged over windows; what was outside the frame before differs by OTHER."""
    height, width = depth.shape[1:]
    points = rays_of(pair.K, height, width) * depth - velocity
    known = np.minimum(np.nan_to_num(pair.unlikeness(points, pair.image), nan=_OTHER), np.float32(_OTHER))
    return np.asarray(cv2.blur(known, (_WINDOW, _WINDOW)), np.float32)
