"""The picture of `vestcl bench stability`: each family's errors over its knob, both on logarithmic axes."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from vestcl.bench.common.plots import TITLE, blank, file_name, write
from vestcl.bench.stability.cases import Family

#: Panels beside each other.
_COLUMNS: Final = 4

#: Inches of a panel, of title and legend, and of a figure that its title fits.
_PANEL: Final = (3.8, 3.1)
_AROUND: Final = 1.2
_LEAST_WIDTH: Final = 8.0

#: Errors below and above are drawn on the edge: a tenth of float32's rounding, and what has no digit right, nor size.
_LIMITS: Final = (6e-9, 1e1)

_OURS: Final = "#1769aa"
_BOUND: Final = "#888888"
_PEERS: Final = {"dividing": "#c4341c", "clamping": "#d98b0b", "PyTorch3D": "#7b3fa0", "R x + t - x": "#c4341c"}


class _Errors(Protocol):
    outputs: dict[str, float]
    gradients: dict[str, float]


def draw(rows: Sequence[Any], families: Sequence[Family], device: str, folder: Path) -> Path:
    """Write a PNG of the rows of one device.

    Args:
        rows: of `vestcl.bench.stability.bench.Row`.
        families: that the rows are of.
        device: its name, for title and file.
        folder: made where it does not exist.

    Returns:
        The file.

    Raises:
        ValueError: the folder can't be made.
    """
    columns = min(_COLUMNS, len(families))
    count = math.ceil(len(families) / columns)
    figure = blank(_PANEL[1] * count + _AROUND, max(_LEAST_WIDTH, _PANEL[0] * columns))
    axes = list(figure.subplots(count, columns, squeeze=False).flat)
    for panel, family in zip(axes, families, strict=False):
        _panel(panel, family, [row for row in rows if row.family == family.name])
    for panel in axes[len(families) :]:
        panel.set_axis_off()
    figure.suptitle(f"Relative error of float32 against float64, maximum norm\n{device}", fontsize=TITLE)
    handles = {label: line for panel in axes for line, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    pairs = math.ceil(len(handles) / 2)  # output above gradient
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=pairs, fontsize=8, frameon=False)
    return write(figure, folder / file_name(f"stability {device}"))


def _panel(panel: Any, family: Family, rows: Sequence[Any]) -> None:
    places, ticks = _places([row.knob for row in rows])
    outputs, gradients = ([getattr(row, kind) for row in rows] for kind in ("output", "gradient"))
    lines = [
        ("bound of output", [r.bounds.outputs[n] for r, n in zip(rows, outputs, strict=True)], _BOUND, ":", ""),
        ("bound of gradient", [r.bounds.gradients[n] for r, n in zip(rows, gradients, strict=True)], _BOUND, "--", ""),
    ]
    names = dict.fromkeys(name for row in rows for name in row.peers)
    for name in names:
        for kind, style in (("outputs", ":"), ("gradients", "-")):
            found = [_worst(row.peers.get(name), kind) for row in rows]
            lines.append((f"{name}: {kind[:-1]}", found, _PEERS[name], style, "s"))
    lines.append(("vestcl: output", [_worst(row.errors, "outputs") for row in rows], _OURS, ":", "o"))
    lines.append(("vestcl: gradient", [_worst(row.errors, "gradients") for row in rows], _OURS, "-", "o"))
    for label, values, colour, style, marker in lines:
        shown = [min(max(value, _LIMITS[0]), _LIMITS[1]) for value in values]
        panel.plot(places, shown, style, color=colour, marker=marker, markersize=3.5, linewidth=1.4, label=label)
    panel.set(xscale="log", yscale="log", ylim=(_LIMITS[0] / 1.5, _LIMITS[1] * 1.5))
    panel.set_xlabel(family.knob, fontsize=9)
    panel.set_title(family.name, fontsize=10, loc="left")
    if ticks:
        panel.set_xticks(*ticks)
        panel.minorticks_off()
        panel.invert_xaxis()
    panel.tick_params(labelsize=8)
    panel.grid(alpha=0.3)


def _worst(errors: _Errors | None, kind: str) -> float:
    return math.nan if errors is None else max(getattr(errors, kind).values())


def _places(knobs: Sequence[float]) -> tuple[list[float], tuple[list[float], list[str]] | None]:
    """Where knobs lie on a logarithmic axis, and ticks where one of them is 0: beyond the least of the others."""
    if 0 not in knobs:
        return list(knobs), None
    positive = [knob for knob in knobs if knob > 0]
    zero = min(positive, default=1.0) / 10
    powers = range(math.ceil(math.log10(zero)) + 1, math.floor(math.log10(max(positive, default=1.0))) + 1, 2)
    ticks = [zero, *(10.0**power for power in powers)]
    return [knob or zero for knob in knobs], (ticks, ["0", *(f"$10^{{{power}}}$" for power in powers)])
