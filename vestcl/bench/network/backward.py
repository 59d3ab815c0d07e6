"""The backward pass of a `Forecaster`, stage by stage."""

import itertools
import time
from typing import Any

import torch

from vestcl.models.inference.stage_times import REST
from vestcl.models.networks.layers import tensors_in


class BackwardWatch:
    """Seconds of the backward pass by stage.

    On a CPU autograd runs the last operation's gradient first. So a stage's backward begins when the gradient of one of
    its results is there, and lasts until that of an earlier stage's result is. What comes before the first is the
    loss's; rigid flow, between EMF and OMF, counts as OMF's.
    """

    def __init__(self) -> None:
        self._began: list[tuple[float, str]] = []

    def seen(self, name: str, result: Any) -> None:
        """Watch for the gradients of a stage's results; for `vestcl.models.inference.stage_times.watching`."""
        for tensor in tensors_in(result):
            if tensor.requires_grad:
                tensor.register_hook(lambda _: self._began.append((time.perf_counter(), name)))

    def backward(self, loss: torch.Tensor) -> dict[str, float]:
        """loss.backward(); seconds by stage, and of the loss as REST."""
        self._began = [(time.perf_counter(), REST)]
        loss.backward()
        began, seconds = [*self._began, (time.perf_counter(), REST)], dict[str, float]()
        for (start, name), (end, _) in itertools.pairwise(began):
            seconds[name] = seconds.get(name, 0.0) + end - start
        return seconds
