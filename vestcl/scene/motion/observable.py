"""What of a flow an image can show: nothing on bare asphalt, and along a line nothing but the motion across it."""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from vestcl.scene.flow.parallax import pixel_centres
from vestcl.scene.motion.mask import lies_flat, rigid_pixels

#: Mean squared gradient, (grey levels of 0 to 1 a pixel)^2, at which half of a motion is trusted: that of asphalt and
#: of a camera's noise is a tenth of it, that of a facade 20 times as much.
_HALF: Final = 5e-5

#: Gradients are looked at over this many pixels of an image 832 wide (standard deviation).
_WIDTH, _WINDOW = 832, 2.5


def observable(flow_uv: NDArray[np.float32], image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(T + e I)^-1 T f, with T the structure tensor, the mean of grad I grad I^T around a pixel.

    The aperture problem: where all gradients have one direction, as on a lane line, only the motion along them is
    seen, and where there are none nothing is. What the flow is there, its smoothness made.

    Args:
        flow_uv: f [2, H, W] px.
        image: I [3, H, W] RGB in [0, 1], in which the flow starts.

    Returns:
        [2, H, W] px, no longer than f.

    Source: Lucas and Kanade, An Iterative Image Registration Technique, 1981, with a prior of no motion.
    """
    grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(image.transpose(1, 2, 0)), cv2.COLOR_RGB2GRAY), np.float32)
    right, down = (cv2.Scharr(grey, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    sigma = _WINDOW * max(grey.shape[1] / _WIDTH, 0.5)
    a, b, c = (cv2.GaussianBlur(product, (0, 0), sigma) for product in (right * right, right * down, down * down))
    determinant = (a + _HALF) * (c + _HALF) - b * b
    shown = a * c - b * b
    u, v = flow_uv
    along = (shown + _HALF * a) * u + _HALF * b * v, _HALF * b * u + (shown + _HALF * c) * v
    return np.stack([part / determinant for part in along]).astype(np.float32)


def on_the_road(
    flow_uv: NDArray[np.float32],
    image: NDArray[np.float32],
    depth: NDArray[np.float32],
    mask: NDArray[np.bool_],
    dst_from_src: NDArray[np.float64],
    K: NDArray[np.float64],
) -> NDArray[np.float32]:
    """``flow_uv``; on what is level the flow f of the camera's motion, and `observable` of what is beyond it.

    Lane markings and asphalt then stay part of the road: what flow shows of them beyond f is a guess. Shadows have
    edges, and what is on the road is not level.

    Args:
        flow_uv: [2, H, W] px, to another frame.
        image: [3, H, W] RGB in [0, 1].
        depth: [1, H, W] m, above 0.
        mask: M [1, H, W], True = static background; others are not changed.
        dst_from_src: [4, 4] m, the camera's motion to the other frame.
        K: [3, 3] px.
    """
    rigid = (rigid_pixels(depth, K, dst_from_src) - pixel_centres(*depth.shape[1:])).astype(np.float32)
    return np.where(mask & lies_flat(depth[0], K), rigid + observable(flow_uv - rigid, image), flow_uv)
