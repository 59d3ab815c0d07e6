"""One window of `vestcl bench forecast`: the methods that it compares. How they are scored is `vestcl.evaluation`'s.

Pictures are made at the clip's own size.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from vestcl.evaluation.methods import TRUE_POSES, Method, forecasts_of
from vestcl.evaluation.scores import GEOMETRIC, ORACLE, SOURCE, Prediction, Predictions, Record, Truth, look, score
from vestcl.evaluation.scores import distance as _distance
from vestcl.evaluation.scores import predictions as all_predictions
from vestcl.forecasting.geometric import Perception
from vestcl.forecasting.network import forecast as network
from vestcl.forecasting.result import Forecast, View
from vestcl.models.forecaster import Forecaster
from vestcl.models.networks.voxel_flow import VoxelFlowNetwork

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
        future_from_cur: the true motion of the camera a step, [4, 4] m, for a forecast that is given it.
        flow: the network of `vestcl.forecasting.peer`, as a baseline.
        models: trained networks, by the name of their row.

    Returns:
        The pictures, and the geometric forecast.
    """
    rows = {name: _method(model) for name, model in (models or {}).items()}
    forecasts = forecasts_of(perception, index, steps, views, rows, flow, future_from_cur)
    return all_predictions(truth, index, steps, views, forecasts), forecasts[GEOMETRIC].forecast


def _method(model: Forecaster) -> Method:
    return lambda perception, *asked: network.forecast_frames(perception, model, *asked)
