"""A video file without calibration: a pinhole camera of a stated field of view, principal point in the middle.

A pixel's width over its height is the file's sample aspect ratio a: fy = a fx.
"""

from pathlib import Path
from typing import Final

from vestcl.data.calibration import intrinsics_from_fov
from vestcl.data.sample import Clip, Sample
from vestcl.data.sources import VideoFrame
from vestcl.io.video.reading import Video

#: Horizontal field of view in degrees where none is given: between dashboard cameras that are sold as wide (their
#: 120 to 140 degrees are diagonal, with distortion) and a telephone's main camera (65).
FOV: Final = 60.0


def open_video(path: str | Path, fov: float = FOV) -> Clip:
    """A video's frames.

    Args:
        path: any file that FFmpeg decodes.
        fov: horizontal field of view in degrees, between 0 and 180.

    Raises:
        ValueError: no such file, not decodable, or no such field of view.
    """
    video = Video(path)
    K = intrinsics_from_fov(fov, video.height, video.width)
    K[1, 1] *= video.pixel_aspect
    samples = (Sample(f"{i:06}", VideoFrame(video, i), K, timestamp=float(t)) for i, t in enumerate(video.seconds))
    return Clip(Path(path).stem, "video", tuple(samples))
