"""A street along a course that bends: where its parts stand, and its middle line for the ray caster.

Whatever stands at (x, y, z) on the straight street is placed as one at z = s metres along the course: it is moved to
c(s) and turned by the heading there, so that x metres to the right stay x metres to the right.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.data.street import layout
from vestcl.data.street.driving.course import Course
from vestcl.data.street.driving.traffic import Mover
from vestcl.data.street.layout import BLOCK, Layout
from vestcl.data.street.raycast import COURSE, COURSE_STEP, SOLID, Solids

Array = NDArray[np.float64]

#: Metres of the middle line beyond what is built: the ground continues.
_BEYOND: Final = 40.0


def world_from_street(course: Course, s: float) -> Array:
    """[4, 4]: from the axes at ``s`` (x to the right, y down, z along the course) to the world's."""
    x, z, theta = course.at(s)
    pose = np.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = np.cos(theta), np.sin(theta), -np.sin(theta), np.cos(theta)
    pose[0, 3], pose[2, 3] = x, z
    return pose


def stretch(course: Course, camera_from_world: Array, ahead: float, behind: float) -> tuple[float, float]:
    """The s in metres between which the street is built for a camera, as far ``ahead`` and ``behind`` as it looks."""
    rotation = camera_from_world[:3, :3]
    x, _, z = -rotation.T @ camera_from_world[:3, 3]
    s = course.nearest(float(x), float(z))
    theta = course.heading(s)
    forward = float(rotation[2, 0] * np.sin(theta) + rotation[2, 2] * np.cos(theta))
    return s - (behind if forward > 0.5 else ahead), s + (behind if forward < -0.5 else ahead)


def solids(course: Course, plan: Layout, blocks: range, movers: Sequence[Mover], position: Array) -> Solids:
    """Everything in ``blocks`` and all ``movers``, placed from ``position`` [3] in the world."""
    built = [layout.anchored_block(plan, index) for index in blocks]
    parts = [*(part for part, _ in built), *(mover.solids for mover in movers)]
    counts = [len(part) for part in parts]
    local = [*(anchors for _, anchors in built), *(np.zeros(len(mover.solids)) for mover in movers)]
    starts = np.repeat([*(index * BLOCK for index in blocks), *(mover.position[2] for mover in movers)], counts)
    heights = np.repeat([*(0.0 for _ in blocks), *(mover.position[1] for mover in movers)], counts)
    anchors = np.concatenate(local)
    result = np.concatenate([part.view(f"V{SOLID.itemsize}") for part in parts]).view(SOLID)
    result["instance"] = np.repeat([*(0 for _ in blocks), *(mover.instance for mover in movers)], counts)
    x, z, theta = course.at(starts + anchors).T
    sin, cos = np.sin(theta), np.cos(theta)
    across, down, along = result["centre"].astype(np.float64).T
    along = along - anchors
    placed = [x + cos * across + sin * along, down + heights, z + cos * along - sin * across]
    result["centre"] = np.stack(placed, axis=1) - position
    own_cos, own_sin = result["yaw"].T
    result["yaw"] = np.stack([own_cos * cos - own_sin * sin, own_sin * cos + own_cos * sin], axis=1)
    return result


def points(course: Course, low: float, high: float, position: Array) -> NDArray[np.void]:
    """The middle line [n] from ``low`` to ``high`` metres and beyond, placed from ``position`` [3] in the world."""
    first = np.floor((low - _BEYOND) / COURSE_STEP)
    s = np.arange(first, np.ceil((high + _BEYOND) / COURSE_STEP) + 1) * COURSE_STEP  # at the same s for every camera
    x, z, theta = course.at(s).T
    result = np.zeros(len(s), COURSE)
    result["place"] = np.stack([x - position[0], z - position[2]], axis=1)
    result["ahead"] = np.stack([np.sin(theta), np.cos(theta)], axis=1)
    result["curvature"], result["along"] = course.curvature(s), s
    return result
