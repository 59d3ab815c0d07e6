"""The knobs of a forecast, and the values that each is swept over."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.options import InferenceOptions

Setting = dict[str, Any]
"""Fields of `InferenceOptions` that differ from the defaults, and "size": the fraction of height and width that the
whole forecast is made at."""

#: As a network is loaded: everything is exact.
EXACT: Final[Setting] = {}

_OPTIONS: Final = tuple(field.name for field in fields(InferenceOptions))


@dataclass(frozen=True)
class Knob:
    """One quantity that is varied."""

    name: str
    about: str
    """What the values are."""
    values: dict[str, Setting]
    """The default first."""


def setting_of(options: InferenceOptions) -> Setting:
    """What ``options`` change."""
    default = InferenceOptions()
    return {name: getattr(options, name) for name in _OPTIONS if getattr(options, name) != getattr(default, name)}


def options_of(setting: Setting) -> InferenceOptions:
    """The options of ``setting``; its size is that of the input."""
    return InferenceOptions(**{name: value for name, value in setting.items() if name != "size"})


def describe(setting: Setting) -> str:
    """What differs from the defaults, in short."""
    names = (name for name in (*_OPTIONS, "size") if name in setting)
    return ", ".join(f"{name} {_text(setting[name])}" for name in names) or "exact"


def combinations(choices: Sequence[Sequence[Setting]]) -> list[Setting]:
    """Every way to take one of each of ``choices``, in order; where two change the same, the last one counts."""
    return [{name: value for one in chosen for name, value in one.items()} for chosen in itertools.product(*choices)]


def knobs(model: Forecaster) -> list[Knob]:
    """The knobs that the configuration of ``model`` has, with the values to try."""
    config, scales, off = model.config, (1.0, 0.75, 0.5), InferenceOptions().without_skips()
    skipping = {"on": EXACT, "frames seen are encoded anew": {"seen": False}, "off": setting_of(off)}
    found = [
        Knob("skipping", "what changes nothing is left out", skipping),
        _knob("min_transmittance", "points behind that are left out", (0.0, 0.001, 0.01, 0.03, 0.1, 0.3)),
        _knob("splat_scale", "fraction of the view's size that clouds are splatted at", scales),
        Knob("precision", "of encoder and refinement", {"float32": EXACT, "bfloat16": {"autocast": "bfloat16"}}),
        Knob("image size", "fraction of the size that all is computed at", _swept("size", scales)),
    ]
    if config.refine.base != "none":
        found.append(
            _knob("paint_scale", "fraction of the view's size that refinement is computed at", (*scales, 0.25))
        )
    objects = config.object_motion
    if objects is not None:
        count = len(objects.scales)
        found.append(
            _knob("blocks", f"the first of {count} blocks of object motion", (None, *range(count - 1, -1, -1)))
        )
    near = objects is not None and objects.where == "foreground"
    if near or config.encoder.background == "frame":
        about = "pixels around the foreground that are computed with it"
        found.append(_knob("margin", about, (None, 128, 64, 32, 16, 0)))
    if near:
        values = {"forecast anew": EXACT, "taken to stand": {"still": True}}
        found.append(Knob("still", "objects that were measured to be static", values))
    return found


def _knob(name: str, about: str, values: Iterable[Any]) -> Knob:
    return Knob(name, about, _swept(name, values))


def _swept(name: str, values: Iterable[Any]) -> dict[str, Setting]:
    return {_text(value): {name: value} if number else EXACT for number, value in enumerate(values)}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else "all" if value is None else f"{value:g}"
