"""The knobs of a forecast, and the values that each is swept over."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.options import InferenceOptions

Setting = dict[str, Any]
"""How a forecast is computed, as far as it differs from the defaults: {"skip": {...}, "effort": {...}, "autocast":
"bfloat16" (of encoder and refinement), "size": fraction of height and width that the whole forecast is made at}."""

#: As a network is loaded: everything is exact.
EXACT: Final[Setting] = {}


def setting_of(options: InferenceOptions) -> Setting:
    """What ``options`` change."""
    own, default = options.as_dict(), InferenceOptions().as_dict()
    changed: Setting = {"autocast": options.autocast} if options.autocast else {}
    for name in ("skip", "effort"):
        if parts := {key: value for key, value in own[name].items() if value != default[name][key]}:
            changed[name] = parts
    return changed


@dataclass(frozen=True)
class Knob:
    """One quantity that is varied."""

    name: str
    about: str
    """What the values are."""
    values: dict[str, Setting]
    """The default first."""


def _efforts(name: str, values: Iterable[Any]) -> dict[str, Setting]:
    return {_text(value): {"effort": {name: value}} if number else EXACT for number, value in enumerate(values)}


def _text(value: Any) -> str:
    return "all" if value is None else f"{value:g}"


def knobs(model: Forecaster) -> list[Knob]:
    """The knobs that the configuration of ``model`` has, with the values to try."""
    transmittances, scales = (0.0, 0.001, 0.01, 0.03, 0.1, 0.3), (1.0, 0.75, 0.5)
    off = setting_of(InferenceOptions().without_skips())
    sizes = {_text(scale): {"size": scale} if scale < 1 else EXACT for scale in scales}
    skipping = {"on": EXACT, "frames seen are encoded anew": {"skip": {"seen": False}}, "off": off}
    found = [
        Knob("skipping", "what changes nothing is left out", skipping),
        Knob("min_transmittance", "points behind that are left out", _efforts("min_transmittance", transmittances)),
        Knob("splat_scale", "fraction of the view's size that clouds are splatted at", _efforts("splat_scale", scales)),
        Knob("precision", "of encoder and refinement", {"float32": EXACT, "bfloat16": {"autocast": "bfloat16"}}),
        Knob(
            "image size",
            "fraction of the size that all is computed at",
            sizes,
        ),
    ]
    config = model.config
    if config.refine.base != "none":
        about = "fraction of the view's size that refinement is computed at"
        found.append(Knob("paint_scale", about, _efforts("paint_scale", (*scales, 0.25))))
    if config.object_motion is not None:
        count = len(config.object_motion.scales)
        about = f"the first of {count} blocks of object motion"
        found.append(Knob("blocks", about, _efforts("blocks", (None, *range(count - 1, -1, -1)))))
    if config.encoder.background == "frame" or (config.object_motion and config.object_motion.where == "foreground"):
        margins = {"all": EXACT} | {_text(margin): {"skip": {"margin": margin}} for margin in (128, 64, 32, 16, 0)}
        found.append(Knob("margin", "pixels around the foreground that are computed with it", margins))
    if config.object_motion is not None and config.object_motion.where == "foreground":
        values = {"forecast anew": EXACT, "taken to stand": {"skip": {"still": True}}}
        found.append(Knob("still", "objects that were measured to be static", values))
    return found


def combined(settings: Sequence[Setting]) -> Setting:
    """All that ``settings`` change, at once; where two change the same, the last one counts."""
    result: Setting = {}
    for setting in settings:
        for name, value in setting.items():
            result[name] = result.get(name, {}) | value if isinstance(value, dict) else value
    return result


def combinations(choices: Sequence[Sequence[Setting]]) -> list[Setting]:
    """Every way to take one of each of ``choices``, in order."""
    return [combined(chosen) for chosen in itertools.product(*choices)]


def describe(setting: Setting) -> str:
    """What differs from the defaults, in short."""
    parts = {name: setting[name] for name in ("autocast", "size") if name in setting}
    flat = setting.get("skip", {}) | setting.get("effort", {}) | parts
    words = (f"{name} {value if isinstance(value, str) else _text(value)}" for name, value in flat.items())
    return ", ".join(words) or "exact"
