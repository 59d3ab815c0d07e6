"""docs/paper.md: every file, function and test that it names exists, and every row has all that a row needs."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "paper.md"
TEXT = PAGE.read_text(encoding="utf-8")

#: [`file.py:Name`](path), [`test_file.py::test_name`](path), [`file.yaml`](path), [words](address).
LINK = re.compile(r"\[(?P<label>[^\]]+)\]\((?P<target>[^)\s]+)\)")

COLUMNS = ("code", "status", "test")
STATUSES = ("exact", "chosen", "different")


def links(text: str) -> list[tuple[str, str]]:
    """(label without backquotes, target) of each link to a file."""
    found = [(match["label"].strip("`"), match["target"]) for match in LINK.finditer(text)]
    return [(label, target) for label, target in found if not target.startswith("https://")]


def names_of(body: list[ast.stmt], prefix: str = "") -> Iterator[str]:
    """Functions, classes and variables, those of classes as Class.name."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield prefix + node.name
            if isinstance(node, ast.ClassDef):
                yield from names_of(node.body, f"{prefix}{node.name}.")
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        yield from (prefix + target.id for target in targets if isinstance(target, ast.Name))


@functools.cache
def defined_in(path: Path) -> frozenset[str]:
    """What a Python file defines, or an OpenCL file as kernels."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".cl":
        return frozenset(re.findall(r"\bkernel\s+void\s+(\w+)\s*\(", text))
    return frozenset(names_of(ast.parse(text).body))


def faults(text: str, page: Path) -> list[str]:
    """What is wrong with the links of a page's text."""
    found = []
    for label, target in links(text):
        path = (page.parent / target).resolve()
        file, colon, name = label.partition(":")
        if not path.is_file():
            found.append(f"{target}: no such file")
        elif file != path.name:
            found.append(f"{label}: the link is to {path.name}")
        elif name.startswith(":") and not name.startswith(":test_"):
            found.append(f"{label}: is not a test")
        elif colon and name.removeprefix(":") not in defined_in(path):
            found.append(f"{label}: no such name")
    return found


def rows(text: str) -> list[list[str]]:
    """Cells of the tables' rows, headers and the legend of statuses left out; an escaped bar is part of its cell."""
    lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in text.splitlines() if line.startswith("| ")]
    cells = [[cell.strip() for cell in line] for line in lines]
    return [row for row in cells if len(row) != 2 and tuple(row[1:]) != COLUMNS]


def test_everything_it_names_exists() -> None:
    assert len(links(TEXT)) > 200 and not faults(TEXT, PAGE)


@pytest.mark.parametrize("row", rows(TEXT), ids=lambda row: row[0][:40])
def test_a_row_has_code_a_status_and_a_test(row: list[str]) -> None:
    item, code, status, tests = row
    assert item and links(code) and links(tests) and not links(item)
    assert not any("::" in label for label, _ in links(code))
    assert all("::test_" in label and re.match(r"\.\./tests/(\w+/)?test_", target) for label, target in links(tests))
    assert re.split(r"[ ,.:;]", status)[0] in STATUSES


def test_it_has_all_parts_and_is_linked() -> None:
    assert len(rows(TEXT)) > 50 and len({row[0] for row in rows(TEXT)}) == len(rows(TEXT))
    for page in ("README.md", "CONVENTIONS.md"):
        assert "docs/paper.md" in (ROOT / page).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("label", "target", "fault"),
    [
        ("encoder.py:Encoder", "../vestcl/models/networks/encoder.py", None),
        ("encoder.py:Encoder.forward", "../vestcl/models/networks/encoder.py", None),
        (
            "encoder.py:Encoder.backward",
            "../vestcl/models/networks/encoder.py",
            "encoder.py:Encoder.backward: no such name",
        ),
        ("encoder.py:STRIDE", "../vestcl/models/networks/encoder.py", None),
        ("encoder.py:Encoder", "../vestcl/models/networks/refine.py", "encoder.py:Encoder: the link is to refine.py"),
        ("decoder.py:Decoder", "../vestcl/models/decoder.py", "../vestcl/models/decoder.py: no such file"),
        ("unproject.cl:unproject_backward", "../kernels/unproject.cl", None),
        ("unproject.cl:row_start", "../kernels/unproject.cl", "unproject.cl:row_start: no such name"),
        ("test_docs_paper.py::test_a", "../tests/test_docs_paper.py", "test_docs_paper.py::test_a: no such name"),
        ("test_docs_paper.py::links", "../tests/test_docs_paper.py", "test_docs_paper.py::links: is not a test"),
    ],
)
def test_a_wrong_link_is_found(label: str, target: str, fault: str | None) -> None:
    assert faults(f"| x | [`{label}`]({target}) |", PAGE) == ([] if fault is None else [fault])
