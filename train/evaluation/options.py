"""What `python -m train.evaluate --help` lists."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import tyro

from train.evaluation.protocols import HELD_OUT, Name
from vestcl.evaluation.scores import FLOW, GEOMETRIC, ORACLE, REPEAT
from vestcl.evaluation.st_lpips import Option as StLpipsOption
from vestcl.forecasting import peer
from vestcl.forecasting.network.later_frames import Perceived
from vestcl.forecasting.network.learned import Learned
from vestcl.models import shipped
from vestcl.models.forecaster import Mode

#: Names of models: they are part of table rows and of JSON keys.
_NAME: Final = re.compile(r"\w[\w .+-]{0,59}")

#: Rows that are no model's.
_TAKEN: Final = (GEOMETRIC, REPEAT, FLOW, ORACLE, peer.METHOD)


@dataclass(frozen=True)
class Evaluation:
    """Score models and baselines on every window of a protocol."""

    protocol: tyro.conf.Positional[Name]
    """Which clips, windows, cameras and size."""
    model: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """A model: vest-s, a .safetensors file, a training checkpoint's folder; may be repeated. Tables call it by the
    file's stem (a folder's name), or by NAME in NAME=FILE."""
    data: Path | None = None
    """The data set's root, or for `clip` what `vestcl forecast` opens. `street` needs none."""
    prepared: Path | None = None
    """Instead of --data: a folder of clips that `vestcl prepare` wrote at the size that is evaluated, by the names of
    the protocol's clips; for `clip` all that it has."""
    out: Path | None = None
    """Folder for results and for what is done so far; default: out/PROTOCOL."""
    squeeze: Path | None = None
    """SqueezeNet 1.0 weights, for the distance in its features."""
    lpips: tuple[Path, Path] | None = None
    """Weights of AlexNet (torchvision) and of LPIPS's heads (v0.1)."""
    st_lpips: StLpipsOption = None
    """Measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    peer: Path | None = None
    """Weights of the learned 2D baseline (`python -m train.peer` writes peer.safetensors)."""
    height: int | None = None
    """Pixels. Default: the protocol's."""
    width: int | None = None
    """Pixels. Default: the protocol's."""
    steps: int | None = None
    """Frames to forecast. Default: the protocol's."""
    horizons: tuple[int, ...] = ()
    """Steps that tables show. Default: the protocol's."""
    every: int = 1
    """Score only every N-th window."""
    first: int | None = None
    """The first current frame t of a clip, from 0. Default: the protocol's."""
    last: int | None = None
    """The last one."""
    mode: Mode | None = None
    """How models make steps after the first: compose the first motion, or feed each forecast frame back (feedback).
    Default: feedback for models that start from rest, compose for vest-s."""
    perceive: Perceived | None = None
    """With mode feedback: depth and mask of forecast frames are splatted, or estimated by --depth-model and
    --mask-model. Default: estimated if one of these is given, else splatted."""
    learned: Learned = "tested"
    """Models that start from measurements correct the geometric forecast by the learned parts that win a test on
    the frames before (tested), as `vestcl forecast` does, or forecast on their own with all parts (all)."""
    depth_model: str | None = None
    """Estimate depth by this checkpoint (a folder, or a name on huggingface.co)."""
    mask_model: str | None = None
    """Estimate classes by this checkpoint (a folder, or a name on huggingface.co)."""
    inpaint: str | None = None
    """How the background behind the foreground is filled: regions, telea ..., or lama:FILE, LaMa's TorchScript export.
    Default: regions."""
    accumulated_depth: bool = False
    """KITTI raw: depth from proj_depth/groundtruth, which has the scans of later frames, too. Tables say so."""
    stereo: bool = False
    """Take depth from stereo pairs even where clips have depth (laser scans, or a street's true depth). Rows that do
    end in "stereo pair"; where the right camera's future is judged they come next to monocular ones."""
    seeds: tuple[int, int] = (HELD_OUT[0], HELD_OUT[-1])
    """Seeds of streets: the first and the last."""
    drive: Literal["usual", "road"] = "usual"
    """How cameras drive down streets: as the street has it, or with bends, braking, stops and a body on springs."""
    street_fps: float | None = None
    """Frames per second of streets; without it 10."""
    samples: int = 2
    """Rays per pixel and direction, of streets."""
    shard: str | None = None
    """I/N, 0 <= I < N: do this share of the windows. Without it RANK and WORLD_SIZE count, as torchrun sets them."""
    merge: bool = False
    """Forecast nothing: make the tables of what is done, which must be everything."""
    sheets: bool = True
    """Write contact sheets of the best, the median and the worst window."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


def models_of(config: Evaluation) -> dict[str, Path]:
    """The models' files by the names that tables give them, in the order of the options.

    Raises:
        ValueError: two models of one name, a name that a table can't have or that another row has, or no such model.
    """
    found: dict[str, Path] = {}
    for given in config.model:
        name, path = _named(given)
        if name in found or name in _TAKEN:
            raise ValueError(
                f"`model` must have files with different stems, got {name} again; NAME=FILE gives one another name"
            )
        found[name] = path
    return found


def _named(given: Path) -> tuple[str, Path]:
    """A model's name and file. What exists is a path, whatever is in its name."""
    text = str(given)
    name, equals, rest = text.partition("=")
    if equals and not given.exists():
        if not rest:
            raise ValueError(f"`model` must be FILE or NAME=FILE, got {text!r}")
        if not _NAME.fullmatch(name):
            raise ValueError(f"`model` must have a name of letters, digits, spaces and '._+-', got {name[:60]!r}")
        return name, _file(rest)
    return given.stem if given.suffix == ".safetensors" else given.name, _file(text)


def _file(text: str) -> Path:
    """The file of a shipped model's name, or of a checkpoint's folder; any other path as it is."""
    path = Path(text)
    return shipped.find_model(text) if text in shipped.SHIPPED or path.is_dir() else path


def check_options(config: Evaluation) -> None:
    """Refuse inputs that exclude each other.

    Raises:
        ValueError: the message names both.
    """
    if config.prepared is None:
        return
    for name in ("data", "stereo", "accumulated_depth"):
        if getattr(config, name):
            raise ValueError(f"`{name}` must not be given with `prepared`, whose clips have images and depth")
    if config.perceive != "estimated" and (config.depth_model or config.mask_model):
        raise ValueError(
            "`prepared` clips have depth and masks: `depth_model` and `mask_model` are of forecast frames then, and "
            "need --perceive estimated"
        )
