"""`vestcl demo`: the main job so far. A street is lifted to points, moved, and shown from a new camera."""

import contextlib
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table

import vestcl
from vestcl import geometry
from vestcl.data import Street, intrinsics

Picture = np.ndarray[Any, np.dtype[np.uint8]]

#: A point's radius in pixels of the source: below 0.75 leaves holes, 1.5 blurs (SPEC section 2).
RHO: Final = 0.95
RADIUS_LIMITS: Final = (0.5, 8.0)
#: The ego-motion, x_next = R x_cur + t: 0.8 m forward, and half a degree to the left.
YAW: Final = math.radians(0.5)
NEXT_FROM_CUR: Final = ((math.cos(YAW / 2), 0.0, math.sin(YAW / 2), 0.0), (0.0, 0.0, -0.8))
#: The new camera stands half a metre to the right of the next one.
TGT_FROM_NEXT: Final = (-0.5, 0.0, 0.0)
#: Depths are shown by their inverse, from this one (blue) to that one (red), metres.
FAR, NEAR = 80.0, 4.0
#: The darkest red of the error map, in a colour range of 0 to 1.
WORST_ERROR: Final = 0.25


@dataclass
class Stages:
    """How long each stage took."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start


def run(out: Path, height: int, width: int, seed: int) -> None:
    """Render, lift, move and splat one street; write pictures to ``out`` and print their paths and the times.

    Args:
        out: folder for the PNG files, made if it is missing.
        height: rows of the pictures.
        width: columns of the pictures.
        seed: of the street.
    """
    console, stages = Console(), Stages()
    street, K = Street.generate(seed), intrinsics(height, width)
    quaternion, translation = (torch.tensor([part]) for part in NEXT_FROM_CUR)
    tgt_from_next = torch.eye(4)[None].clone()
    tgt_from_next[:, :3, 3] = torch.tensor(TGT_FROM_NEXT)
    next_from_cur = geometry.compose_rigid(quaternion, translation)
    cur_from_world = np.linalg.inv(street.camera_pose(0.0))
    tgt_from_world = (tgt_from_next @ next_from_cur)[0].double().numpy() @ cur_from_world

    with stages.stage("render the source"):
        source = street.render(cur_from_world, K, height, width)
    with stages.stage("render the truth"):
        truth = street.render(tgt_from_world, K, height, width)
    colour, depth = torch.from_numpy(source.colour), torch.from_numpy(source.depth)
    camera = torch.from_numpy(K).float()[None]
    for turn in ("first", "second"):  # the first builds the kernels
        with stages.stage(f"lift, move and splat, {turn} time"):
            shown, z, coverage = splat_view(colour, depth, camera, quaternion, translation, tgt_from_next)

    error = (shown - torch.from_numpy(truth.colour)).abs().mean(1, keepdim=True)
    pictures = {
        "source": _rgb(colour),
        "source_depth": _depth_map(depth),
        "view": _rgb(shown),
        "view_depth": _depth_map(z),
        "view_coverage": _grey(coverage),
        "truth": _rgb(torch.from_numpy(truth.colour)),
        "error": _heat(error * (coverage > 0)),
    }
    pictures["sheet"] = _sheet(pictures)
    with stages.stage("write the pictures"):
        paths = [_write(out / f"{name}.png", picture) for name, picture in pictures.items()]

    _print_times(console, stages)
    covered = (coverage > 0).expand_as(shown)
    psnr = -10 * math.log10(float(((shown - torch.from_numpy(truth.colour))[covered] ** 2).mean()))
    seen = float(covered.float().mean())
    console.print(f"PSNR against the truth: {psnr:.1f} dB over the {seen:.1%} of the view that the source saw")
    for path in paths:
        console.print(str(path), soft_wrap=True, highlight=False)


def splat_view(
    colour: torch.Tensor,
    depth: torch.Tensor,
    K: torch.Tensor,
    quaternion: torch.Tensor,
    translation: torch.Tensor,
    tgt_from_next: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A frame's points moved by x_next = R x_cur + t and splatted to another camera.

    Args:
        colour: [B, 3, H, W].
        depth: [B, 1, H, W] m.
        K: [B, 3, 3] px, of both cameras.
        quaternion: [B, 4], R of next_from_cur.
        translation: [B, 3] m, t of next_from_cur.
        tgt_from_next: [B, 4, 4].

    Returns:
        Colour [B, 3, H, W] and depth [B, 1, H, W], both divided by the coverage, and the coverage [B, 1, H, W]; where
        nothing is covered, 0.
    """
    points_xyz = vestcl.unproject(depth, K)
    motion = vestcl.rigid_flow(points_xyz, quaternion, translation)
    points_uv, z = vestcl.displace(points_xyz, motion, K, tgt_from_next)
    radii = (RHO * depth.flatten(1) / z).clamp(*RADIUS_LIMITS)
    features = torch.cat([colour.flatten(2).transpose(1, 2), z[..., None]], dim=2)
    image, coverage = vestcl.splat(points_uv, z, radii, torch.ones_like(z), features, *depth.shape[2:])
    image = torch.where(coverage > 0, image / coverage, 0.0)
    return image[:, :3], image[:, 3:], coverage


def _rgb(image: torch.Tensor) -> Picture:
    """[1, 3, H, W] in [0, 1] -> [H, W, 3]."""
    return (image[0].permute(1, 2, 0).clamp(0, 1) * 255).round().byte().numpy()


def _grey(image: torch.Tensor) -> Picture:
    return _rgb(image.expand(-1, 3, -1, -1))


def _coloured(values: torch.Tensor, colours: str) -> Picture:
    """[1, 1, H, W] in [0, 1] -> [H, W, 3] by a colour map of matplotlib's."""
    return (matplotlib.colormaps[colours](values[0, 0].clamp(0, 1).numpy())[..., :3] * 255).round().astype(np.uint8)


def _depth_map(depth: torch.Tensor) -> Picture:
    """Inverse depth, so that what is near differs most; black where nothing is."""
    near = (1 / depth.clamp(min=1e-3) - 1 / FAR) / (1 / NEAR - 1 / FAR)
    return _coloured(near, "turbo") * (depth[0, 0, :, :, None] > 0).numpy()


def _heat(error: torch.Tensor) -> Picture:
    return _coloured(error / WORST_ERROR, "inferno")


def _sheet(pictures: dict[str, Picture]) -> Picture:
    """Two columns with a line of text above each picture."""
    titles = {
        "source": "what the camera saw",
        "source_depth": "its depth",
        "view": "seen from 0.8 m further on and 0.5 m to the right",
        "view_coverage": "coverage of that view (black: hidden from the camera)",
        "truth": "the truth",
        "error": f"error (yellow: {WORST_ERROR} of the range and more)",
    }
    height, width, _ = pictures["source"].shape
    line, gap = 22, 6
    font = ImageFont.load_default(size=15)
    sheet = Image.new("RGB", (2 * width + gap, 3 * (height + line + gap) - gap), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (name, title) in enumerate(titles.items()):
        x, y = i % 2 * (width + gap), i // 2 * (height + line + gap)
        draw.text((x + 4, y + 2), title, fill="black", font=font)
        sheet.paste(Image.fromarray(pictures[name]), (x, y + line))
    return np.asarray(sheet)


def _write(path: Path, picture: Picture) -> Path:
    """Write a PNG under a temporary name and rename it, so that no half picture is ever left."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        Image.fromarray(picture).save(temporary, format="PNG")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _print_times(console: Console, stages: Stages) -> None:
    table = Table("stage", "milliseconds")
    table.columns[1].justify = "right"
    for name, seconds in stages.seconds.items():
        table.add_row(name, f"{1e3 * seconds:.1f}")
    console.print(table)
