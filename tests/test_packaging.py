"""Kernels build and weights are found: in a wheel, an editable install, a bare checkout, in paths with a space."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from lowest_versions import lowest_versions

from vestcl import __version__

ROOT = Path(__file__).resolve().parents[1]
WEIGHTS = "vestcl/weights/vest-s.safetensors"
BUILD_A_KERNEL = """
import numpy as np
from vestcl import opencl
from vestcl.models import shipped
opencl.current().kernel("unproject.cl", "unproject", opencl.defines_for(np.dtype(np.float32)))
print(opencl.kernel_folder())
print(shipped.shipped()["vest-s"])
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `setup.py` needs of this repository, copied, so that pip's build folders don't litter it."""
    folder = tmp_path_factory.mktemp("a clone") / "vestcl checkout"
    no_caches = shutil.ignore_patterns("__pycache__")
    for name in ("vestcl", "kernels"):
        shutil.copytree(ROOT / name, folder / name, ignore=no_caches)
    (folder / WEIGHTS).parent.mkdir(exist_ok=True)
    (folder / WEIGHTS).touch()  # which file it is does not matter here
    for name in ("tests", "train"):  # must stay out of the wheel
        (folder / name).mkdir()
        (folder / name / "__init__.py").touch()
    for name in ("setup.py", "pyproject.toml", "LICENSE", "README.md"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip(sys.executable, "wheel", str(checkout), "--wheel-dir", str(folder))
    (file,) = folder.glob("vestcl-*.whl")
    return file


def pip(python: str, command: str, *arguments: str) -> None:
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    subprocess.run([sys.executable, "-m", "pip", "--python", python, command, *options, *arguments], check=True)


def found(python: str, path: Path | None, away: Path) -> tuple[Path, Path]:
    """Where a child that is started in folder ``away`` finds the kernels, once it has built one, and the weights."""
    environment = {**os.environ, "PYTHONPATH": str(path or "")}
    command = [python, "-c", BUILD_A_KERNEL]
    done = subprocess.run(command, cwd=away, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    kernels, weights = done.stdout.splitlines()
    return Path(kernels), Path(weights)


def files(folder: Path, *patterns: str) -> set[str]:
    return {file.relative_to(folder).as_posix() for pattern in patterns for file in folder.rglob(pattern)}


def test_the_wheel_holds_every_kernel_and_module_and_nothing_else(wheel: Path, checkout: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        shipped = {name for name in archive.namelist() if ".dist-info/" not in name}
        entry_points = next(name for name in archive.namelist() if name.endswith("entry_points.txt"))
        assert "vestcl = vestcl.cli.main:main" in archive.read(entry_points).decode()
    kernels = {f"vestcl/kernels/{name}" for name in files(checkout / "kernels", "*.cl", "*.h")}
    modules = {f"vestcl/{name}" for name in files(checkout / "vestcl", "*.py")}
    assert kernels
    weights = {f"vestcl/{name}" for name in files(checkout / "vestcl", "*.safetensors")}
    assert WEIGHTS in weights
    pages = {f"vestcl/{name}" for name in files(checkout / "vestcl", "*.html")}
    assert "vestcl/forecasting/page.html" in pages
    schemas = {f"vestcl/{name}" for name in files(checkout / "vestcl", "*.schema.json")}
    assert "vestcl/data/readers/camera.schema.json" in schemas
    measured = {"vestcl/bench/stability/measured.json"}
    assert shipped == kernels | modules | weights | pages | schemas | measured


def test_both_versions_are_one(wheel: Path) -> None:
    assert wheel.name == f"vestcl-{__version__}-py3-none-any.whl"


def test_every_dependency_has_a_lowest_version_that_can_be_installed() -> None:
    lowest = lowest_versions()
    floors = [requirement for requirement in lowest if "==" in requirement]
    assert {"numpy", "pyopencl[pocl]", "tyro", "pydantic", "transformers"} <= {floor.split("==")[0] for floor in floors}
    assert not [requirement for requirement in lowest if requirement.startswith("torch")]
    assert [requirement for requirement in lowest if requirement.startswith("pytest>=")]


def test_kernels_build_from_a_wheel(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    assert found(sys.executable, site, tmp_path) == (site / "vestcl" / "kernels", site / WEIGHTS)


def test_kernels_build_from_a_bare_checkout(checkout: Path, tmp_path: Path) -> None:
    assert found(sys.executable, checkout, tmp_path) == (checkout / "kernels", checkout / WEIGHTS)


def test_kernels_build_from_an_editable_install(checkout: Path, tmp_path: Path) -> None:
    environment = tmp_path / "an environment"
    venv.create(environment)
    scheme = {"base": str(environment), "platbase": str(environment)}
    site = Path(sysconfig.get_path("purelib", "venv", scheme))
    (site / "outer.pth").write_text(sysconfig.get_path("purelib"))  # vestcl's dependencies, without its own .pth
    python = str(environment / "bin" / "python")
    pip(python, "install", "--editable", str(checkout))
    assert found(python, None, tmp_path) == (checkout / "kernels", checkout / WEIGHTS)
