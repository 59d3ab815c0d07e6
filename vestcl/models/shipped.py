"""The files of trained networks: those that ship with the package, and anyone's own, by one name or path."""

import hashlib
from pathlib import Path
from typing import Final

#: What this version ships with, each NAME as FOLDER/NAME.safetensors.
SHIPPED: Final = ("vest-s",)

#: In a wheel, an editable install and a bare checkout.
FOLDER: Final = Path(__file__).resolve().parents[1] / "weights"

#: What of a training checkpoint's folder is taken, the first that is there: the EMA weights forecast better.
_OF_A_CHECKPOINT: Final = ("ema.safetensors", "model.safetensors")


def shipped() -> dict[str, Path]:
    """The networks that came with this installation: name -> file; without those of SHIPPED whose file is missing."""
    files = {name: FOLDER / f"{name}.safetensors" for name in SHIPPED}
    return {name: path for name, path in files.items() if path.is_file()}


def find_model(name_or_path: str | Path) -> Path:
    """The file that `Forecaster.from_pretrained` reads.

    Args:
        name_or_path: one of SHIPPED; or a .safetensors file; or the folder of a training checkpoint, whose
            ema.safetensors is taken, or else its model.safetensors. A `Path` is never a name.

    Returns:
        The file; what it holds is not looked at.

    Raises:
        ValueError: no such name and no such file, a folder without a model, or a shipped file that is missing.
    """
    if isinstance(name_or_path, str) and name_or_path in SHIPPED:
        if name_or_path not in shipped():
            wanted = FOLDER / f"{name_or_path}.safetensors"
            raise ValueError(f"{name_or_path}: its weights are missing ({wanted}); install vestcl again")
        return shipped()[name_or_path]
    path = Path(name_or_path)
    if path.is_dir():
        files = [path / name for name in _OF_A_CHECKPOINT if (path / name).is_file()]
        if not files:
            raise ValueError(f"{path}: must have {' or '.join(_OF_A_CHECKPOINT)}, as a training checkpoint has")
        return files[0]
    if not path.is_file():
        raise ValueError(f"{path}: is not a model: no file, no checkpoint's folder, and none of {', '.join(SHIPPED)}")
    return path


def about_model(name_or_path: str | Path) -> dict[str, str]:
    """What identifies this network: {"model_file": the file, "model_sha256": of all its bytes, in hex}.

    Args:
        name_or_path: as of `find_model`; a shipped file is identified by its name only.

    Raises:
        ValueError: as `find_model`.
    """
    path = find_model(name_or_path)
    file = path.name if path.parent == FOLDER else str(path)
    return {"model_file": file, "model_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
