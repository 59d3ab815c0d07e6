"""Images without their border, as VEST-MPI's evaluation of novel views has them."""

import torch


def blacken_border(image: torch.Tensor, share: float) -> torch.Tensor:
    """The image with the outer round(share side) pixels of each of its sides black.

    Source: VEST-MPI "crops" 5 % like this, `apply_crop` in vest/losses/similarity.py of github.com/zzyunzhi/vest.

    Args:
        image: [..., H, W].
        share: of the height and of the width, 0 to below 0.5.

    Returns:
        The same shape.

    Raises:
        ValueError: another share.
    """
    if not 0 <= share < 0.5:
        raise ValueError(f"`share` must be 0 or more and below 0.5, got {share}")
    height, width = image.shape[-2:]
    rows, columns = round(height * share), round(width * share)
    inside = (..., slice(rows, height - rows), slice(columns, width - columns))
    inner = torch.zeros_like(image)
    inner[inside] = image[inside]
    return inner
