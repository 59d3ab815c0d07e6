"""Every notebook runs from its first cell to its last."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"

#: Fewer steps of training than readers are shown.
SHORTER = {
    "03_training": {
        "steps: 60": "steps: 10",
        "warm_up: 20": "warm_up: 4",
        "checkpoint_every: 60": "checkpoint_every: 10",
        "(2010, 2011, 2012, 2013)": "(2010,)",
    }
}


@pytest.mark.filterwarnings("ignore")  # of Jupyter's own machinery
@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_runs(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOKS.parent))
    notebook = nbformat.read(path, as_version=4)
    for shown, run in SHORTER.get(path.stem, {}).items():
        assert sum(cell.source.count(shown) for cell in notebook.cells) == 1
        for cell in notebook.cells:
            cell.source = cell.source.replace(shown, run)
    client = NotebookClient(notebook, timeout=240, kernel_name="python3", resources={"metadata": {"path": NOTEBOOKS}})
    client.execute()
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")


def test_there_are_notebooks() -> None:
    assert list(NOTEBOOKS.glob("*.ipynb"))
