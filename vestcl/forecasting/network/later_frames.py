"""How a network forecasts the frames after the first, as the commands' options choose it."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vestcl.models.config import Mode, ModelConfig
from vestcl.models.steps.perceive import Perceive, perceive_estimated, perceive_forecast
from vestcl.scene.inpainting.inpainters import Inpainter

Perceived = Literal["splatted", "estimated"]
"""Where the depth and the mask of a forecast frame come from when it is an input of the next step."""

DepthOf = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""[3, H, W] RGB in [0, 1] -> [1, H, W] m, 0 = unknown."""

ClassesOf = Callable[[NDArray[np.float32]], NDArray[np.uint8]]
"""[3, H, W] RGB in [0, 1] -> [1, H, W] Cityscapes train ids."""


@dataclass(frozen=True, eq=False)
class LaterFrames:
    """The choice."""

    mode: Mode
    perceived: Perceived | None
    """None with mode "compose", which perceives nothing."""
    perceive: Perceive | None
    """For `vestcl.models.forecaster.Forecaster.forecast`; None is its default."""

    @property
    def settings(self) -> dict[str, Any]:
        """As forecast.json and results.json list it."""
        return {"mode": self.mode, "perceive": self.perceived}

    def __str__(self) -> str:
        """ "compose", "feedback, perceive splatted"."""
        return self.mode if self.perceived is None else f"{self.mode}, perceive {self.perceived}"


def later_frames(
    config: ModelConfig,
    mode: Mode | None,
    perceived: Perceived | None,
    depth: DepthOf | None = None,
    segmentation: ClassesOf | None = None,
    inpaint: Inpainter | None = None,
) -> LaterFrames:
    """What options mean for a model.

    Args:
        config: of the model; has the default mode.
        mode: the option; None takes that default.
        perceived: the option; None is "estimated" if there is an estimator, else "splatted".
        depth: the depth estimator, if one was asked for; one whose ``metric`` is False is not used for forecast frames.
        segmentation: the estimator of classes, if one was asked for.
        inpaint: the method of inpainting, if one was asked for.

    Returns:
        The choice.

    Raises:
        ValueError: ``perceived`` with mode "compose", or "estimated" without any estimator.
    """
    mode = mode or config.default_mode
    if mode == "compose":
        if perceived is not None:
            raise ValueError(f'`perceive` must not be given with mode "compose", got {perceived!r}: --mode feedback')
        return LaterFrames(mode, None, None)
    if not getattr(depth, "metric", True):
        depth = None  # without a unit: the splatted depth is in metres
    has_estimator = depth is not None or segmentation is not None
    if perceived == "estimated" and not has_estimator:
        raise ValueError('`perceive` "estimated" needs --depth-model (in metres), --mask-model or both')
    perceived = perceived or ("estimated" if has_estimator else "splatted")
    if perceived == "estimated":
        return LaterFrames(mode, perceived, perceive_estimated(depth, segmentation, inpaint))
    perceive = None if inpaint is None else functools.partial(perceive_forecast, inpaint=inpaint)
    return LaterFrames(mode, perceived, perceive)
