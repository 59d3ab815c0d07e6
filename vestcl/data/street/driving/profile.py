"""The road's surface below a car: random roughness as ISO 8608 has it, and single bumps."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Roughness Gd(n0) at n0 = 0.1 cycles/m, m^3: ISO 8608:2016 has 16e-6 for the middle of class A, 64e-6 for class B,
#: 256e-6 for C; Gd(n) = Gd(n0) (n / n0)^-2. Paved roads in towns are of A and B.
ROUGHNESS: Final = (4e-6, 64e-6)
N0: Final = 0.1

#: Spatial frequencies of the profile, cycles/m, and how many: waves from 100 m to 0.33 m.
WAVES: Final = (0.01, 3.0)
WAVE_COUNT: Final = 64

#: Decay of the coherence of left and right track with spatial frequency, exp(-r n b) for a track b (Bogsjo 2007,
#: Coherence of road roughness in left and right wheel-path, Vehicle System Dynamics 46: 1 to 6).
COHERENCE: Final = 3.0

#: Single bumps and dips, patches, covers and joints: metres between them, their length and height in metres. Chosen,
#: below the 75 mm of a speed hump (ITE 2011).
BUMP_SPACING: Final = 70.0
BUMP_LENGTHS: Final = (0.6, 4.0)
BUMP_HEIGHT: Final = 0.02

#: Track of a compact car, metres.
TRACK: Final = 1.55

#: Stream of the random numbers of a road.
_PROFILE, _BUMPS = 51, 52


def profile(seed: int, roughness: float, s: Array) -> tuple[Array, Array]:
    """The road's height below both wheels of an axle, and left less right, metres: sums of sines of random phases.

    Args:
        seed: of the road.
        roughness: Gd(n0), m^3.
        s: metres along it, [...].
    """
    edges = np.geomspace(*WAVES, WAVE_COUNT + 1)
    n = np.sqrt(edges[1:] * edges[:-1])
    rng = np.random.default_rng([seed, _PROFILE])
    size = np.sqrt(2 * roughness * (n / N0) ** -2 * np.diff(edges))
    apart = size * np.sqrt(2 * (1 - np.exp(-COHERENCE * n * TRACK)))
    phase, other = rng.uniform(0, 2 * np.pi, (2, WAVE_COUNT))
    angle = 2 * np.pi * s[..., None] * n
    return np.sin(angle + phase) @ size + _bumps(seed, s), np.sin(angle + other) @ apart


def _bumps(seed: int, s: Array) -> Array:
    """Raised cosines, one somewhere in each BUMP_SPACING metres."""
    height = np.zeros_like(s)
    slots = np.floor(s / BUMP_SPACING).astype(np.intp)
    for slot in np.unique(slots):
        rng = np.random.default_rng([seed, _BUMPS, 2 * abs(int(slot)) + int(slot < 0)])
        length = rng.uniform(*BUMP_LENGTHS)
        middle = (slot + rng.uniform(0.1, 0.9)) * BUMP_SPACING
        place = np.clip((s - middle) / length, -0.5, 0.5)
        height += BUMP_HEIGHT * rng.uniform(-1, 1) * (0.5 + 0.5 * np.cos(2 * np.pi * place))
    return height
