"""Every notebook runs from its first cell to its last."""

import os
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

#: Smaller images and fewer steps than readers are shown: what a notebook's cells contain once, and what runs instead.
SHORTER = {
    "01_splatting": {"range(201)": "range(21)", "(0, 20, 200)": "(0, 10, 20)", "count = 3000": "count = 500"},
    "02_forecast": {"(256, 832)": "(96, 320)"},
    "03_training": {
        "street:2000-2007 --out": "street:2000-2001 --out",
        "--frames 6": "--frames 5",
        "[0.5, 0.25, 0.25]": "[0.5, 0.5]",
        "steps: 60, batch: 4": "steps: 6, batch: 2",
        "warm_up: 20": "warm_up: 4",
        "checkpoint_every: 60": "checkpoint_every: 6",
        "(2010, 2011, 2012, 2013)": "(2010,)",
    },
    "04_time_against_error": {"for title in knobs:\n    display": "for title in knobs[:2]:\n    display"},
    "05_own_video": {"height=128, width=416": "height=64, width=208"},
}


@pytest.fixture(scope="module")
def client() -> Iterator[NotebookClient]:
    """One process for all: loading torch takes it longer than some notebooks do."""
    client = NotebookClient(nbformat.v4.new_notebook(), timeout=240, kernel_name="python3")
    with client.setup_kernel(env=os.environ | {"PYTHONPATH": str(NOTEBOOKS.parent)}):
        yield client


@pytest.mark.filterwarnings("ignore")  # of Jupyter's own machinery
@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_runs(path: Path, client: NotebookClient) -> None:
    notebook = nbformat.read(path, as_version=4)
    for shown, run in SHORTER[path.stem].items():
        assert sum(cell.source.count(shown) for cell in notebook.cells) == 1, shown
        for cell in notebook.cells:
            cell.source = cell.source.replace(shown, run)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%reset -f\n%cd -q {NOTEBOOKS}"))  # no names of another's
    client.nb = notebook
    client.execute(cleanup_kc=False)
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")


def test_there_are_notebooks() -> None:
    assert list(NOTEBOOKS.glob("*.ipynb"))
