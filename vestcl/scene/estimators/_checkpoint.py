"""A checkpoint on this disk or on the Hugging Face hub: its configuration, its preparation of images, its network.

`transformers` is imported when a checkpoint is opened and not before, so vestcl works without it. Of its image
processors only the configuration is read: the classes differ between its versions and some need torchvision.
"""

import importlib
import json
import os
import re
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit
from urllib.request import getproxies

from torch import nn

#: What the image processors of all versions of transformers write.
_PREPARATION: Final = "preprocessor_config.json"

#: owner/name, or only a name, as the hub has had at first.
_HUB_NAME: Final = re.compile(r"\w[\w.-]*(/\w[\w.-]*)?")

#: Where the hub is, if HF_ENDPOINT does not name a mirror.
_HUB: Final = "https://huggingface.co"

#: Characters of transformers' own message that are passed on: it may list hundreds of networks.
_REASON: Final = 200


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A checkpoint whose configuration is read; its weights are not yet."""

    name: str
    """A folder, or owner/name on the hub."""
    config: Any
    """transformers' configuration of the network."""
    preparation: dict[str, Any]
    """The content of preprocessor_config.json."""
    network: str
    """The class in transformers."""
    local_files_only: bool

    @classmethod
    def open(cls, name_or_path: str | Path, networks: Mapping[str, str], *, local_files_only: bool) -> "Checkpoint":
        """Read what comes before the weights.

        Args:
            name_or_path: a folder with config.json, preprocessor_config.json and the weights, or a hub name.
            networks: model type -> class, of what is accepted.
            local_files_only: whether the hub is not asked: a hub name is then looked up in its cache only.

        Raises:
            ImportError: transformers is not installed.
            ValueError: no such checkpoint, files missing or damaged, or a network of another type.
        """
        transformers, name = _transformers(), str(name_or_path)
        local_files_only = (
            local_files_only or not _hub_is_known()
        )  # else each file is asked for again for half a minute
        with _explained(name):
            config = transformers.AutoConfig.from_pretrained(name, local_files_only=local_files_only)
        if config.model_type not in networks:
            raise ValueError(f"{name}: must be one of {', '.join(networks)}, got {config.model_type}")
        with _explained(name):
            file = transformers.utils.cached_file(name, _PREPARATION, local_files_only=local_files_only)
            preparation = json.loads(Path(file).read_text(encoding="utf-8"))
        if not isinstance(preparation, dict):
            raise ValueError(f"{name}: {_PREPARATION} must be an object, got {type(preparation).__name__}")
        return cls(name, config, preparation, networks[config.model_type], local_files_only)

    def load(self, device: str) -> nn.Module:
        """The network in float32, for inference: no dropout, no gradients.

        Args:
            device: of torch, "cpu" or "cuda".

        Raises:
            ValueError: no weights, damaged ones, weights that are not finite, or weights that lack a parameter;
                transformers would start that one at random and only warn.
        """
        network = getattr(_transformers(), self.network)
        with _explained(self.name):
            model, info = network.from_pretrained(
                self.name, config=self.config, local_files_only=self.local_files_only, output_loading_info=True
            )
        missing = sorted(set(info["missing_keys"]) & {name for name, _ in model.named_parameters()})
        if missing:
            raise ValueError(f"{self.name}: weights must have every parameter, got none for {_first(missing)}")
        model = model.float()
        broken = [name for name, weight in model.state_dict().items() if not weight.isfinite().all()]
        if broken:
            raise ValueError(f"{self.name}: weights must be finite, got NaN or infinity in {_first(broken)}")
        return model.eval().requires_grad_(False).to(device)


def _hub_is_known() -> bool:
    """Whether the hub's name leads to an address, here or by a proxy."""
    host = urlsplit(os.environ.get("HF_ENDPOINT", _HUB)).hostname
    if host is None or getproxies():
        return True
    try:
        socket.getaddrinfo(host, 443)
    except OSError:
        return False
    return True


def _transformers() -> Any:
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise ImportError("estimators need transformers: pip install 'vestcl[estimators]'") from error


@contextmanager
def _explained(name: str) -> Iterator[None]:
    """What transformers raises, with the remedy for someone who is offline."""
    try:
        yield
    except Exception as error:  # transformers, the hub, its data classes, safetensors and pickle each raise their own
        reason = str(error).strip().partition("\n")[0][:_REASON]
        if Path(name).is_dir():
            raise ValueError(f"{name}: is not a checkpoint that transformers can load: {reason}") from error
        if not _HUB_NAME.fullmatch(name):
            raise ValueError(f"{name}: there is no such folder, and it is not a name on huggingface.co") from error
        raise ValueError(
            f"{name}: is neither a folder here nor a checkpoint that could be had from huggingface.co ({reason}). "
            f"Where there is a network: `hf download {name} --local-dir FOLDER`; then give FOLDER"
        ) from error


def _first(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
