"""Who may import whom, read from the source without running it: the order of packages, no circles, nothing private."""

import ast
import functools
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = sorted((ROOT / "vestcl").rglob("*.py"))
SOURCES = [*LIBRARY, *sorted((ROOT / "train").rglob("*.py"))]

#: The packages of vestcl; each may import those of its own line and of the lines above it.
ORDER = (
    ("_version", "constants", "shapes", "geometry", "clock", "times", "interrupt"),
    ("opencl", "io"),
    ("ops", "reference", "data"),
    ("scene",),
    ("models", "prepare"),
    ("forecasting",),
    ("evaluation",),
    ("doctor", "bench", "viewer", "cli", "__main__"),
)
LEVELS = {folder: level for level, group in enumerate(ORDER) for folder in group}


def module_of(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(file): file for file in SOURCES}


@functools.cache
def imports(file: Path) -> tuple[str, ...]:
    """Every name that ``file`` imports, anywhere in it: modules, and what is taken from them as module.name."""
    return tuple(_imports(file))


def _imports(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@functools.cache
def graph() -> Mapping[str, frozenset[str]]:
    """Module -> the modules of ours that it imports, for type checking only as well."""
    found = {}
    for module, file in MODULES.items():
        names = imports(file)
        taken = (name if name in MODULES else name.rpartition(".")[0] for name in names)
        found[module] = frozenset(name for name in taken if name in MODULES and name != module)
    return found


def is_in(module: str, *packages: str) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def identify(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


def cycle(edges: Mapping[str, frozenset[str]]) -> list[str]:
    """A circle's modules; none where there is no circle."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_module_imports_itself_by_others() -> None:
    assert cycle(graph()) == []
    assert cycle({"a": frozenset("b"), "b": frozenset("a")}), "a circle would be found"


def folder(module: str) -> str:
    return module.split(".")[1] if module.startswith("vestcl.") else ""


def faults(files: Iterable[Path], found: Callable[[Path], Iterable[str]]) -> dict[str, list[str]]:
    """By file, what ``found`` finds in it; files without are left out."""
    by_file = {identify(file): sorted(found(file)) for file in files}
    assert by_file
    return {file: names for file, names in by_file.items() if names}


def test_packages_import_downwards() -> None:
    def upwards(file: Path) -> set[str]:
        own = folder(module_of(file))
        if not own:  # the package itself has lazy names only
            return set()
        taken = {folder(module) for module in graph()[module_of(file)]} - {""}
        return {name for name in taken if LEVELS[name] > LEVELS[own]}

    assert faults(LIBRARY, upwards) == {}


def test_every_package_has_a_level() -> None:
    assert {folder(module) for module in MODULES if folder(module)} <= {*LEVELS, "weights"}


def hidden_from(module: str, name: str) -> bool:
    """Whether ``name`` passes a private part that is not of ``module``'s own package."""
    parts = name.split(".")
    for depth, part in enumerate(parts):
        if part.startswith("_") and not part.startswith("__"):
            return not is_in(module, ".".join(parts[:depth]))
    return False


def test_nothing_private_is_imported_from_elsewhere() -> None:
    def private(file: Path) -> list[str]:
        ours = [name for name in imports(file) if is_in(name, "vestcl", "train")]
        return [name for name in ours if hidden_from(module_of(file), name)]

    assert faults(SOURCES, private) == {}


@pytest.mark.parametrize(
    ("module", "name", "hidden"),
    [
        ("vestcl.bench.splat.bench", "vestcl.models._layers.check", True),
        ("vestcl.models.steps.render", "vestcl.models._layers", False),
        ("vestcl.io.images", "vestcl.io._headers.size", False),
        ("vestcl.cli.main", "vestcl.__version__", False),
        ("train.fit", "vestcl.evaluation.perceptual._difference", True),
    ],
)
def test_what_counts_as_private(module: str, name: str, hidden: bool) -> None:
    assert hidden_from(module, name) is hidden


def test_only_the_runtime_imports_pyopencl() -> None:
    elsewhere = [file for file in SOURCES if not identify(file).startswith("vestcl/opencl/")]
    assert faults(elsewhere, lambda file: [module for module in imports(file) if is_in(module, "pyopencl")]) == {}


def test_the_library_does_not_import_training() -> None:
    assert faults(LIBRARY, lambda file: [module for module in imports(file) if is_in(module, "train", "tests")]) == {}


def test_the_reference_imports_geometry_only() -> None:
    allowed = ("torch", "vestcl.geometry", "vestcl.constants", "vestcl.reference", *sys.stdlib_module_names)
    files = (ROOT / "vestcl" / "reference").rglob("*.py")
    assert faults(files, lambda file: [module for module in imports(file) if not is_in(module, *allowed)]) == {}


def test_operators_depend_on_the_runtime() -> None:
    below = ("vestcl.constants", "vestcl.geometry", "vestcl.ops", "vestcl.opencl")

    def others(file: Path) -> set[str]:
        return {module for module in imports(file) if is_in(module, "vestcl") and not is_in(module, *below)}

    assert faults((ROOT / "vestcl" / "ops").rglob("*.py"), others) == {}


def test_importing_vestcl_loads_no_driver() -> None:
    """A driver in memory means that something has enumerated the platforms."""
    code = (
        "import vestcl.opencl.session\n"
        "from vestcl.opencl import device_list\n"
        "assert device_list.all_devices.cache_info().currsize == 0\n"
        "assert 'libpocl' not in open('/proc/self/maps').read()\n"
        "assert device_list.devices()\n"
        "assert 'libpocl' in open('/proc/self/maps').read()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_the_help_loads_neither_torch_nor_opencl() -> None:
    """It is there in a quarter of a second; each of these takes a tenth or more."""
    heavy = ("torch", "pyopencl", "numpy", "cv2", "scipy", "skimage", "matplotlib", "pandas")
    script = f"""
import contextlib, io, sys
from vestcl.cli.main import main
for command in ([], ["forecast"], ["devices"]):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main([*command, "--help"])
print([name for name in {heavy} if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT, check=True)
    assert ran.stdout.strip() == "[]"


#: Modules that a program may import first, and what has to be right then.
FIRST = {
    "vestcl.scene.perception": "",
    "vestcl.scene.motion.mask": "",
    **dict.fromkeys(
        ("vestcl.forecasting.result", "vestcl.forecasting.api", "vestcl.cli.main", "vestcl.bench"),
        "import vestcl; assert callable(vestcl.forecast) and callable(vestcl.open)",
    ),
}

#: A child for each module, of one process that has loaded much of what they need of others, but nothing of vestcl.
IMPORTS_EACH_FIRST = """
import ast, os, sys
import av, cv2, huggingface_hub, matplotlib, numpy, pandas, pyopencl, rich, scipy.optimize, skimage.registration, torch
assert not [name for name in sys.modules if name.partition(".")[0] == "vestcl"]
for first, check in ast.literal_eval(sys.argv[1]).items():
    child = os.fork()
    if not child:
        exec(f"import {first}\\n{check}")
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        print(first)
"""


def test_a_module_may_be_the_first() -> None:
    """A package's __init__ runs before its modules, and must not lead into a circle; `vestcl.forecast` is a function
    though a package has its name."""
    command = [sys.executable, "-c", IMPORTS_EACH_FIRST, str(FIRST)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert ran.stdout.split() == [], ran.stderr
