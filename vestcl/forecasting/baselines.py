"""Forecasts with neither depth nor weights, to compare with the real one: repeat the last frame, extrapolate flow.

Both take the two last frames and answer with [B, steps, 3, H, W]: the frames at t+1 to t+steps.
"""

import torch

from vestcl.scene.flow.optical_flow import backward_warp, optical_flow
from vestcl.shapes import check


def repeat_last(frame_prev: torch.Tensor, frame_cur: torch.Tensor, steps: int) -> torch.Tensor:
    """I_(t+k) = I_t.

    Args:
        frame_prev: [B, 3, H, W], at t-1; not looked at.
        frame_cur: [B, 3, H, W], at t.
        steps: frames to forecast, 1 or more.

    Returns:
        [B, steps, 3, H, W], a view of ``frame_cur``.

    Raises:
        ValueError: shapes don't fit, or no steps.
    """
    _check(frame_prev, frame_cur, steps)
    return frame_cur[:, None].expand(-1, steps, -1, -1, -1)


def flow_extrapolation(
    frame_prev: torch.Tensor, frame_cur: torch.Tensor, steps: int, *, elapsed: float = 1.0
) -> torch.Tensor:
    """I_(t+k)(p) = I_t(p + b_k(p)) with the motion b_k from t+k back to t at constant velocity.

    f(p) is the flow from t to t-1 (OpenCV's DIS), divided by ``elapsed``. The flow at each position of the image stays
    constant: b_1 = f, b_(k+1)(p) = b_k(p) + f(p + b_k(p)), a streamline followed backwards. Nothing is left empty. That
    holds where a camera drives through a static scene, as what comes to a position of the image next is about as deep
    as what is there now, and it is right to second order there.

    Where p + b_k(p) is outside the image, its border is repeated.

    Args:
        frame_prev: [B, 3, H, W] in [0, 1], RGB, at t-1.
        frame_cur: [B, 3, H, W] in [0, 1], RGB, at t.
        steps: frames to forecast, 1 or more.
        elapsed: intervals from t-1 to t; a step is one interval.

    Returns:
        [B, steps, 3, H, W]; no gradient.

    Raises:
        ValueError: shapes don't fit, an image below FLOW_SIDE, no steps, or ``elapsed`` is not above 0.

    Source: SPEC section 10; Kroeger et al., Fast Optical Flow using Dense Inverse Search, 2016.
    """
    _check(frame_prev, frame_cur, steps)
    if not elapsed > 0:
        raise ValueError(f"`elapsed` must be above 0, got {elapsed}")
    with torch.no_grad():
        prev_from_cur = optical_flow(frame_cur, frame_prev) / elapsed
        back, frames = torch.zeros_like(prev_from_cur), []
        for _ in range(steps):
            back = back + backward_warp(prev_from_cur, back)
            frames.append(backward_warp(frame_cur, back))
        return torch.stack(frames, dim=1)


def _check(frame_prev: torch.Tensor, frame_cur: torch.Tensor, steps: int) -> None:
    check(frame_prev=(frame_prev, "B 3 H W"), frame_cur=(frame_cur, "B 3 H W"))
    if steps < 1:
        raise ValueError(f"`steps` must be 1 or more, got {steps}")
