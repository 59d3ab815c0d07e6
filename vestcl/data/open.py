"""One door to every reader: the layout on disk selects it."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from vestcl.data.lens import lens_of, undistorted_depth, undistorted_labels
from vestcl.data.readers import (
    cityscapes,
    colmap,
    folder,
    kitti_odometry,
    kitti_raw,
    nerfstudio,
    video,
    virtual_kitti,
)
from vestcl.data.readers.files import by_name, is_present, natural
from vestcl.data.sample import Clip, Sample
from vestcl.data.sources import DepthFile, LabelFile
from vestcl.io.labels import LabelKind

#: Suffixes of files that are taken for videos.
VIDEO_SUFFIXES: Final = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")


@dataclass(frozen=True)
class _Layout:
    name: str
    looks_like: str
    """What was looked for, for the message that nothing was found."""
    recognises: Callable[[Path], bool]
    opens: Callable[..., Clip]


def _is_kitti_raw(path: Path) -> bool:
    return any((path / f"image_{camera:02}" / "data").is_dir() for camera in (0, 2))


def _is_kitti_odometry(path: Path) -> bool:
    return (path / "sequences").is_dir() or is_present(path / "calib.txt")


def _is_cityscapes(path: Path) -> bool:
    return cityscapes.is_frame(path) or bool(path.is_dir() and cityscapes.snippets(path))


def _is_virtual_kitti(path: Path) -> bool:
    return (path / "frames" / "rgb").is_dir() or bool(virtual_kitti.variants(path))


def _is_folder(path: Path) -> bool:
    return path.is_dir() and (is_present(path / "camera.json") or bool(folder.frames_of(path)))


#: In this order: the first that recognises a path opens it.
_LAYOUTS: Final = (
    _Layout(
        "video",
        f"a file ending in {', '.join(VIDEO_SUFFIXES)}",
        lambda path: path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES,
        video.open_video,
    ),
    _Layout("KITTI raw", "image_02/data (or image_00/data)", _is_kitti_raw, kitti_raw.open_kitti_raw),
    _Layout("KITTI odometry", "calib.txt, or sequences/", _is_kitti_odometry, kitti_odometry.open_kitti_odometry),
    _Layout(
        "Cityscapes",
        "leftImg8bit_sequence/SPLIT/CITY/*_leftImg8bit.png with camera/SPLIT/CITY/*_camera.json",
        _is_cityscapes,
        cityscapes.open_cityscapes,
    ),
    _Layout(
        "Virtual KITTI 2", "frames/rgb (or VARIANT/frames/rgb)", _is_virtual_kitti, virtual_kitti.open_virtual_kitti
    ),
    _Layout(
        "nerfstudio",
        nerfstudio.FILE,
        lambda path: nerfstudio.is_nerfstudio(path) and not is_present(path / "camera.json"),
        nerfstudio.open_nerfstudio,
    ),
    _Layout(
        "COLMAP",
        f"{colmap.CAMERAS} and {colmap.IMAGES} (or sparse/0 with them)",
        lambda path: colmap.model_folder(path) is not None and not is_present(path / "camera.json"),
        colmap.open_colmap,
    ),
    _Layout("folder", "camera.json, or images (then give `fov`)", _is_folder, folder.open_folder),
)


def open_sequence(
    path: str | Path,
    *,
    depth: str | Path | None = None,
    depth_scale: float | None = None,
    labels: str | Path | None = None,
    label_ids: LabelKind = "trainIds",
    **options: Any,
) -> Clip:
    """A clip of driving frames, whatever layout ``path`` has.

    Args:
        path: a KITTI raw drive, a KITTI odometry sequence, a frame or folder of Cityscapes, a Virtual KITTI variant,
            a folder with camera.json, nerfstudio's transforms.json, COLMAP's text model, or a video.
        depth: a folder of depth files with the frames' names (.png, .exr, .npy), in place of the clip's own.
        depth_scale: their units per metre; PNG needs it.
        labels: a folder of label PNGs with the frames' names, in place of the clip's own.
        label_ids: what they hold.
        **options: of the layout's reader: ``rig``, ``sequence``, ``snippet``, ``variant``, ``fov``, ``fps`` ...

    Returns:
        A clip with at least one sample.

    Raises:
        ValueError: there is nothing at ``path``, no layout or more than one clip in it, an option that its reader does
            not have, or a file that is missing or malformed; the message names it.
    """
    path = Path(path)
    layout = _recognise(path)
    known = list(inspect.signature(layout.opens).parameters)[1:]
    if unknown := sorted(set(options) - set(known)):
        raise ValueError(f"{path}: is {layout.name}, which takes {', '.join(known)}, not {', '.join(unknown)}")
    clip = layout.opens(path, **options)
    if depth is not None:
        clip = _with_depth(clip, Path(depth), depth_scale)
    return clip if labels is None else _with_labels(clip, Path(labels), label_ids)


def clips_in(path: str | Path) -> list[Path]:
    """The clips that a path holds: itself, if it is one, or the files and folders in it that are, by name.

    Args:
        path: a clip, or a folder of clips.

    Returns:
        One or more; ``path`` itself where there is none, for `open_sequence` to refuse.

    Raises:
        ValueError: a folder that can't be read.
    """
    path = Path(path)
    if not path.is_dir():
        return [path]
    try:
        inside = sorted(path.iterdir(), key=lambda file: natural(file.name))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    clips = [each for each in inside if not each.name.startswith(".") and _layout_of(each) is not None]
    layout, has_video = _layout_of(path), any(each.suffix.lower() in VIDEO_SUFFIXES for each in clips)
    is_clip = layout is not None and not (layout.opens is folder.open_folder and has_video)  # a preview next to videos
    return [path] if is_clip or is_present(path / "camera.json") else clips or [path]


def _layout_of(path: Path) -> _Layout | None:
    return next((layout for layout in _LAYOUTS if layout.recognises(path)), None)


def _recognise(path: Path) -> _Layout:
    layout = _layout_of(path)
    if layout is not None:
        return layout
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    drives = sorted(drive.name for drive in path.glob("*_drive_*") if _is_kitti_raw(drive))
    if drives:
        raise ValueError(f"{path}: has KITTI raw drives; open one of {', '.join(drives)}")
    wanted = "; ".join(f"{layout.name}: {layout.looks_like}" for layout in _LAYOUTS)
    raise ValueError(f"{path}: unrecognised dataset layout. It looked for {wanted}")


def _with_depth(clip: Clip, where: Path, depth_scale: float | None) -> Clip:
    found = _named(where, clip, (".png", ".exr", ".npy"))

    def add(sample: Sample) -> Sample:
        file = DepthFile(found[sample.name], depth_scale)
        return replace(sample, depth=undistorted_depth(file, lens_of(sample.image)))

    return replace(clip, samples=tuple(map(add, clip)))


def _with_labels(clip: Clip, where: Path, label_ids: LabelKind) -> Clip:
    found = _named(where, clip, (".png",))

    def add(sample: Sample) -> Sample:
        file = LabelFile(found[sample.name], label_ids)
        return replace(sample, labels=undistorted_labels(file, lens_of(sample.image)))

    return replace(clip, samples=tuple(map(add, clip)))


def _named(where: Path, clip: Clip, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """A file for each frame."""
    found = by_name(where, suffixes)
    for sample in clip:
        if sample.name not in found:
            raise ValueError(f"{where}: has no {sample.name} ending in {', '.join(suffixes)}")
    return found
