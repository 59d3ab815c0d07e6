"""What of an image is still one surface in another view, and how far it is stretched there (kernels/stretch.cl)."""

import numpy as np
import torch

from vestcl import constants, opencl
from vestcl.ops._arguments import Array, as_array, check_arguments, work_items
from vestcl.ops._autograd import untraced


@untraced
def stretch(points_uv: Array, magnified: Array) -> tuple[Array, Array]:
    """How much farther apart than magnified an image's points come to lie, and which are torn from all neighbours.

        h = min(|uv - uv_left|, |uv - uv_right|),   v = min(|uv - uv_above|, |uv - uv_below|)
        each counts where it is below TORN max(m, 1), or where both of its gaps are below SLANTED m^2
        factor = max(1, max(h, v) / m),   opacity = 1 where h or v counts or the image is one pixel, else 0

    Rows of a plane shear: where the steps to both sides differ by less than BENT of their means r, from left to right,
    and d, downwards, v is |r x d| / |r| as far as |r| counts and v is below the larger limit; h likewise.

    A surface that turns towards the camera is stretched by more than what it comes nearer by. Of the neighbours at
    either side the nearer one counts, of both directions the wider gap.

    Args:
        points_uv: [B, H, W, 2] px, where the view shows the image's pixels; a gap to what is not finite does not
            count. Torch CPU tensor or NumPy array, float32 or float64.
        magnified: m [B, H, W] px, the size that a pixel has in the view. Of the same kind and dtype.

    Returns:
        factor and opacity [B, H, W], of the kind and dtype that came in. They have no gradient.

    Raises:
        ValueError: an argument of another kind, dtype or shape.
        DeviceError: no OpenCL device, or one without float64 where that is asked for.

    Source: `constants.TORN`, `SLANTED`, `BENT`; Zwicker et al., Surface Splatting, SIGGRAPH 2001, has the
    footprint's general form.
    """
    check_arguments(points_uv=(points_uv, "B H W 2"), magnified=(magnified, "B H W"))
    factor, opacity = _stretch(opencl.current(), as_array(points_uv), as_array(magnified))
    if isinstance(points_uv, torch.Tensor):
        return torch.from_numpy(factor), torch.from_numpy(opacity)
    return factor, opacity


def _stretch(session: opencl.Session, points_uv: np.ndarray, magnified: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    batch, height, width = magnified.shape
    factor, opacity = np.empty_like(magnified), np.empty_like(magnified)
    if magnified.size:
        chunk, items, group = work_items(session, width)
        with session.job() as job:
            arguments: opencl.Arguments = {
                "height": np.int32(height),
                "width": np.int32(width),
                "chunk": chunk,
                "points_uv": job.read(points_uv),
                "magnified": job.read(magnified),
                "factor": job.write(factor),
                "opacity": job.write(opacity),
            }
            limits = {name: str(getattr(constants, name)) for name in ("TORN", "SLANTED", "BENT")}
            defines = opencl.defines_for(magnified.dtype, **limits)
            job.launch("stretch.cl", "stretch", defines, (items, height, batch), arguments, (group, 1, 1))
    return factor, opacity
