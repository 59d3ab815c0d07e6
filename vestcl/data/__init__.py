"""Where frames come from: the procedural street, and one reader per data set, which `open.open_sequence` chooses."""

from vestcl.data.street.clip import street_clip
from vestcl.data.street.raycast import STREET_SKY_DEPTH, Frame, Label
from vestcl.data.street.street import Street, intrinsics

__all__ = ["STREET_SKY_DEPTH", "Frame", "Label", "Street", "intrinsics", "street_clip"]
