"""Every number that kernels and Python share, with its reason. Kernels receive them as ``-D`` defines."""

from typing import Final, Literal, get_args

#: Points nearer than this (metres, z-depth) make no fragment: in front of it a car's own bonnet ends,
#: behind it 1/z stays well inside float32.
NEAR: Final = 0.1

#: By how much what an object hides is farther than the object, at least (SPEC section 3.3).
BEHIND: Final = 1.01

#: Side of a square tile in pixels. A point of up to TILE / 2 = 8 px radius (the adaptive radius' upper
#: clamp) then touches at most 2 x 2 tiles, and 16 x 16 x 32 float32 accumulators fit a 48 KiB L1 cache.
TILE: Final = 16

#: Pixels that were next to each other belong to one surface if a view shows them no farther apart than that, times
#: what it magnifies: less tears surfaces that turn towards the camera, more draws skins between objects and background.
TORN: Final = 2.5

#: A plane along which the camera moves is stretched by the square of what it magnifies: close to the camera by more
#: than TORN allows. Pixels that both neighbours of a line are no farther from than that square, times this, are of such
#: a plane: magnification changes from pixel to pixel, and depths are inexact.
SLANTED: Final = 1.25

#: On a plane the steps to the neighbours at both sides differ by less than that share of their mean: those of a road
#: 17 rows below the horizon by 0.26 where they come to lie ten times as far apart, those of noise by 1 and more.
BENT: Final = 0.4

#: Fragments whose alpha and transmittance the CPU backward keeps at a time, per tile. At least one
#: point's largest footprint (TILE * TILE); 4096 keeps them in L1/L2 and a street tile in one segment.
SEGMENT: Final = 4096

#: Quaternions are divided by max(|q|, QUATERNION_FLOOR) (SPEC section 1).
QUATERNION_FLOOR: Final = 1e-8

#: The tile kernels keep TILE * TILE * C accumulators in private memory; 1024 channels are 1 MiB in float32.
MAX_CHANNELS: Final = 1024

#: Bytes of a cache line. Image rows that are whole lines are written past the cache.
CACHE_LINE: Final = 64

#: Outputs of this many bytes and more are recycled (below, the C library recycles them itself) ...
HOST_POOL_FROM: Final = 1 << 18
#: ... and this many bytes of them are kept (the outputs of a training step at 256 x 832), or what was in use at once.
HOST_POOL_BYTES: Final = 1 << 29

#: Depth of the sky, metres: so far that driving 5 m on shifts it by less than half a pixel of a 1242 pixels wide
#: image, so that in effect it only turns (SPEC section 3.5).
SKY_DEPTH: Final = 10_000.0

#: Frames to forecast if neither steps nor seconds are given.
DEFAULT_STEPS: Final = 5

Quality = Literal["exact", "balanced", "fast", "realtime"]
"""Presets, best first: the width that scenes are perceived at, and how a network computes
(`vestcl.models.inference.quality`)."""

LEVELS: Final[tuple[Quality, ...]] = get_args(Quality)

#: Wider frames are perceived and splatted at this width by default, px.
WORK_WIDTH: Final = 960

#: The same by preset; None is their own width. `vestcl bench front` measures the widths, docs/performance.md has the
#: figures.
WORK_WIDTHS: Final[dict[Quality, int | None]] = {"exact": None, "balanced": WORK_WIDTH, "fast": 640, "realtime": 480}
