"""What the scores of an evaluation depend on, as results.json lists it, and the key that names its parts by it."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, Final

from train.evaluation.options import Evaluation, models_of
from train.evaluation.protocols import Protocol
from train.evaluation.windows import PART_WINDOWS
from vestcl import __version__
from vestcl.cli.prepare import identity
from vestcl.evaluation import st_lpips
from vestcl.prepare.files import JSON

#: Settings that scores do not depend on, or that are in the key as the content of files.
_NOT_IN_KEY: Final = (
    "model",
    "squeeze",
    "lpips",
    "st_lpips",
    "peer",
    "out",
    "shard",
    "merge",
    "device",
    "horizons",
    "sheets",
)

#: Settings of later versions, with what changes nothing.
_LATER: Final = {"drive": "usual", "street_fps": None}

#: Version of the scores' files: raised when a window's inputs or its scoring change.
_SCORING: Final = 3


def about_run(config: Evaluation, protocol: Protocol) -> dict[str, Any]:
    """What the scores depend on, for JSON.

    Args:
        config: of the evaluation.
        protocol: as the options change it.

    Raises:
        FileNotFoundError: no such model or weights.
    """
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in _NOT_IN_KEY}
    settings = {k: v for k, v in settings.items() if k not in _LATER or v != _LATER[k]}  # keys of former runs hold
    folders = {name: getattr(config, name) for name in ("data", "prepared")}
    changed = {name: None if folder is None else str(folder.resolve()) for name, folder in folders.items()}
    effective = {k: getattr(protocol, k) for k in ("size", "steps", "first", "last")}
    weights = {"squeeze": config.squeeze} | dict(zip(("alexnet", "lpips"), config.lpips or (), strict=False))
    weights |= {"peer": config.peer, "st_lpips": config.st_lpips and st_lpips.find_weights(config.st_lpips)}
    hashes = {name: _sha256(path) for name, path in weights.items() if path is not None}
    models = {name: getattr(config, name) for name in ("depth_model", "mask_model", "inpaint")}
    hashes |= {name: _digest(identity(model).encode()) for name, model in models.items() if model is not None}
    if config.prepared is not None:
        hashes["prepared"] = _digest(*(path.read_bytes() for path in sorted(config.prepared.rglob(JSON))))
    return {
        "vestcl": __version__,
        "settings": settings | changed | effective,
        "models": {name: {"file": str(path), "sha256": _sha256(path)} for name, path in models_of(config).items()},
        "weights": hashes,
    }


def key_of(about: dict[str, Any]) -> str:
    """12 hexadecimal digits of what `about_run` gave, wherever the models' files lie."""
    hashes = {name: model["sha256"] for name, model in about["models"].items()}
    content = json.dumps(
        about | {"models": hashes, "part": PART_WINDOWS, "scoring": _SCORING}, sort_keys=True, default=str
    )
    return _digest(content.encode())[:12]


def _digest(*content: bytes) -> str:
    digest = hashlib.sha256()
    for part in content:
        digest.update(part)
    return digest.hexdigest()


def _sha256(path: Path) -> str:
    return _digest(path.read_bytes())
