"""The backward pass of a `Forecaster`, stage by stage."""

import itertools
import time
from collections.abc import Iterator
from typing import Any

import torch

from vestcl.stages import REST


class BackwardWatch:
    """Seconds of the backward pass by stage.

    On a CPU autograd runs the last operation's gradient first. So a stage's backward begins when the gradient of one of
    its results is there, and lasts until that of an earlier stage's result is. What comes before the first is the
    loss's; rigid flow, between EMF and OMF, counts as OMF's.
    """

    def __init__(self) -> None:
        self._began: list[tuple[float, str]] = []

    def seen(self, name: str, result: Any) -> None:
        """Watch for the gradients of a stage's results; for `vestcl.stages.watched`."""
        for tensor in _tensors(result):
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


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """Those in tuples and lists, however deep."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _tensors(part)
