"""Files: images, depth, labels, OpenEXR and video. Arrays in, arrays out; every writer replaces its file atomically.

Readers raise ValueError, with the file's name first, for what is missing, damaged or of another kind.
"""

from vestcl.io.depth import read_cityscapes_disparity, read_depth, write_depth
from vestcl.io.exr import ExrFrame, read_exr, read_exr_frame, write_exr, write_exr_frame
from vestcl.io.images import image_size, read_image, read_pixels, to_float, to_pixels, write_image, write_pixels
from vestcl.io.labels import LabelKind, background, read_ego_vehicle, read_train_ids
from vestcl.io.video.reading import Video
from vestcl.io.video.writing import write_gif, write_mp4

__all__ = [
    "ExrFrame",
    "LabelKind",
    "Video",
    "background",
    "image_size",
    "read_cityscapes_disparity",
    "read_depth",
    "read_ego_vehicle",
    "read_exr",
    "read_exr_frame",
    "read_image",
    "read_pixels",
    "read_train_ids",
    "to_float",
    "to_pixels",
    "write_depth",
    "write_exr",
    "write_exr_frame",
    "write_gif",
    "write_image",
    "write_mp4",
    "write_pixels",
]
