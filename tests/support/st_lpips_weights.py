"""ST-LPIPS's public file with random numbers in it."""

import numpy as np
import torch

from vestcl.evaluation.trunks.shift_tolerant import CHANNELS

#: Of the public file: layer -> the shape of its weight.
CONVOLUTIONS = {
    "net.slice1.0": (64, 3, 11, 11),
    "net.slice2.5": (192, 64, 5, 5),
    "net.slice3.9": (384, 192, 3, 3),
    "net.slice4.11": (256, 384, 3, 3),
    "net.slice5.13": (256, 256, 3, 3),
}
BLURS = {"net.slice1.1": 64, "net.slice2.4": 64, "net.slice3.8": 192}


def public_state(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights by the names of the public file."""
    draw = torch.Generator().manual_seed(seed)
    state = {"scaling_layer.shift": torch.tensor([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1)}
    state["scaling_layer.scale"] = torch.tensor([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1)
    row = torch.tensor([1.0, 2.0, 1.0])
    state |= {f"{name}.filt": (row[:, None] * row / 16).repeat(size, 1, 1, 1) for name, size in BLURS.items()}
    for name, shape in CONVOLUTIONS.items():
        state[f"{name}.weight"] = torch.randn(shape, generator=draw) * (2 / np.prod(shape[1:])) ** 0.5
        state[f"{name}.bias"] = torch.randn(shape[0], generator=draw) / 10
    for layer, size in enumerate(CHANNELS):
        state[f"lin{layer}.model.1.weight"] = torch.rand(1, size, 1, 1, generator=draw)
    return state
