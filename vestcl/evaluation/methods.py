"""The methods that `vestcl bench forecast` and `train.evaluate` compare, on one window, with their seconds."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl.evaluation.scores import GEOMETRIC, Timed
from vestcl.forecasting import peer
from vestcl.forecasting.geometric import Perception, forecast_frames
from vestcl.forecasting.result import Forecast, View
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

#: The geometric forecast with the camera's true motion.
TRUE_POSES: Final = "geometric, true poses"

Method = Callable[[Perception, int, int, Sequence[View]], Forecast]
"""(perception, t, steps, cameras) -> forecast."""


def forecasts_of(
    perception: Perception,
    index: int,
    steps: int,
    views: Sequence[View],
    models: Mapping[str, Method],
    flow: VoxelFlowNetwork | None = None,
    future_from_cur: Sequence[NDArray[np.float64]] | None = None,
) -> dict[str, Timed]:
    """The geometric forecast, that with the true camera, the peer's, and each model's.

    All use what the first has seen, and are charged for it; the peer only where other cameras than the source are asked
    for, which is all that it needs it for.

    Args:
        perception: of the clip.
        index: the current frame t.
        steps: frames to forecast.
        views: cameras.
        models: networks, by the name of their row.
        flow: the network of `vestcl.forecasting.peer`; None leaves that row out.
        future_from_cur: [4, 4] m per step, the true motion of the camera; None leaves that row out.

    Returns:
        By the names of rows, in that order.
    """

    def timed(method: Method) -> Timed:
        start = time.perf_counter()
        made = method(perception, index, steps, views)
        return Timed(made, time.perf_counter() - start)

    made = {GEOMETRIC: timed(forecast_frames)}
    seen = max(made[GEOMETRIC].seconds - made[GEOMETRIC].forecast.seconds["render"], 0.0)
    others: dict[str, Method] = {}
    if future_from_cur is not None:
        others[TRUE_POSES] = lambda *asked: forecast_frames(*asked, future_from_cur=future_from_cur)
    if flow is not None:
        others[peer.METHOD] = lambda perception, *asked: peer.forecast_frames(perception, flow, *asked)
    for name, method in (others | dict(models)).items():
        own = timed(method)
        is_free = name == peer.METHOD and "geometry" not in own.forecast.seconds
        made[name] = Timed(own.forecast, own.seconds + (0.0 if is_free else seen))
    return made
