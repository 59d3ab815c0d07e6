"""Options of `vestcl bench forecast`."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final, Literal

import tyro

from vestcl.constants import WORK_WIDTH
from vestcl.evaluation.st_lpips import Option as StLpipsOption
from vestcl.models.inference.quality import Quality

#: Streets that nothing is tuned, trained or tested on: "street:" is short for them.
HELD_OUT: Final = range(1000, 1020)

#: Steps that tables show where none are chosen.
HORIZONS: Final = (1, 3, 5)


@dataclass(frozen=True)
class ForecastBench:
    """Forecast every window of clips and score it against the frames that follow."""

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips, as `vestcl forecast` opens them, or procedural streets: street:SEED, street:FIRST-LAST, or street: for
    the twenty that are held out; with ?drive=road or ?drive=road,fps=25 at its end they bend."""
    steps: int = 5
    """Frames to forecast in each window."""
    horizons: tuple[int, ...] = ()
    """Steps that tables show; files have all. Without it 1, 3 and 5, as far as STEPS goes."""
    windows: Path | None = None
    """JSON file that lists the windows of each clip, and whether constants were chosen on it; `docs/windows.json` has
    those of the documented tables."""
    every: int = 1
    """Take every such window."""
    first: int = 1
    """The first window's current frame t, from 0; a frame is before it."""
    last: int | None = None
    """The last window's; without it the last one that has STEPS frames after it."""
    height: int = 256
    """Pixels of what is scored; forecasts are shown at the clip's own size."""
    width: int = 832
    """Pixels."""
    work_width: int = WORK_WIDTH
    """Perceive the scene at no more than this width in pixels, and show it at the size of the clip; 0: the clip's own
    width. Smaller is faster."""
    views: tuple[Literal["source", "right"], ...] = ("source", "right")
    """Cameras to be judged from; right only where a clip has one."""
    depth_model: str | None = None
    """Estimate depth by this network: FILE.onnx (described by FILE.json), a checkpoint's folder, or a name on
    huggingface.co."""
    mask_model: str | None = None
    """Estimate classes by this network, alike."""
    squeeze: Path | None = None
    """SqueezeNet 1.0 weights, for the distance in its features."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    peer: Path | None = None
    """Weights of the learned 2D baseline (`python -m train.peer` writes peer.safetensors)."""
    model: tuple[str, ...] = ()
    """Trained networks, by name or file, a row each."""
    quality: Quality | None = None
    """Run time against error of the networks: fast, balanced (if not given) or exact."""
    pool: bool = False
    """One table over all inputs instead of one for each."""
    street_size: tuple[int, int] = (256, 832)
    """Height and width of streets, pixels."""
    street_frames: int = 8
    """Frames of each street."""
    samples: int = 2
    """Streets' colour is the mean over samples x samples rays a pixel."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""
    out: Path | None = None
    """JSON file for the scores of every window, and their means. A run that was stopped is resumed: until the file is
    written, OUT.windows.jsonl has what is measured."""
    markdown: Path | None = None
    """File for the tables as Markdown."""

    OUTPUT_FILES: ClassVar[tuple[str, ...]] = ("out",)

    @property
    def shown(self) -> tuple[int, ...]:
        """Steps that tables show, each once."""
        return tuple(dict.fromkeys(self.horizons)) or tuple(k for k in HORIZONS if k <= self.steps)


def check(config: ForecastBench) -> None:
    """Refuse options that can't be.

    Raises:
        ValueError: one out of range.
    """
    for name in ("steps", "every", "first", "height", "width", "street_frames", "samples"):
        if getattr(config, name) < 1:
            raise ValueError(f"`{name}` must be 1 or more, got {getattr(config, name)}")
    if not config.inputs:
        raise ValueError("`inputs` must be one or more clips, got none")
    if not all(1 <= k <= config.steps for k in config.horizons):
        raise ValueError(f"`horizons` must be steps, 1 ... {config.steps}, got {config.horizons}")
    if not config.views or len(set(config.views)) < len(config.views):
        raise ValueError(f"`views` must be one or more cameras, each once, got {config.views}")
    if config.windows is not None and (config.first, config.last, config.every) != (1, None, 1):
        raise ValueError("`windows` lists the windows: it can't be combined with first, last or every")
    if config.quality is not None and not config.model:
        raise ValueError("`quality` is of networks, and there is no `model`")
