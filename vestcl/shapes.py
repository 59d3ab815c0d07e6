"""Checks of arguments at public boundaries: tensors' shapes, and what is a number."""

from numbers import Integral, Real
from typing import Any

import torch


def is_whole(value: Any) -> bool:
    """Whether it is a whole number, of Python or of NumPy; a truth value is none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_real(value: Any) -> bool:
    """Whether it is a number, of Python or of NumPy; a truth value is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check(**arguments: tuple[torch.Tensor, str]) -> dict[str, int]:
    """Check a network's arguments against their shapes; the sizes that the letters denote.

    Args:
        **arguments: name = (tensor, shape), with the shape as words: a number is that size, a letter must mean the
            same size, one or more, in all arguments (``mask_cur=(mask_cur, "B 1 H W")``).

    Returns:
        letter -> size.

    Raises:
        ValueError: no tensor of floating-point numbers, or one that does not fit its shape.
    """
    sizes: dict[str, int] = {}
    for name, (value, shape) in arguments.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            got = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise ValueError(f"`{name}` must be a floating-point tensor, got {got}")
        words = [int(word) if word.isdigit() else sizes.get(word, word) for word in shape.split()]
        fits = len(words) == value.ndim and all(
            size == word if isinstance(word, int) else size > 0 for word, size in zip(words, value.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"`{name}` must be [{', '.join(map(str, words))}], got {list(value.shape)}")
        sizes |= {word: size for word, size in zip(shape.split(), value.shape, strict=True) if not word.isdigit()}
    return sizes
