"""What `vestcl COMMAND --help` lists: one dataclass per command, whose fields are its options.

Torch and OpenCL are imported late: the help needs neither.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from vestcl.evaluation.st_lpips import Option as StLpipsOption


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of every command."""

    threads: int | None = None
    """CPU threads of torch, OpenCV and PoCL. Default: as many as there are cores."""
    quiet: bool = False
    """Print warnings and errors only."""
    verbose: bool = False
    """Print each stage and its seconds to stderr, too, and the traceback of an error."""


@dataclass(frozen=True)
class Devices(CommonOptions):
    """List the OpenCL devices of this machine."""


@dataclass(frozen=True)
class Doctor(CommonOptions):
    """Try every OpenCL device, each in a separate process, and print the remedy for what does not work."""

    timeout: float = 120.0
    """Seconds that a device may take."""


@dataclass(frozen=True)
class Demo(CommonOptions):
    """Render a procedural street, forecast it and show it from another camera."""

    out: Path = Path("out")
    """Folder for the images."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    seed: int = 3
    """Seed of the street."""
    model: str | None = None
    """vest-s, a .safetensors file, a checkpoint's folder, or geometric. Default: vest-s, where it is installed."""
    quality: Literal["exact", "balanced", "fast"] = "balanced"
    """Inference preset of the network."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


@dataclass(frozen=True, kw_only=True)
class ClipOptions(CommonOptions):
    """Options to open a clip, and the sources of depth, classes and inpainted background."""

    fov: float | None = None
    """Horizontal field of view in degrees, of a video or a folder without camera.json."""
    depth: Path | None = None
    """Folder of depth files (.png, .exr, .npy) with the frames' names."""
    depth_scale: float | None = None
    """Units per metre of the depth files; required for PNG (KITTI 256)."""
    labels: Path | None = None
    """Folder of label PNGs with the frames' names."""
    label_ids: Literal["trainIds", "labelIds", "virtual_kitti"] = "trainIds"
    """Encoding of the label PNGs."""
    depth_model: str | None = None
    """Estimate depth by this network: FILE.onnx (described by FILE.json), a checkpoint's folder, or a name on
    huggingface.co."""
    mask_model: str | None = None
    """Estimate classes by this network: FILE.onnx (described by FILE.json), a checkpoint's folder, or a name on
    huggingface.co."""
    inpaint: str | None = None
    """Inpainting of the background behind the foreground: regions, telea ..., or lama:FILE, LaMa's TorchScript export.
    Default: regions."""
    fps: float | None = None
    """Frames per second of nerfstudio's and COLMAP's images, which have no times."""
    scale: float | None = None
    """Metres per unit of nerfstudio's and COLMAP's poses. Default: 1."""
    rig: str | None = None
    """KITTI: colour or grey cameras."""
    accumulated_depth: bool = False
    """KITTI raw: depth from proj_depth/groundtruth, which has the scans of later frames, too."""
    sequence: str | None = None
    """KITTI odometry: the sequence, if there are several."""
    snippet: str | None = None
    """Cityscapes: name of the annotated frame, if there are several."""
    variant: str | None = None
    """Virtual KITTI: clone, fog ..., if there are several."""


@dataclass(frozen=True)
class Forecast(ClipOptions):
    """Forecast the next frames of a driving clip, and show them from other cameras.

    The folder OUT gets images, OpenEXR and a video of each view, and forecast.json. With --every a whole drive is
    forecast, frame by frame: OUT gets one video, seen | forecast | truth | error, and the scores by frame. A run that
    was interrupted continues with the same command.
    """

    input: tyro.conf.Positional[tuple[str, ...]]
    """A KITTI raw drive, a KITTI odometry sequence, a frame of Cityscapes, a scene of Virtual KITTI 2, a folder with
    camera.json, transforms.json or COLMAP's text files, a video, or street:SEED for a procedural street
    (street:7?drive=road,fps=25 with bends, at 25 Hz). With --every several of them, or folders of clips."""
    out: Path = Path("out")
    """Output folder; files of an earlier forecast are replaced one by one."""
    steps: int | None = None
    """Frames to forecast. Default: 5."""
    seconds: float | None = None
    """In place of --steps: how far to forecast, rounded to whole intervals of the clip."""
    every: int | None = None
    """Forecast a whole drive: each EVERY-th frame that true frames follow, from --frame on (default: 3)."""
    frames: int | None = None
    """With --every: frames of a street. Default: 30."""
    model: str | None = None
    """Forecast by a network: vest-s, a .safetensors file, a training checkpoint's folder. Default: by geometry."""
    mode: Literal["compose", "feedback"] | None = None
    """With --model: repeat the first step's motion (compose), or feed each forecast frame back (feedback). Default:
    feedback for models that start from rest, compose for vest-s."""
    perceive: Literal["splatted", "estimated"] | None = None
    """With mode feedback: depth and mask of forecast frames are splatted, or estimated by --depth-model and
    --mask-model. Default: estimated if one of these is given, else splatted."""
    quality: Literal["exact", "balanced", "fast", "realtime"] | None = None
    """Preset: the width that the scene is perceived at, if --work-width does not say, and with --model how the network
    computes. Default: balanced. docs/performance.md has the time and the error of each."""
    learned: Literal["tested", "all"] | None = None
    """With --model, if it starts from measurements: correct the geometric forecast by those learned parts that would
    have improved it at the last frame (tested), or forecast by the network with all of them (all). Default: tested."""
    view: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Target view: source, right, left, or x,y,z[,yaw=][,pitch=][,roll=][,fov=][,name=], as in "0.5,0,0,yaw=-5": metres
    to the right of, below and ahead of the source camera, and degrees to the right, up and clockwise. May be repeated.
    Default: source."""
    frame: int | None = None
    """The current frame t, from 0; the forecast uses it and earlier frames. Default: the last frame, or with --compare
    the last one that STEPS true frames follow."""
    compare: bool = False
    """Score forecast and baselines (with --model geometry, too) against the frames that follow in the clip."""
    squeeze: Path | None = None
    """With --compare: SqueezeNet 1.0 weights for a distance in its features."""
    st_lpips: StLpipsOption = None
    """With --compare: measure ST-LPIPS, by the weights FILE or those inside an installed stlpips-pytorch."""
    score_size: tuple[int, int] | None = None
    """With --compare: height and width in pixels that images are scored at. Default: the clip's. `vestcl bench
    forecast` scores at 256 832."""
    height: int | None = None
    """Pixels. Default: the clip's, or in proportion to --width."""
    width: int | None = None
    """Pixels. Default: the clip's, or in proportion to --height."""
    work_width: int | None = None
    """Perceive the scene at no more than this width in pixels, and show it at the size of the clip; 0: the clip's own
    width. Smaller is faster. Default: by --quality, 960 of balanced."""
    memory: int | None = None
    """Geometric forecast only: frames before t-1 whose static scene fills what frames t and t-1 do not show; 0: none.
    Default: 3."""
    gif: bool = False
    """Write an animated GIF of each view, too."""
    exr: bool = True
    """Write each frame's colour, depth, coverage and 3D motion as OpenEXR."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


@dataclass(frozen=True)
class View(ClipOptions):
    """Show a clip and its future in a browser: a free camera, and sliders of the frame and of the time ahead.

    Needs viser: pip install 'vestcl[viewer]'. Ctrl-C closes it.
    """

    input: tyro.conf.Positional[str]
    """A clip, as `vestcl forecast` opens it, or street:SEED for a procedural street, which needs no file."""
    model: str | None = None
    """Show the forecast of this network, too: vest-s, a .safetensors file, a training checkpoint's folder."""
    quality: Literal["exact", "balanced", "fast"] | None = None
    """With --model: the inference preset to begin with. Without it: balanced."""
    frame: int | None = None
    """The frame t to begin with, counted from 0. Without it: 3, or the last of a shorter clip."""
    frames: int = 30
    """Frames of a street."""
    port: int = 8080
    """Of 127.0.0.1; where it is taken, the next one that is free."""
    height: int | None = None
    """Pixels; without it as the clip is, or in proportion to --width."""
    width: int | None = None
    """Pixels; without it as the clip is, or in proportion to --height."""
    device: str | None = None
    """OpenCL device: an index of `vestcl devices` or a part of its name."""


@dataclass(frozen=True)
class Prepare(ClipOptions):
    """Compute depth, masks, inpainting and motion of clips' frames once, for training, evaluation and forecasts.

    Frames that are already prepared from the same input are kept. The command may be stopped at any moment, and several
    may run at once.
    """

    inputs: tyro.conf.Positional[tuple[str, ...]]
    """Clips, as `vestcl forecast` opens them, or procedural streets: street:SEED, street:FIRST-LAST, with
    options or without: street:7?drive=road,fps=12.5,depth=stereo,masks=motion."""
    out: Path | None = None
    """Folder of the cache, with one folder per clip. Default: .vestcl in each input."""
    height: int = 256
    """Pixels."""
    width: int = 832
    """Pixels."""
    frames: int = 12
    """Frames of each street."""
    samples: int = 2
    """Streets' colour is the mean over samples x samples rays per pixel."""
    drive: Literal["usual", "random", "road"] = "usual"
    """How cameras drive: usual, the street's own drive; random, drawn in the ranges of real cars, from a random time
    on; or road, with bends, braking, stops and a body on springs. This and the next three options apply to streets
    whose input does not set them."""
    street_depth: Literal["true", "stereo", "motion", "scan", "random"] = "true"
    """Source of streets' depth: the true depth, matching of stereo pairs, the camera's motion, or simulated laser
    scans; random draws one of the latter three for each street."""
    street_masks: Literal["true", "motion", "disturbed", "random"] = "true"
    """Source of streets' masks: true labels, motion, or labels with a classifier's errors; random draws one of the
    latter two for each street."""
    street_fps: str | None = None
    """Frames per second of streets, or random: 8 to 30. Default: 10."""
    shard: str | None = None
    """I/N, I from 0: every N-th clip from the I-th on. Default: torchrun's RANK and WORLD_SIZE, if set."""
    workers: int = 1
    """Processes."""


@dataclass(frozen=True)
class Bench:
    """Measure a part of vestcl, such as `vestcl bench splat`; `vestcl bench --help` lists all."""
