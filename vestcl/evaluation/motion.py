"""The camera's forecast motion compared with the true one."""

import numpy as np
import torch
from numpy.typing import NDArray

from vestcl.data import calibration
from vestcl.data.sample import Clip
from vestcl.evaluation import metrics
from vestcl.forecasting.result import Forecast


def true_motion(clip: Clip, index: int, steps: int) -> list[NDArray[np.float64]] | None:
    """future_from_cur = world_from_cam(t + k)^-1 world_from_cam(t) for k = 1 ... steps.

    Args:
        clip: frames with or without poses.
        index: the current frame t.
        steps: k's end; t + steps is a frame.

    Returns:
        [4, 4] m per step, or None where a pose is unknown.
    """
    poses = [sample.world_from_cam for sample in clip[index : index + steps + 1]]
    known = [pose for pose in poses if pose is not None]
    if len(known) < len(poses):
        return None
    return [calibration.invert(pose) @ known[0] for pose in known[1:]]


def ego_errors(forecast: Forecast, truth: list[NDArray[np.float64]]) -> dict[str, list[float]]:
    """`vestcl.evaluation.metrics.ego_motion_error` of ``future_from_cur``, step by step.

    Args:
        forecast: with ``future_from_cur``.
        truth: see `true_motion`.

    Returns:
        "rotation_deg" and "translation_percent"; the latter NaN where the car was static.
    """
    estimate, wanted = (torch.from_numpy(np.stack(motions)) for motions in (forecast.future_from_cur, truth))
    errors = metrics.ego_motion_error(estimate, wanted)
    return {name: values.tolist() for name, values in errors._asdict().items()}
