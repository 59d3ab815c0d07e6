"""What `vestcl forecast` loads once: the network, estimators, the method of inpainting, and networks that score."""

from typing import TYPE_CHECKING, NamedTuple

from vestcl.cli import commands
from vestcl.cli.clip import Estimators, load_estimators
from vestcl.evaluation.perceptual import StLpips
from vestcl.evaluation.trunks.trunks import Trunk, load_trunk
from vestcl.forecasting.api import WorkWidth, width_of
from vestcl.forecasting.network.later_frames import LaterFrames, later_frames
from vestcl.models.inference import quality
from vestcl.scene.inpainting.inpainters import Inpainter, inpainter

if TYPE_CHECKING:
    from vestcl.models.forecaster import Forecaster


class Setup(NamedTuple):
    """What options name; None is not given."""

    model: "Forecaster | None"
    later: LaterFrames | None
    """How the network makes steps after the first."""
    inpaint: Inpainter | None
    estimators: Estimators
    trunk: Trunk | None
    st_lpips: StLpips | None

    @property
    def by_geometry(self) -> "Setup":
        """The same without the network."""
        return self._replace(model=None, later=None)


def work_width(options: commands.Forecast) -> int | None:
    """Px, None is the clip's own: what --work-width says, else the preset's."""
    asked: WorkWidth = "preset" if options.work_width is None else options.work_width or None
    return width_of(asked, options.quality or quality.USUAL)


def load(options: commands.Forecast) -> Setup:
    """Load what ``options`` name.

    Raises:
        ValueError: a file that is missing or holds something else, or options that exclude each other.
    """
    model = None if options.model is None else quality.load(options.model, options.quality or quality.USUAL)
    estimators = load_estimators(options.depth_model, options.mask_model)
    inpaint = None if options.inpaint is None else inpainter(options.inpaint, "inpaint")
    chosen = options.mode, options.perceive, *estimators, inpaint
    later = None if model is None else later_frames(model.config, *chosen)
    trunk = None if options.squeeze is None else load_trunk("squeezenet1_0", options.squeeze)
    st_lpips = None if options.st_lpips is None else StLpips.load(options.st_lpips)
    return Setup(model, later, inpaint, estimators, trunk, st_lpips)
