"""Inference presets of a network: three points on the speed-accuracy curve.

    exact      float32; skips what changes nothing but rounding
    balanced   the knees that cost at most 0.1 dB of PSNR: what was measured as static is static, two blocks correct the
               motion of what does not, details are refined at half the size
    fast       beyond them: details at a quarter of it, objects move as measured; realtime computes alike

`vestcl bench pareto` measures the curve; docs/time_against_error has it, and the points chosen.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from vestcl import constants
from vestcl.models.inference.options import BALANCED, EXACT, FAST, InferenceOptions
from vestcl.models.inference.processor import computes_bfloat16, keep_freed_memory

if TYPE_CHECKING:  # a forecast without a network imports neither these nor what downloads them
    from vestcl.models.forecaster import Forecaster
    from vestcl.models.inference.fast import FastForecaster

Quality = constants.Quality

#: Those that differ in how a network computes, best first.
LEVELS: Final[tuple[Quality, ...]] = ("exact", "balanced", "fast")

#: Default of `vestcl forecast`: its loss of quality is not visible.
USUAL: Final[Quality] = "balanced"

#: The largest PSNR drop of a level against "exact" to the true next frame, dB, mean over streets.
LOSS: Final[dict[Quality, float]] = {"exact": 0.0, "balanced": 0.1, "fast": 0.5}


_PRESETS: Final[dict[Quality, InferenceOptions]] = {
    "exact": EXACT,
    "balanced": BALANCED,
    "fast": FAST,
    "realtime": FAST,
}


def settings(quality: Quality) -> InferenceOptions:
    """The preset of that name.

    Args:
        quality: one of `vestcl.constants.LEVELS`.

    Returns:
        Options, as `Forecaster` has them.

    Raises:
        ValueError: another word.
    """
    if quality not in _PRESETS:
        raise ValueError(f"`quality` must be one of {', '.join(_PRESETS)}, got {quality!r}")
    return _PRESETS[quality]


def about(quality: Quality) -> dict[str, Any]:
    """What a file contains of it: {"quality": ..., "skip": {...}, "effort": {...}, "autocast": name or None}.

    Raises:
        ValueError: another word.
    """
    return {"quality": quality, **settings(quality).as_dict()}


def apply(model: "Forecaster", quality: Quality) -> "Forecaster":
    """Let ``model`` forecast at ``quality`` from now on; its weights stay as they are.

    bfloat16 is for processors that compute in it: elsewhere it costs time, and float32 stays. Where the network
    predicts RGB directly (`RefineConfig.base` "none"), refinement stays at full size.

    Args:
        model: a trained network.
        quality: one of `LEVELS`.

    Returns:
        ``model``.

    Raises:
        ValueError: another word.
    """
    options = settings(quality)
    if model.config.refine.base == "none":
        options = replace(options, paint_scale=1.0)
    model.options = options if computes_bfloat16() else replace(options, autocast=None)
    return model


def load(name_or_path: str | Path, quality: Quality) -> "FastForecaster":
    """A trained network as commands use it: at ``quality``, laid out for inference; the process keeps what it frees.

    Args:
        name_or_path: see `vestcl.models.forecaster.Forecaster.from_pretrained`.
        quality: one of `LEVELS`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such model, a damaged file, or another word.
    """
    from vestcl.models.forecaster import Forecaster
    from vestcl.models.inference.fast import accelerate

    keep_freed_memory()
    model = apply(Forecaster.from_pretrained(name_or_path), quality)
    return accelerate(model, "bfloat16" if model.options.autocast else "float32")
