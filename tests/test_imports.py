"""Who may import whom (STYLE, "The house"), read from the source without running it."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = sorted((ROOT / "vestcl").rglob("*.py"))
SOURCES = [*LIBRARY, *sorted((ROOT / "train").rglob("*.py"))]


def imports(file: Path) -> Iterator[str]:
    """Every module that ``file`` imports, anywhere in it; ``from vestcl import runtime`` gives
    vestcl.opencl.session."""
    package = file.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*package[: len(package) - node.level + 1], *filter(None, [node.module])])
            origin = base if node.level else str(node.module)
            yield from (f"{origin}.{a.name}" if origin == "vestcl" else origin for a in node.names)


def is_in(module: str, *packages: str) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def identify(file: Path) -> str:
    return file.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("file", SOURCES, ids=identify)
def test_only_the_runtime_imports_pyopencl(file: Path) -> None:
    if identify(file) != "vestcl/opencl/session.py":
        assert not [module for module in imports(file) if is_in(module, "pyopencl")]


@pytest.mark.parametrize("file", LIBRARY, ids=identify)
def test_the_library_does_not_import_training(file: Path) -> None:
    assert not [module for module in imports(file) if is_in(module, "train", "tests")]


@pytest.mark.parametrize("file", sorted((ROOT / "vestcl" / "reference").rglob("*.py")), ids=identify)
def test_the_twins_stand_alone(file: Path) -> None:
    allowed = ("torch", "vestcl.geometry", "vestcl.constants", "vestcl.reference", *sys.stdlib_module_names)
    assert not [module for module in imports(file) if not is_in(module, *allowed)]


def test_the_runtime_knows_no_operator() -> None:
    ours = {module for module in imports(ROOT / "vestcl" / "opencl.py") if is_in(module, "vestcl")}
    assert ours <= {f"vestcl.{name}" for name in ("constants", "icd", "pocl_cache", "pocl_cpu", "robust_lock")}


@pytest.mark.parametrize("file", sorted((ROOT / "vestcl" / "ops").rglob("*.py")), ids=identify)
def test_operators_stand_on_the_runtime(file: Path) -> None:
    below = ("vestcl.constants", "vestcl.geometry", "vestcl.opencl.host_memory", "vestcl.ops", "vestcl.opencl.session")
    ours = {module for module in imports(file) if is_in(module, "vestcl")}
    assert not {module for module in ours if not is_in(module, *below)}


def test_importing_vestcl_loads_no_driver() -> None:
    """A driver in memory means that something has enumerated the platforms."""
    code = (
        "import vestcl, vestcl.opencl.device_list as device_list\n"
        "assert device_list.all_devices.cache_info().currsize == 0\n"
        "assert 'libpocl' not in open('/proc/self/maps').read()\n"
        "assert opencl.devices()\n"
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
