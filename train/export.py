"""A file that ships, of a checkpoint: ``python -m train.export runs/x/checkpoints/step-00001000 vest-s.safetensors``.

Weights are rounded to float16, which halves the file; they are read as float32 again.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import tyro

from train.command import ERRORS, failed
from vestcl import interrupt
from vestcl.cli import command_line
from vestcl.models.checkpoint import read_trained_on, write_checkpoint
from vestcl.models.forecaster import Forecaster
from vestcl.models.shipped import find_model


@dataclass(frozen=True)
class Export:
    """Round a model's weights to float16."""

    checkpoint: tyro.conf.Positional[Path]
    """A training checkpoint's folder, whose EMA is taken, or a model's file."""
    out: tyro.conf.Positional[Path]
    """The file to write, *.safetensors."""

    OUTPUT_FILES: ClassVar[tuple[str, ...]] = ("out",)


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; its exit status."""
    options = command_line.parsed(Export, "python -m train.export", __doc__, arguments)
    try:
        export(options.checkpoint, options.out)
    except ERRORS as error:
        return failed(error)
    return 0


def export(checkpoint: Path, out: Path) -> None:
    """Write ``out``.

    Args:
        checkpoint: as `vestcl.models.forecaster.Forecaster.from_pretrained` takes it.
        out: the file.

    Raises:
        FileNotFoundError: no such checkpoint.
        ValueError: a damaged one, or weights beyond what float16 holds.
    """
    model = Forecaster.from_pretrained(checkpoint)
    state = {name: tensor.half() for name, tensor in model.state_dict().items()}
    if beyond := [name for name, tensor in state.items() if not tensor.isfinite().all()]:
        raise ValueError(f"`checkpoint` must have weights below 65,504 for float16, got more in {', '.join(beyond)}")
    write_checkpoint(out, model.config, state, read_trained_on(find_model(checkpoint)))


if __name__ == "__main__":
    sys.exit(main())
