"""What pip needs to know about vestcl. Versions are ranges here; constraints.txt has the exact ones that are tested."""

from pathlib import Path

from setuptools import find_packages, setup

#: The page of the package index; pictures and pages that it links to are in the repository only.
README = Path(__file__).with_name("README.md")

#: Of docs/, the site that `make docs` builds.
DOCS = ["furo>=2024.8", "myst-nb>=1.1", "sphinx>=8"]

#: Of train/, which is not part of the package.
TRAIN = ["huggingface_hub>=0.34", "Jinja2>=3.1", "pydantic>=2.7", "PyYAML>=6", "tensorboard>=2.16.2"]

#: Of the page that `vestcl view` shows.
VIEWER = ["viser>=1.1"]

setup(
    name="vestcl",
    version="0.1.0",
    description="Differentiable point splatting in OpenCL for PyTorch, and forecasts of driving video from new views",
    long_description=README.read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    project_urls={"Paper": "https://skrya.github.io/projects/ffn-dsr"},
    classifiers=[  # only what was tried
        "Development Status :: 3 - Alpha",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.11",
        "Topic :: Scientific/Engineering :: Image Processing",
    ],
    license="Apache-2.0",
    license_files=["LICENSE"],
    python_requires=">=3.10",
    # The kernels live beside the package in a checkout and inside it in a wheel; opencl.kernel_folder() knows both.
    packages=[*find_packages(include=["vestcl", "vestcl.*"]), "vestcl.kernels"],
    package_dir={"vestcl.kernels": "kernels"},
    package_data={
        "vestcl": ["bench/stability/*.json", "data/readers/*.json", "forecasting/*.html", "weights/*.safetensors"],
        "vestcl.kernels": ["*.cl", "*.h", "*/*.cl", "*/*.h"],
    },
    install_requires=[
        "av>=17.1",  # the newest for Python 3.10
        "huggingface_hub>=0.27",
        "Jinja2>=3",  # of model cards
        "matplotlib>=3.8",
        "numpy>=1.26",
        "opencv-contrib-python-headless>=4.10.0.82",
        "OpenEXR>=3.3",
        "pandas>=2.2.2",  # the first for numpy 2
        "pillow>=10.1",  # load_default(size)
        "pyopencl[pocl]>=2024.2.7",  # older ones warn with current pytools
        "rich>=13.3.3",  # of viser
        "safetensors>=0.4.3",
        "scikit-image>=0.24",
        "scipy>=1.11.1",  # 1.11.0 was withdrawn
        "torch>=2.4",
        "tyro>=1.0",  # older ones take the value of `--view -0.5,0,0` for an option, and want two subcommands
    ],
    extras_require={
        "dev": [
            *TRAIN,
            *VIEWER,
            "hypothesis>=6.100",
            "ipykernel>=6.29",
            "mypy>=1.11",
            "nbclient>=0.10",
            "nbformat>=5.10",
            "playwright>=1.50",
            "pytest>=8",
            "pytest-xdist>=3.6",
            "ruff>=0.8",
            "setuptools>=77",
            "types-PyYAML>=6",
        ],
        "docs": DOCS,
        "estimators": ["transformers>=4.57.1"],
        "intel": ["intel-cmplr-lib-rt", "intel-opencl-rt"],
        "train": TRAIN,
        "viewer": VIEWER,
    },
    entry_points={"console_scripts": ["vestcl = vestcl.cli.main:main"]},
)
