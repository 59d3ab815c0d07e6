"""Where the weights of ST-LPIPS are: a file that is named, or the one inside an installed ``stlpips-pytorch``.

That package is not imported (it needs torchvision): its file is found and read. Importing this module needs no torch.
"""

import importlib.metadata
from pathlib import Path
from typing import Annotated, Final, Literal

from tyro.constructors import PrimitiveConstructorSpec

#: In place of a path: look inside the installed package.
INSTALLED: Final = "installed"

#: The PyPI package, and the file's name in it.
PACKAGE: Final = "stlpips-pytorch"
FILE: Final = "alex_shift_tolerant.pth"

REMEDY: Final = f"`pip install --no-deps {PACKAGE}` brings {FILE}, which is found there; or give the path of that file"


def find_weights(source: Path | str) -> Path:
    """The file that ``source`` means.

    Args:
        source: a path, which is not looked at, or INSTALLED.

    Raises:
        FileNotFoundError: INSTALLED, and the package or its file is not there; the message says how to get it.
    """
    if str(source) != INSTALLED:
        return Path(source)
    try:
        files = importlib.metadata.files(PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        raise FileNotFoundError(f"{PACKAGE} is not installed: {REMEDY}") from None
    found = [Path(str(file.locate())) for file in files if file.name == FILE]
    if not found or not found[0].is_file():
        raise FileNotFoundError(f"{PACKAGE} is installed, but without {FILE}: {REMEDY}")
    return found[0]


def _parse(words: list[str]) -> Path | Literal["installed"]:
    if len(words) > 1:
        raise ValueError(f"takes one file or none, got {' '.join(words)}; name clips before it")
    return INSTALLED if words in ([], [INSTALLED]) else Path(words[0])


def _is_source(value: object) -> bool:
    return value is None or isinstance(value, Path) or value == INSTALLED


#: ``--st-lpips [FILE]``: not given None, without a file INSTALLED.
Option = Annotated[
    Path | Literal["installed"] | None,
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="[FILE]",
        instance_from_str=_parse,
        is_instance=_is_source,
        str_from_instance=lambda value: ["none" if value is None else str(value)],
    ),
]
