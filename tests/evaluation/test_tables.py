"""Tables on the screen: as wide as it is, in parts where they are wider, and no cell cut."""

import io

import pytest
from rich.console import Console

from vestcl.evaluation.tables import Grid, to_rich

METHODS = ("repeat last", "geometric, stereo pair", "optical flow, right camera's past (oracle)")


def grid(columns: int) -> Grid:
    heading = ("", *(f"metric {chr(65 + i)} t+{i}" for i in range(columns)))
    rows = tuple((method, *(f"{row}{i:02}.123" for i in range(columns))) for row, method in enumerate(METHODS, start=1))
    return Grid("A title", heading, rows, ("A note.",))


def shown(made: Grid, width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    console.print(to_rich(made))
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("columns", [1, 4, 17])
def test_no_cell_is_cut(width: int, columns: int) -> None:
    lines = shown(grid(columns), width)
    text = "\n".join(lines)
    assert max(map(len, lines)) <= width
    assert "…" not in text
    for row in grid(columns).rows:
        assert all(cell in text for cell in row[1:])
    assert text.count("A title") == text.count("A note.") == 1


def test_a_narrow_table_is_one() -> None:
    assert "\n".join(shown(grid(4), 80)).count("repeat last") == 1
    assert "\n".join(shown(grid(17), 80)).count("repeat last") > 2
    assert "\n".join(shown(grid(17), 300)).count("repeat last") == 1


def test_a_table_of_one_column() -> None:
    assert "repeat last" in "\n".join(shown(grid(0), 80))
