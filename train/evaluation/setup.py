"""All that the scores of a window depend on, besides its frames."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field

from train.evaluation.inputs import Preprocessing
from train.evaluation.protocols import Protocol
from vestcl.evaluation.perceptual import Lpips, StLpips
from vestcl.evaluation.trunks.trunks import Trunk
from vestcl.forecasting.network.later_frames import LaterFrames, Perceived, later_frames
from vestcl.forecasting.network.learned import Learned
from vestcl.models.forecaster import Forecaster, Mode
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork


@dataclass(frozen=True, eq=False)
class Setup:
    """All that a window's scores depend on, besides its frames."""

    protocol: Protocol
    size: tuple[int, int]
    """(height, width) px of what is forecast and scored."""
    steps: int
    models: Mapping[str, Forecaster]
    """By the name that tables give them."""
    mode: Mode | None = None
    """How models make steps after the first; None is each one's default."""
    stereo: bool = False
    """Depth from the stereo pair although the clip has depth, see `train.evaluation.inputs.depths`."""
    trunk: Trunk | None = None
    """SqueezeNet 1.0."""
    lpips: Lpips | None = None
    st_lpips: StLpips | None = None
    peer: VoxelFlowNetwork | None = None
    """The learned 2D baseline, `vestcl.forecasting.peer`."""
    preprocessing: Preprocessing = field(default_factory=Preprocessing)
    perceive: Perceived | None = None
    """Where depth and mask of forecast frames come from, of models whose mode is "feedback"."""
    learned: Learned = "tested"
    """Which learned parts count, see `vestcl.forecasting.network.forecast.forecast_frames`."""

    @property
    def modes(self) -> dict[str, Mode]:
        """How each model makes steps after the first."""
        return {name: later.mode for name, later in self.later.items()}

    @functools.cached_property
    def later(self) -> dict[str, LaterFrames]:
        """How each model makes steps after the first, and what it sees of its forecast.

        Raises:
            ValueError: `perceive` without a model of mode "feedback", or "estimated" without an estimator.
        """
        modes = {name: self.mode or model.config.default_mode for name, model in self.models.items()}
        if self.perceive is not None and not modes:
            raise ValueError("`perceive` is how a network sees its own forecast; it needs `model`")
        mixed, how = "feedback" in modes.values(), self.preprocessing
        chosen = {name: None if mixed and mode == "compose" else self.perceive for name, mode in modes.items()}
        return {
            name: later_frames(model.config, modes[name], chosen[name], *how.estimators, how.inpainter)
            for name, model in self.models.items()
        }
