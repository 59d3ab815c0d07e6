"""Options of a trained network's forecast: what is skipped, and what is computed more coarsely."""

from dataclasses import dataclass, fields, replace
from typing import Any, Final

#: Options that files list under "skip" and under "effort"; "autocast" has its own entry.
_SKIPS: Final = ("seen", "background", "objects", "covered", "views", "margin", "still")
_SWITCHES: Final = _SKIPS[:5]


@dataclass(frozen=True)
class InferenceOptions:
    """How a `Forecaster` computes; weights stay as they are.

    The defaults are exact: each computes what the network was trained to.

    - Only rounding changes with ``seen``, ``background``, ``objects``, ``covered`` and ``views``: conditional
      computation, which leaves out what has no influence on the result.
    - Results change with ``margin`` below the networks' reach, with ``still``, ``min_transmittance``, ``splat_scale``,
      ``blocks``, ``paint_scale`` and ``autocast``. `vestcl bench pareto` measures what each costs and saves, and
      `vestcl.models.inference.quality` has presets chosen by that.

    Raises:
        ValueError: an option out of range.
    """

    seen: bool = True
    """A frame of the same content as one of the last two is not encoded again while weights and settings stay the
    same. (Where gradients are recorded, it is.)"""
    background: bool = True
    """The background is encoded around what foreground hides, and not at all where there is none."""
    objects: bool = True
    """Object motion is forecast around the foreground, and not at all where there is none."""
    covered: bool = True
    """Only those points of the previous frame are splatted that land where the current frame leaves something open."""
    views: bool = True
    """A camera that is asked for twice is rendered once."""
    margin: int | None = None
    """Pixels around the foreground that ``background`` and ``objects`` compute; None is the networks' reach."""
    still: bool = False
    """With ``objects``, objects that were measured to be static are kept static: object motion is forecast around
    dynamic objects only."""
    min_transmittance: float = 0.0
    """A pixel takes no more points once its transmittance falls below this; see `vestcl.splat`."""
    splat_scale: float = 1.0
    """Clouds are splatted at this fraction of the view's height and width, and the planes enlarged."""
    blocks: int | None = None
    """Only the first this many blocks of object motion run, from coarse to fine; None is all of them, 0 none."""
    paint_scale: float = 1.0
    """Refinement's correction of the splatted colour is computed at this fraction of the view's height and width, and
    enlarged. A network that predicts RGB directly (`RefineConfig.base` "none") has no such correction: only 1."""
    autocast: str | None = None
    """"bfloat16": encoder and refinement compute in that type of torch; None is the parameters' own. Motion, which is
    millimetres in hundreds of metres, never does."""

    def __post_init__(self) -> None:
        if self.margin is not None and self.margin < 0:
            raise ValueError(f"`margin` must be 0 px or more, or None, got {self.margin}")
        if not 0 <= self.min_transmittance < 1:
            raise ValueError(f"`min_transmittance` must be in [0, 1), got {self.min_transmittance}")
        for name in ("splat_scale", "paint_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"`{name}` must be in (0, 1], got {getattr(self, name)}")
        if self.blocks is not None and (not isinstance(self.blocks, int) or self.blocks < 0):
            raise ValueError(f"`blocks` must be a whole number, 0 or more, or None, got {self.blocks}")
        if self.autocast not in (None, "bfloat16"):
            raise ValueError(f"`autocast` must be 'bfloat16' or None, got {self.autocast!r}")

    def around(self, reach: int) -> int:
        """``margin`` in pixels, of a network with receptive field ``reach``."""
        return reach if self.margin is None else self.margin

    @property
    def of_encoder(self) -> tuple[object, ...]:
        """The options that features depend on."""
        return self.background, self.margin, self.autocast

    def without_skips(self) -> "InferenceOptions":
        """The same with all switches of conditional computation off."""
        return replace(self, **dict.fromkeys(_SWITCHES, False))  # type: ignore[arg-type]

    def as_dict(self) -> dict[str, Any]:
        """For JSON: {"skip": {...}, "effort": {...}, "autocast": name or None}; `from_dict` reads it."""
        every = {field.name: getattr(self, field.name) for field in fields(self)}
        autocast = every.pop("autocast")
        skip = {name: every.pop(name) for name in _SKIPS}
        return {"skip": skip, "effort": every, "autocast": autocast}

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> "InferenceOptions":
        """The options of `as_dict`; what is missing has its default.

        Raises:
            TypeError: an unknown option.
        """
        return cls(**entries.get("skip", {}), **entries.get("effort", {}), autocast=entries.get("autocast"))


#: As a network is loaded.
EXACT: Final = InferenceOptions()

#: The knees that cost at most 0.1 dB of PSNR.
BALANCED: Final = InferenceOptions(
    margin=16, still=True, min_transmittance=0.01, blocks=2, paint_scale=0.5, autocast="bfloat16"
)

#: Beyond them: details at a quarter of the size, objects move as measured.
FAST: Final = replace(BALANCED, min_transmittance=0.03, blocks=0, paint_scale=0.25)
