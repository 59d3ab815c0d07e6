"""A procedural street as reconstructions have it: nerfstudio's transforms.json and COLMAP's text model, with a lens."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from vestcl import io
from vestcl.data import Street, street_clip
from vestcl.data.sample import Clip, Sample

HEIGHT, WIDTH, FRAMES = 96, 160, 4

#: Metres per unit of the exported worlds.
SCALE = 2.5

#: world -> world of the file, as nerfstudio's conversion of COLMAP turns it, with a shift.
APPLIED = np.array([[0.0, 1, 0, 0.3], [1, 0, 0, -2], [0, 0, -1, 7], [0, 0, 0, 1]])

#: COLMAP's model -> distortion.
LENSES: Mapping[str, Mapping[str, float]] = {
    "SIMPLE_PINHOLE": {},
    "PINHOLE": {},
    "SIMPLE_RADIAL": {"k1": -0.08},
    "RADIAL": {"k1": -0.08, "k2": 0.01},
    "OPENCV": {"k1": -0.08, "k2": 0.01, "p1": 0.004, "p2": -0.006},
    "OPENCV_FISHEYE": {"k1": 0.04, "k2": -0.01, "k3": 0.004, "k4": -0.001},
}


def street() -> Clip:
    """Rendered once."""
    clip = street_clip(Street.generate(3), FRAMES, HEIGHT, WIDTH, fps=10.0)
    samples = (
        Sample.from_arrays(
            sample.name,
            sample.read_image(),
            sample.K,
            depth=sample.read_depth(),
            train_ids=sample.read_labels(),
            world_from_cam=sample.world_from_cam,
        )
        for sample in clip
    )
    return dataclasses.replace(clip, samples=tuple(samples))


def recorded(image: np.ndarray, K: np.ndarray, model: str) -> np.ndarray:
    """[H, W, 3] uint8: a pinhole image [3, H, W] as a camera with that lens records it."""
    height, width = image.shape[1:]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    bent = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]])
    found = bent.copy()
    for _ in range(200):
        found += 0.8 * (bent - distort(model, *found))
    columns, rows = K[0, 0] * found[0] + K[0, 2] - 0.5, K[1, 1] * found[1] + K[1, 2] - 0.5
    maps = columns.astype(np.float32), rows.astype(np.float32)
    planes = [cv2.remap(plane, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for plane in image]
    return (255 * np.stack(planes, axis=2)).round().astype(np.uint8)


def distort(model: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """COLMAP's documented models: [2, ...] on the plane at depth 1."""
    k = LENSES[model]
    k1, k2, k3, k4, p1, p2 = (k.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        r = np.hypot(x, y).clip(1e-12)
        t = np.arctan(r)
        factor = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
        return np.stack([x * factor, y * factor])
    s = x * x + y * y
    radial = 1 + k1 * s + k2 * s * s
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y]
    )


def write_images(folder: Path, clip: Clip, model: str, names: Sequence[str]) -> None:
    for name, sample in zip(names, clip, strict=True):
        io.write_pixels(folder / name, recorded(sample.read_image(), sample.K, model))


def names_of(clip: Clip) -> list[str]:
    return [f"frame_{index:05}.png" for index in range(len(clip))]


def write_nerfstudio(folder: Path, clip: Clip, model: str = "OPENCV", **more: Any) -> dict[str, Any]:
    """images/ and transforms.json, frames in reverse order; its content."""
    names, K = names_of(clip), clip[0].K
    write_images(folder / "images", clip, model, names)
    frames = []
    for name, sample in zip(names, clip, strict=True):
        assert sample.world_from_cam is not None
        pose = sample.world_from_cam.copy()
        pose[:3, 3] /= SCALE
        pose = APPLIED @ pose @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    content = {
        "camera_model": model,
        **{"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT},
        **LENSES[model],
        "applied_transform": APPLIED[:3].tolist(),
        "frames": frames[::-1],
        **more,
    }
    write_json(folder, content)
    return content


def write_json(folder: Path, content: Any) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def camera_line(model: str, K: np.ndarray) -> str:
    lens, (fx, fy, cx, cy) = LENSES[model], (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    focals = [fx] if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else [fx, fy]
    order = {
        "SIMPLE_RADIAL": ("k1",),
        "RADIAL": ("k1", "k2"),
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    }
    numbers = [*focals, cx, cy, *(lens[key] for key in order.get(model, ()))]
    return f"1 {model} {WIDTH} {HEIGHT} {' '.join(repr(float(number)) for number in numbers)}"


def write_colmap(folder: Path, clip: Clip, model: str = "OPENCV", where: str = "sparse/0") -> Path:
    """images/ and the text files; the folder of these."""
    names = names_of(clip)
    write_images(folder / "images", clip, model, names)
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for number in (2, 0, 3, 1):
        pose = clip[number].world_from_cam
        assert pose is not None
        cam_from_world = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(cam_from_world[:3, :3]).as_quat()
        shift = cam_from_world[:3, 3] / SCALE
        numbers = " ".join(repr(float(value)) for value in (w, x, y, z, *shift))
        lines += [f"{number + 10} {numbers} 1 {names[number]}", "" if number % 2 else "12.5 13.5 -1 4.25 7.5 3"]
    text = folder / where
    text.mkdir(parents=True, exist_ok=True)
    (text / "cameras.txt").write_text(f"# Camera list\n{camera_line(model, clip[0].K)}\n", encoding="utf-8")
    (text / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (text / "points3D.txt").write_text("# 3D point list\n", encoding="utf-8")
    return text
