"""What `vestcl forecast` and `prepare` refuse before they start: inputs that are no clips, options that need others."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from vestcl.cli.commands import ClipOptions, Forecast
from vestcl.cli.options import check_pixels
from vestcl.data.street import input as street_input

if TYPE_CHECKING:
    from vestcl.data.sample import Clip

#: What an input is not, though it looks like one that vestcl could open.
_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://.*", re.DOTALL)

#: Suffixes of files that an estimator may be, and of files that hold weights only.
_NETWORK_FILES: Final = (".onnx", ".json")
_WEIGHTS: Final = (".safetensors", ".bin", ".pt", ".pth", ".ckpt", ".h5")

#: Bytes of a forecast frame per pixel and view: colour, depth, coverage and 3D motion, float32.
_RESULT_BYTES: Final = 4 * (3 + 1 + 1 + 3)


def check_input(text: str) -> None:
    """Refuse inputs of the command line that are no paths and no streets.

    Raises:
        ValueError: a street without a seed, or a URL.
    """
    if _URL.fullmatch(text):
        raise ValueError(f"{text}: is a URL, and vestcl opens files only: download it first")
    if text.startswith("street:") and one_street(text) is None and not Path(text).exists():
        raise ValueError(f"{text}: must be street:SEED, as street:3 (prepare takes street:FIRST-LAST, too)")


def one_street(text: str) -> street_input.StreetInput | None:
    """The procedural street that an input names, which is not a file; None for any other text, or several streets.

    Raises:
        ValueError: an option that a street does not have.
    """
    street = street_input.parse(text)
    return street if street is not None and street.seeds is not None and "-" not in text.partition("?")[0] else None


def check_file_options(options: ClipOptions) -> None:
    """Refuse options about files that are not given.

    Raises:
        ValueError: units without depth files, or a kind of labels without label files.
    """
    if options.depth_scale is not None and options.depth is None:
        raise ValueError("`depth_scale` is the units of depth files; it needs `depth`")
    if options.label_ids != "trainIds" and options.labels is None:
        raise ValueError("`label_ids` is what label files hold; it needs `labels`")


def check_folders(options: ClipOptions) -> None:
    """Refuse folders that hold no depth or label files.

    Raises:
        ValueError: no such folder, or a file.
    """
    for name in ("depth", "labels"):
        folder: Path | None = getattr(options, name)
        if folder is not None and not folder.is_dir():
            what = "is not a folder" if folder.exists() else "does not exist"
            raise ValueError(f"`{name}` must be a folder of files with the frames' names, and {folder} {what}")


def is_network_file(name: str, value: str) -> bool:
    """Whether an estimator is a file: of an ONNX network, or its JSON. Else it is a checkpoint's folder or hub name.

    Only what exists counts: a folder NETWORK.onnx is a folder.

    Args:
        name: of the option.
        value: a path or a hub name.

    Raises:
        ValueError: a file of another kind, a folder that has but ONNX files, or a path of a file that does not exist.
    """
    path = Path(value)
    if path.is_dir():
        networks = sorted(file.name for file in path.glob("*.onnx"))
        if networks and not (path / "config.json").exists():
            raise ValueError(
                f"`{name}` is a folder without config.json: {value}; its ONNX networks are files: {path / networks[0]}"
            )
        return False
    is_named_file = path.suffix.lower() in _NETWORK_FILES
    if not path.exists():
        if is_named_file:
            raise ValueError(f"`{name}` must be a file, a folder or a name on huggingface.co: there is no file {value}")
        return False
    if not path.is_file():
        raise ValueError(f"`{name}` must be a file, a folder or a name on huggingface.co: {value} is neither")
    if path.suffix.lower() in _WEIGHTS:
        raise ValueError(
            f"`{name}` must be an ONNX file or a folder, got {value}, which holds weights without their network: "
            f"give its folder, or export to ONNX"
        )
    return True


def _check_remembered(options: Forecast) -> None:
    if options.memory is not None and options.memory < 0:
        raise ValueError(f"`memory` must be 0 frames or more, got {options.memory}")
    if options.memory is not None and options.model is not None:
        raise ValueError("`memory` is of the geometric forecast: it can't be combined with `model`")


def _check_drive(options: Forecast) -> None:
    if options.steps is not None and options.seconds is not None:
        raise ValueError(
            f"`steps` and `seconds` both say how far to forecast: give one, got {options.steps} and {options.seconds:g}"
        )
    if options.every is None:
        if len(options.input) != 1:
            got = ", ".join(options.input) or "none"
            raise ValueError(f"`input` must be one clip, or several with --every, got {got}")
        if options.frames is not None:
            raise ValueError("`frames` is how long streets of a whole drive are; it needs `every`")
        return
    if not options.input:
        raise ValueError("`input` must be one clip or more, got none")
    if options.gif:
        raise ValueError("`gif` is of a single forecast: it can't be combined with `every`")


def check_forecast(options: Forecast) -> None:
    """Refuse options that need others.

    Raises:
        ValueError: the message names both.
    """
    check_file_options(options)
    _check_remembered(options)
    _check_drive(options)
    scored = options.compare or options.every is not None
    for name in ("squeeze", "st_lpips"):
        if getattr(options, name) is not None and not scored:
            raise ValueError(f"`{name}` is a distance to the truth; it needs `compare`")
    if options.score_size is not None:
        if not scored:
            raise ValueError("`score_size` is the size that images are compared at; it needs `compare`")
        check_pixels(*options.score_size, name="`score_size`")
        if min(options.score_size) < 1:
            raise ValueError(f"`score_size` must be 1 px or more, got {options.score_size}")
    if options.mode is not None and options.model is None:
        raise ValueError("`mode` is how a network continues after its first step; it needs `model`")
    if options.perceive is not None and options.model is None:
        raise ValueError("`perceive` is how a network sees its own forecast; it needs `model`")
    if options.learned is not None and options.model is None:
        raise ValueError("`learned` is which learned parts of a network count; it needs `model`")


def check_memory(steps: int, clip: "Clip", views: int) -> None:
    """Refuse a forecast whose frames do not fit into the memory that is free.

    Raises:
        ValueError: they do not.
    """
    height, width = clip[0].height, clip[0].width
    wanted = steps * views * height * width * _RESULT_BYTES
    free = _free_memory()
    if free is not None and wanted > free:
        size = f"{steps} steps of {views} views of {height} x {width} px"
        raise ValueError(
            f"--steps: {size} take {wanted / 2**30:.1f} GiB of memory, {free / 2**30:.1f} GiB are free; "
            "take fewer steps or a smaller --height"
        )


def _free_memory() -> int | None:
    """Bytes that can be had without swapping; None where the system does not report it."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")), None)
