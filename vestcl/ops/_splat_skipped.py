"""What splatting skips, counted on demand (kernels/splat/splat_skipped.cl)."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from vestcl import opencl
from vestcl.ops._splat_lists import Geometry, TileLists, chunks_of, splat_defines

#: Why a point is in no list, in the order in which the kernel asks and counts.
REASONS: Final = ("not_finite", "behind", "no_radius", "outside", "transparent")


@dataclass(frozen=True)
class Skipped:
    """How much a rasterisation leaves out, from `skipped`. Each point counts once, for the first reason that holds."""

    points: int
    """All that there are, skipped or not."""
    not_finite: int
    """Points with a position, depth, radius or opacity that is NaN or infinite."""
    behind: int
    """Points nearer than `constants.NEAR`, 0.1 m."""
    no_radius: int
    """Points whose radius is <= 0 or whose squared radius is subnormal or infinite."""
    outside: int
    """Points whose footprint holds no pixel of the image."""
    transparent: int
    """Points of opacity 0, where no gradient of the opacities is asked for."""
    tiles: int
    """Of all images."""
    empty_tiles: int
    """Tiles that no point reaches."""
    pixels: int
    """Of all images."""
    saturated_pixels: int
    """Pixels whose transmittance has reached 0, or fallen below the least one asked for."""

    @property
    def culled(self) -> int:
        """Points skipped, whatever the reason."""
        return sum(getattr(self, reason) for reason in REASONS)


def count_culled(geometry: Geometry, lists: TileLists) -> dict[str, int]:
    """Points that are in no list, by `REASONS`."""
    if geometry.points == 0:
        return dict.fromkeys(REASONS, 0)
    chunks, group = chunks_of(lists.session, geometry.points, len(REASONS))
    counts = np.zeros((chunks, len(REASONS)), np.int32)
    with lists.session.job() as job:
        arguments: opencl.Arguments = {
            "height": np.int32(geometry.height),
            "width": np.int32(geometry.width),
            "points": np.int32(geometry.points),
            "points_uv": job.read(geometry.points_uv),
            "z": job.read(geometry.z),
            "radii": job.read(geometry.radii),
            "opacities": job.read(geometry.opacities),
            "intersections": lists.intersections,
            "skipped": job.write(counts),
        }
        defines = splat_defines(geometry.dtype)
        job.launch("splat/splat_skipped.cl", "count_skipped", defines, (chunks,), arguments, (group,))
    return {reason: int(count) for reason, count in zip(REASONS, counts.sum(axis=0), strict=True)}
