"""Where depth, masks, camera motion and inpainting of a clip's frames come from, in words, for tables and caches."""

from dataclasses import asdict, dataclass
from typing import Any, Final

from vestcl.data.readers.kitti_raw import ACCUMULATED, VelodyneScan
from vestcl.data.sample import Clip, Sample
from vestcl.data.sources import DepthFile, DepthSource, DisparityFile
from vestcl.data.street.clip import StreetDepth
from vestcl.data.street.sensors import DisturbedLabels, StreetScan
from vestcl.scene.inpainting.inpaint import DEFAULT

#: Depth that is matched where a frame has no other, and a right camera.
PAIR: Final = "the stereo pair at t-1 and t"

#: How the camera's motion is measured, at least.
_BY_FLOW: Final = "optical flow"

#: Depth maps that no camera has at time t.
_ACCUMULATED: Final = "KITTI's depth maps, accumulated from scans of frames around each, later ones among them"

#: What a clip's own depth is, by its class.
_OWN: Final[tuple[tuple[type, str], ...]] = (
    (VelodyneScan, "laser scans, densified"),
    (StreetDepth, "the street itself, true"),
    (StreetScan, "laser scans simulated from the street's depth, densified"),
    (DisparityFile, "disparity files, matched in the stereo pair"),
)


@dataclass(frozen=True)
class Inputs:
    """The sources, as sentences list them."""

    depth: str
    masks: str
    motion: str
    """Source of the camera's motion up to t."""
    inpainting: str
    stereo: bool = False
    """Whether a depth is matched against the right camera's image at the same time."""

    @property
    def by_flow(self) -> bool:
        """Whether the camera's motion is from optical flow only, without any depth."""
        return self.motion == _BY_FLOW

    @classmethod
    def read(cls, entries: Any) -> "Inputs":
        """What `as_entries` gave.

        Raises:
            ValueError: entries of other names or types.
        """
        wanted = {"depth": str, "masks": str, "motion": str, "inpainting": str, "stereo": bool}
        if not isinstance(entries, dict) or {k: type(v) for k, v in entries.items()} != wanted:
            raise ValueError(f"`inputs` must have {', '.join(wanted)}, got {str(entries)[:80]}")
        return cls(**entries)

    def as_entries(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def inputs_of(
    clip: Clip, *, depth_model: str | None = None, mask_model: str | None = None, inpaint: str | None = None
) -> Inputs:
    """What `vestcl.forecasting.geometric.Perception` takes for the frames of a clip.

    Args:
        clip: as it is given to perception, with estimates in place.
        depth_model: the estimator of its depth, as it was asked for.
        mask_model: the same of its classes.
        inpaint: the method of inpainting, as it was asked for; None is the default.
    """
    labelled = all(sample.labels is not None for sample in clip)
    disturbed = any(isinstance(sample.labels, DisturbedLabels) for sample in clip)
    own_labels = "labels, with a classifier's errors simulated" if disturbed else "labels"
    classes = own_labels if mask_model is None else f"the classes of {mask_model}"
    depth = f"the estimator {depth_model}" if depth_model is not None else _depth(clip)
    own = any(sample.depth is not None for sample in clip)
    motion = _BY_FLOW + (" and depth" if own or is_stereo(clip) else "")
    return Inputs(depth, classes if labelled else "motion", motion, inpaint or DEFAULT, is_stereo(clip))


def is_stereo(clip: Clip) -> bool:
    """Whether a frame's depth is matched in its stereo pair: by vestcl, without another source, or in its file."""
    return any(is_matched(sample) or _is_pair(sample) for sample in clip)


def is_matched(sample: Sample) -> bool:
    """Whether a frame's own depth is from disparity files, which were matched in the stereo pair."""
    return isinstance(sample.depth, DisparityFile)


def _is_pair(sample: Sample) -> bool:
    return sample.depth is None and sample.right is not None


def _depth(clip: Clip) -> str:
    """The sources of its frames: "laser scans, densified, where there are any, else motion"."""
    words = list(dict.fromkeys(_own(sample.depth) for sample in clip if sample.depth is not None))
    bare = [sample for sample in clip if sample.depth is None]
    if bare:
        pair = any(map(_is_pair, bare))
        words.append(PAIR if pair else "motion")
    return ", where there are any, else ".join(words)


def _own(depth: DepthSource) -> str:
    if isinstance(depth, DepthFile) and depth.path.parts[-len(ACCUMULATED) - 2 : -2] == ACCUMULATED:
        return _ACCUMULATED
    return next((words for kind, words in _OWN if isinstance(depth, kind)), "depth files")
