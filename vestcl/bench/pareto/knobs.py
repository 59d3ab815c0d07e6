"""The knobs of a forecast, and the values that each is swept over."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from vestcl.models.forecaster import Forecaster
from vestcl.models.inference.effort import Effort
from vestcl.models.inference.skipping import NOTHING, Skip


@dataclass(frozen=True)
class Setting:
    """How a forecast is computed."""

    skip: Skip = field(default_factory=Skip)
    effort: Effort = field(default_factory=Effort)
    autocast: str | None = None
    """"bfloat16", of encoder and refinement; None is the parameters' own float32."""
    size: float = 1.0
    """The whole forecast is made at this fraction of height and width, and enlarged."""

    def plain(self) -> dict[str, Any]:
        """What differs from the defaults, as JSON has it."""
        parts = {"skip": (self.skip, Skip()), "effort": (self.effort, Effort())}
        changed: dict[str, Any] = {
            name: {key: value for key, value in vars(own).items() if value != getattr(default, key)}
            for name, (own, default) in parts.items()
        }
        changed |= {"autocast": self.autocast} if self.autocast else {}
        changed |= {"size": self.size} if self.size != 1 else {}
        return {name: value for name, value in changed.items() if value}


#: As a network is loaded: everything is exact.
EXACT: Final = Setting()


@dataclass(frozen=True)
class Knob:
    """One quantity that is varied."""

    name: str
    about: str
    """What the values are."""
    values: dict[str, Setting]
    """The default first."""


def _efforts(name: str, values: Iterable[Any]) -> dict[str, Setting]:
    return {_text(value): Setting(effort=replace(Effort(), **{name: value})) for value in values}


def _text(value: Any) -> str:
    return "all" if value is None else f"{value:g}"


def knobs(model: Forecaster) -> list[Knob]:
    """The knobs that the configuration of ``model`` has, with the values to try."""
    transmittances, scales = (0.0, 0.001, 0.01, 0.03, 0.1, 0.3), (1.0, 0.75, 0.5)
    skipping = {"on": EXACT, "frames seen are encoded anew": Setting(Skip(seen=False)), "off": Setting(NOTHING)}
    found = [
        Knob("skipping", "what changes nothing is left out", skipping),
        Knob("min_transmittance", "points behind that are left out", _efforts("min_transmittance", transmittances)),
        Knob("splat_scale", "fraction of the view's size that clouds are splatted at", _efforts("splat_scale", scales)),
        Knob("precision", "of encoder and refinement", {"float32": EXACT, "bfloat16": Setting(autocast="bfloat16")}),
        Knob("image size", "fraction of the size that all is computed at", {_text(s): Setting(size=s) for s in scales}),
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
        margins = {_text(margin): Setting(Skip(margin=margin)) for margin in (None, 128, 64, 32, 16, 0)}
        found.append(Knob("margin", "pixels around the foreground that are computed with it", margins))
    if config.object_motion is not None and config.object_motion.where == "foreground":
        values = {"forecast anew": EXACT, "taken to stand": Setting(Skip(still=True))}
        found.append(Knob("still", "things that were measured to stand", values))
    return found


def combined(settings: Sequence[Setting]) -> Setting:
    """All that ``settings`` change, at once; where two change the same, the last one counts."""
    result = EXACT
    for setting in settings:
        changed = setting.plain()
        parts = {name: replace(getattr(result, name), **changed.pop(name, {})) for name in ("skip", "effort")}
        result = replace(result, **parts, **changed)
    return result


def combinations(choices: Sequence[Sequence[Setting]]) -> list[Setting]:
    """Every way to take one of each of ``choices``, without repetition, in order."""
    return list(dict.fromkeys(combined(chosen) for chosen in itertools.product(*choices)))


def describe(setting: Setting) -> str:
    """What differs from the defaults, in short."""
    plain = setting.plain()
    flat = plain.pop("skip", {}) | plain.pop("effort", {}) | plain
    words = (f"{name} {value if isinstance(value, str) else _text(value)}" for name, value in flat.items())
    return ", ".join(words) or "exact"
