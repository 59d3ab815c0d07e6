"""The parameters of a kernel, from its source: launches give arguments by name, and each is checked once."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from vestcl.opencl.programs import Defines

_SCALARS: Final[Mapping[str, type[np.generic]]] = {
    "int": np.int32, "uint": np.uint32, "long": np.int64, "ulong": np.uint64, "float": np.float32, "double": np.float64,
}  # fmt: skip
_QUALIFIERS: Final = {"const", "global", "constant", "restrict"}


@dataclass(frozen=True)
class Parameter:
    """One parameter of a kernel, in its order."""

    name: str
    scalar: type[np.generic] | None
    """None: a buffer."""


def parameters(text: str, kernel: str, defines: Defines) -> tuple[Parameter, ...]:
    """Those of ``kernel``.

    Args:
        text: the program's source, from `source`.
        kernel: its name.
        defines: what the program is built with; the parameters may be inside ``#ifdef``, not nested.

    Raises:
        ValueError: there is no such kernel, or a parameter has a type that launches do not know.
    """
    found = re.search(rf"\bvoid\s+{kernel}\s*\(([^{{]*?)\)\s*\{{", re.sub(r"//.*", "", text))
    if found is None:
        raise ValueError(f"`kernel` must be one of the program's, got {kernel!r}")
    declarations = " ".join(_compiled(found[1], defines)).split(",")
    return tuple(_parameter(declaration, defines) for declaration in declarations if declaration.strip())


def _compiled(text: str, defines: Defines) -> Iterator[str]:
    """The lines that the preprocessor leaves."""
    keep = True
    for line in text.splitlines():
        if condition := re.match(r"\s*#ifdef\s+(\w+)", line):
            keep = condition[1] in defines
        elif re.match(r"\s*#endif", line):
            keep = True
        elif keep:
            yield line


def _parameter(declaration: str, defines: Defines) -> Parameter:
    *words, name = re.findall(r"\w+", declaration)
    if "*" in declaration:
        return Parameter(name, None)
    words = [str(defines.get(word, word)) for word in words if word not in _QUALIFIERS]
    if len(words) != 1 or words[0] not in _SCALARS:
        raise ValueError(f"`text` must declare numbers and pointers, got {declaration.strip()!r}")
    return Parameter(name, _SCALARS[words[0]])


def check_arguments(what: str, wanted: tuple[Parameter, ...], arguments: Mapping[str, Any]) -> None:
    """That ``arguments`` are those of the kernel, by name, and of the exact type.

    Raises:
        TypeError: they are not; the message begins with ``what``.
    """
    names = {parameter.name for parameter in wanted}
    faults = [f"`{name}` is missing" for name in names - set(arguments)]
    faults += [f"it has no `{name}`" for name in arguments if name not in names]
    for parameter in wanted:
        argument = arguments.get(parameter.name)
        given = type(argument) if isinstance(argument, np.generic) else None
        if parameter.name in arguments and given is not parameter.scalar:
            kinds = [kind.__name__ if kind else "a buffer" for kind in (parameter.scalar, given)]
            faults.append("`{}` must be {}, got {}".format(parameter.name, *kinds))
    if faults:
        raise TypeError(f"{what}: {'; '.join(sorted(faults))}")
