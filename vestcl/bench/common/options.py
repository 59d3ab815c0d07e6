"""Options that benches share. A bench's own dataclass inherits them, gives other defaults, and adds its own.

    @dataclass(frozen=True)
    class SplatBench(Options):
        height: int = 256

They are keywords of the dataclass. `vestcl.bench.common.results.run` does what the options of `Options` ask for.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """Of every bench."""

    json: Path | None = None
    """File for the results."""


@dataclass(frozen=True, kw_only=True)
class DeviceOptions(JsonOption):
    """Of benches that compute on a device."""

    threads: int = 2
    """Of torch."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices`, a part of its name, or "all": every one that works."""


@dataclass(frozen=True, kw_only=True)
class Options(DeviceOptions):
    """Of benches that `run` runs."""

    markdown: Path | None = None
    """File for the tables."""
    plots: Path | None = None
    """Folder for plots (PNG)."""
    trace: Path | None = None
    """File for a trace of stages and kernels, which ui.perfetto.dev opens; times are a bit longer meanwhile."""
