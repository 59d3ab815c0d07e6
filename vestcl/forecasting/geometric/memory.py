"""The memory of a drive: what earlier frames saw of the static scene, where the last two frames see nothing of it.

Each frame leaves its pixels of the static scene that the next frame no longer covers. At frame t they are brought to
its camera by the measured motions, corrected in scale and exposure by what t shows as well, and left out where frames t
and t-1 cover them.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.constants import SKY_DEPTH
from vestcl.scene.depth.road_plane import linear
from vestcl.scene.exposure import STRIDE, nearest, tone_curve
from vestcl.scene.morphology import dilated
from vestcl.scene.perceived import Surface
from vestcl.scene.perception import Perception

#: Frames before t-1 that are remembered if nothing else is asked for; `docs/memory.md` has the figures.
MEMORY: Final = 3

#: Pixels around the foreground that are not kept, and how far inside its sides a frame counts as covering what it
#: shows, both in an image 832 wide: masks are inexact, and surfaces have to overlap to be closed.
_DILATE, _MARGIN, _WIDTH = 10, 4, 832

#: A frame covers points that are no farther than its own surface by this factor: of 1.1 and 1.3 the latter has the
#: better PSNR on KITTI's stereo, and the same elsewhere.
_SURFACE: Final = 1.3

#: Depth jumps where neighbouring pixels differ by more than this factor; leaving such pixels out gains ST-LPIPS.
_JUMP: Final = 1.3

#: Two depths are of one surface if they differ by no more than that share; a scale is looked for among twice of it.
_AGREE: Final = 0.1

#: Colours in [0, 1] are of one surface if their mean difference is no larger.
_SIMILAR: Final = 0.1

#: A frame is remembered if so large a share of what t shows as well agrees with it, of this many points or more.
_TRUSTED, _FEWEST = 0.5, 100

#: A camera that drives on sees what is that much beyond the image's sides, as a factor of its width and height; what
#: left it below is passed.
_REACH: Final = (3.0, 1.25)

#: Metres; nearer points are not in an image.
_NEAREST: Final = 0.5

Array = NDArray[np.float32]
Bools = NDArray[np.bool_]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SceneMemory:
    """Points of the static scene in the camera at t; N is no more than an image has pixels."""

    points_xyz: Matrix
    """[N, 3] m."""
    z_src: Array
    """[N] m, depth in the frame that each was seen in."""
    image: Array
    """[3, H', W] RGB, those frames one below the other, as frame t is exposed; a row apart."""
    rows: NDArray[np.intp]
    """[N], of the pixel in ``image`` that each comes from ..."""
    columns: NDArray[np.intp]
    """[N] ... and its column."""


@dataclass(frozen=True, eq=False)
class _Kept:
    """What a frame leaves."""

    image: Array
    """[3, H, W]."""
    depth: Array
    """[1, H, W] m."""
    static: Bools
    """[1, H, W], True = static, away from the foreground and the recording car."""
    left: Bools
    """[1, H, W], True = static, and not covered by the next frame."""
    next_from_cur: Matrix
    """[4, 4] m, the camera's motion to the next frame."""


def remember(perception: Perception, index: int, frames: int) -> SceneMemory | None:
    """What frames t-2, t-3, ... saw of the static scene that t and t-1 don't cover.

    Frames that disagree with t are left out, and those before a gap in time that is too long to be matched.

    Args:
        perception: of the clip; it keeps what each frame leaves for as long as it is needed.
        index: the frame t, 1 or more.
        frames: how many frames before t-1 are looked at, 0 or more.

    Returns:
        None if nothing is remembered. Where there are more points than pixels the oldest frames are left out.

    Raises:
        ValueError: a negative number of frames.
    """
    if frames < 0:
        raise ValueError(f"`memory` must be 0 frames or more, got {frames}")
    first = index - 1
    while first > max(index - 1 - frames, 0) and not perception.is_lost(first):
        first -= 1
    kept = [
        _kept(perception, i, frames) for i in range(first, index - 1)
    ]  # the oldest first: once asked for, they stay
    if not kept:
        return None
    cur, prev = perception.surface(index), perception.surface(index - 1)
    prev_from_cur, K = perception.prev_from_cur(index), perception.clip[index].K
    cur_from_src, parts, count = np.asarray(np.linalg.inv(prev_from_cur), np.float64), list[SceneMemory](), 0
    for frame in reversed(kept):
        cur_from_src = cur_from_src @ frame.next_from_cur
        aligned = _aligned(frame, cur_from_src, cur, K)
        if aligned is None:
            continue
        image, depth = aligned
        ahead = _within_reach(depth, frame.left, cur_from_src, K)
        shown = ahead & ~_covered(depth, ahead, cur_from_src, cur.depth, ~cur.own, K)
        shown &= ~_covered(depth, shown, prev_from_cur @ cur_from_src, prev.depth, ~prev.own, K)
        count += int(shown.sum())
        if count > shown.size:
            break
        parts.append(SceneMemory(_points(depth, shown, cur_from_src, K).T, depth[shown], image, *np.nonzero(shown[0])))
    return _stacked(parts) if parts else None


def _kept(perception: Perception, index: int, frames: int) -> _Kept:
    return perception.once("memory", index, lambda: _leave(perception, index), lifetime=frames + 2)


def _leave(perception: Perception, index: int) -> _Kept:
    frame, after, K = perception.surface(index), perception.surface(index + 1), perception.clip[index].K
    next_from_cur = np.asarray(np.linalg.inv(perception.prev_from_cur(index + 1)), np.float64)
    static = _static(frame) & _even(frame.depth)
    left = static & ~_covered(frame.depth, static, next_from_cur, after.depth, _static(after), K)
    return _Kept(frame.image, frame.depth, static, left, next_from_cur)


def _static(frame: Surface) -> Bools:
    """[1, H, W], True = static, away from the foreground and the recording car."""
    return ~dilated((~frame.mask | frame.own)[0], _DILATE * frame.own.shape[2] / _WIDTH)[None]


def _even(depth: Array) -> Bools:
    """[1, H, W], True where no jump of depth is near: there a pixel may have its neighbour's depth."""
    brush = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(depth[0], brush) < _JUMP * cv2.erode(depth[0], brush))[None]


def _points(depth: Array, which: Bools, dst_from_src: Matrix, K: Matrix) -> Matrix:
    """[3, N] m, the pixels of ``which`` in another camera."""
    rows, columns = np.nonzero(which[0])
    rays = linear(np.linalg.inv(K), [columns + 0.5, rows + 0.5, np.ones(len(rows))])
    return linear(dst_from_src[:3, :3], rays * depth[which]) + dst_from_src[:3, 3:]


def _project(depth: Array, which: Bools, dst_from_src: Matrix, K: Matrix) -> Matrix:
    """[3, N]: column and row in another camera, 0 = the first one's centre, and z in m; column NaN where z is small."""
    there = _points(depth, which, dst_from_src, K)
    u, v, _ = linear(K, there) / np.maximum(there[2], _NEAREST)
    return np.stack([np.where(there[2] > _NEAREST, u - 0.5, np.nan), v - 0.5, there[2]])


def _covered(depth: Array, which: Bools, dst_from_src: Matrix, depth_dst: Array, known: Bools, K: Matrix) -> Bools:
    """[1, H, W]: the pixels of ``which`` whose points another frame shows, or shows not to be there.

    Args:
        depth: [1, H, W] m.
        which: [1, H, W], the pixels that are asked for; False elsewhere.
        dst_from_src: [4, 4] m, to the other frame's camera.
        depth_dst: [1, H, W] m, of the other frame.
        known: [1, H, W], True where the other frame's pixels count.
        K: [3, 3] px.
    """
    x, y, z = _project(depth, which, dst_from_src, K)
    width, margin = depth.shape[2], round(_MARGIN * depth.shape[2] / _WIDTH)
    inner = known & ((np.arange(width) >= margin) & (np.arange(width) < width - margin))
    surface = nearest(np.where(inner, depth_dst, np.float32(0)), x, y)[0]
    result = np.zeros_like(which)
    result[which] = z <= _SURFACE * np.nan_to_num(surface)
    return result


def _within_reach(depth: Array, which: Bools, cur_from_src: Matrix, K: Matrix) -> Bools:
    """[1, H, W]: the pixels of ``which`` that an image `_REACH` times as wide and as high as that of t would show."""
    x, y, _ = _project(depth, which, cur_from_src, K)
    height, width = depth.shape[1:]
    inside = (np.abs(x - width / 2) < _REACH[0] * width / 2) & (np.abs(y - height / 2) < _REACH[1] * height / 2)
    result = np.zeros_like(which)
    result[which] = inside
    return result


def _aligned(frame: _Kept, cur_from_src: Matrix, cur: Surface, K: Matrix) -> tuple[Array, Array] | None:
    """The frame's image [3, H, W] and depth [1, H, W] m in the exposure and scale of t; None if they disagree.

    The scale is s = median (z_t - t_z) / (z - t_z), z of a point brought to t, z_t what t shows there.
    """
    solid = frame.depth < SKY_DEPTH / 2
    grid = np.zeros_like(frame.static)
    grid[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
    grid &= frame.static & solid
    x, y, z = _project(frame.depth, grid, cur_from_src, K)
    known = cur.mask & (cur.depth < SKY_DEPTH / 2)
    shown = np.concatenate([cur.image, np.where(known, cur.depth, np.float32(np.nan))])
    *colours, depth = nearest(shown, x, y)
    both = np.isfinite(depth)
    z, depth, values, wanted = z[both], depth[both], frame.image[:, grid[0]][:, both], np.stack(colours)[:, both]
    near = np.abs(np.log(depth / z)) < np.log1p(2 * _AGREE)
    if near.sum() < _FEWEST:
        return None
    ahead = cur_from_src[2, 3]
    scale = float(np.median((depth - ahead)[near] / np.maximum(z - ahead, _NEAREST)[near]))
    curve = tone_curve(values[:, near], wanted[:, near])
    off = np.abs(np.log(depth / np.maximum(ahead + scale * (z - ahead), _NEAREST)))
    agree = (off < np.log1p(_AGREE)) & (np.abs(curve(values) - wanted).mean(0) < _SIMILAR)
    if agree.mean() < _TRUSTED:
        return None
    return curve(frame.image), np.where(solid, np.float32(scale) * frame.depth, frame.depth)


def _stacked(parts: list[SceneMemory]) -> SceneMemory:
    """One memory of all; a row between images parts their surfaces."""
    height = parts[0].image.shape[1] + 1
    return SceneMemory(
        np.concatenate([part.points_xyz for part in parts]),
        np.concatenate([part.z_src for part in parts]),
        np.concatenate([np.pad(part.image, ((0, 0), (0, 1), (0, 0)), "edge") for part in parts], axis=1),
        np.concatenate([part.rows + number * height for number, part in enumerate(parts)]),
        np.concatenate([part.columns for part in parts]),
    )
