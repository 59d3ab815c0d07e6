"""Small images and tables in the layouts of data sets, and where real data lies when it is there."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from vestcl.io import write_pixels

#: Real driving data next to the checkout; it is never part of the repository.
REAL = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def real(name: str) -> Path:
    """A folder or file of the real data; the test is skipped where it is not there."""
    path = REAL / name
    if not path.exists():
        pytest.skip(f"real data is not here: ../shared/data/{name} next to the checkout")
    return path


def noise_image(height: int = 6, width: int = 8, seed: int = 0) -> np.ndarray:
    """[H, W, 3] uint8 noise."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def write_images(folder: Path, names: Iterable[str], height: int = 6, width: int = 8) -> None:
    """Noise, another in every file: the image of the i-th name has seed i."""
    for seed, name in enumerate(names):
        write_pixels(folder / name, noise_image(height, width, seed))


def write_text(path: Path, *lines: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return path


def row(values: object) -> str:
    """Numbers as a line of a table, with all their digits."""
    return " ".join(repr(float(value)) for value in np.asarray(values).reshape(-1))


def pose(yaw: float = 0.0, xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """[4, 4]: a turn about the camera's y axis and a shift."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    moved = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
    moved[:3, 3] = xyz
    return moved
