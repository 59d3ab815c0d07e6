"""One window of `vestcl bench forecast`: the methods that it compares. How they are scored is `vestcl.scoring`'s.

Pictures are made at the clip's own size.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from vestcl import network, peer
from vestcl.forecast import Forecast, View
from vestcl.geometric import Perception, forecast_frames
from vestcl.models.forecaster import Forecaster
from vestcl.models.voxel_flow import VoxelFlowNetwork
from vestcl.scoring import GEOMETRIC, ORACLE, SOURCE, Prediction, Predictions, Record, Timed, Truth, look, score
from vestcl.scoring import predictions as all_predictions
from vestcl.scoring.pictures import distance as _distance

__all__ = [
    "GEOMETRIC",
    "ORACLE",
    "SOURCE",
    "TRUE_POSES",
    "Prediction",
    "Record",
    "Truth",
    "_distance",
    "look",
    "predict",
    "score",
]

#: The geometric forecast that is told how the camera moves.
TRUE_POSES: Final = "geometric, true poses"


def predict(
    perception: Perception,
    truth: Truth,
    index: int,
    steps: int,
    views: Sequence[View],
    future_from_cur: Sequence[NDArray[np.float64]] | None = None,
    flow: VoxelFlowNetwork | None = None,
    models: Mapping[str, Forecaster] | None = None,
) -> tuple[Predictions, Forecast]:
    """All methods on one window.

    Args:
        perception: of the clip; what it has seen for the window before is not computed again.
        truth: of the clip.
        index: the current frame t.
        steps: frames to forecast.
        views: cameras to judge from, each one of the rig's.
        future_from_cur: the true motion of the camera a step, [4, 4] m, for a forecast that is told it.
        flow: the network of `vestcl.peer`, as a baseline.
        models: trained networks, by the name of their row.

    Returns:
        The pictures, and the geometric forecast.
    """
    forecasts = _geometric(perception, index, steps, views, future_from_cur)
    if flow is not None:
        start, plain = time.perf_counter(), forecasts[GEOMETRIC]
        made = peer.forecast_frames(perception, flow, index, steps, views)
        looking = max(plain.seconds - plain.forecast.seconds["render"], 0.0) if "geometry" in made.seconds else 0.0
        forecasts |= {peer.METHOD: Timed(made, looking + time.perf_counter() - start)}
    for name, model in (models or {}).items():
        start, plain = time.perf_counter(), forecasts[GEOMETRIC]
        made = network.forecast_frames(perception, model, index, steps, views)
        looking = max(plain.seconds - plain.forecast.seconds["render"], 0.0)
        forecasts |= {name: Timed(made, looking + time.perf_counter() - start)}
    return all_predictions(truth, index, steps, views, forecasts), forecasts[GEOMETRIC].forecast


def _geometric(
    perception: Perception,
    index: int,
    steps: int,
    views: Sequence[View],
    future_from_cur: Sequence[NDArray[np.float64]] | None,
) -> dict[str, Timed]:
    """Forecasts and their seconds. The second one uses what the first has seen, and is charged for it, too."""
    start = time.perf_counter()
    plain = forecast_frames(perception, index, steps, views)
    seconds = time.perf_counter() - start
    forecasts = {GEOMETRIC: Timed(plain, seconds)}
    if future_from_cur is not None:
        start = time.perf_counter()
        told = forecast_frames(perception, index, steps, views, future_from_cur=future_from_cur)
        looking = max(seconds - plain.seconds["render"], 0.0)
        forecasts[TRUE_POSES] = Timed(told, looking + time.perf_counter() - start)
    return forecasts
