"""Sphinx: `make docs` builds docs/_build/html; warnings are errors, doctests run.

Pages link to source files of the repository, which the site does not have: there the name stays without a link. Pages
of other folders, CONVENTIONS.md and CHANGELOG.md, and the command line's reference are read here, so that each text is
in one place.
"""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

DOCS: Final = Path(__file__).resolve().parent
ROOT: Final = DOCS.parent
sys.path[:0] = [str(ROOT), str(DOCS)]

import help_pages  # noqa: E402  of this folder

from vestcl._version import __version__  # noqa: E402

project = "vestcl"
copyright = "the authors of vestcl, Apache-2.0"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.doctest",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
highlight_language = "none"  # blocks without a language are formulas and listings
html_title = f"vestcl {version}"

nb_execution_mode = "off"  # the tests run the notebooks; the pages show what they printed
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type", "misc.highlighting_failure"]

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
napoleon_use_rtype = False

#: Page -> what makes its text.
GENERATED: Final[dict[str, Callable[[], str]]] = {
    "concepts/conventions": lambda: (ROOT / "CONVENTIONS.md").read_text(encoding="utf-8"),
    "changelog": lambda: (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
    "reference/command_line": help_pages.vestcl,
    "reference/training": help_pages.train,
}

#: Links to files outside docs/: source, tests, notebooks. Group 1 is the label.
_SOURCE_LINK: Final = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?:vestcl|kernels|tests|train)[^)\s]*\)")
_NOTEBOOK_LINK: Final = re.compile(r"\]\((?:\.\./)+notebooks/(\w+)\.ipynb\)")
_DOCS_LINK: Final = re.compile(r"\]\(docs/")

#: What reStructuredText would take for emphasis, substitutions and references in a docstring's formulas.
_MARKUP: Final = re.compile(r"[*|]|(?<=\w)_(?![\w])")


def page_text(_app: Any, name: str, source: list[str]) -> None:
    """Generated pages, and links without targets on the site."""
    if name in GENERATED:
        source[0] = GENERATED[name]()
    depth = "../" * name.count("/")
    text = _SOURCE_LINK.sub(r"\1", source[0])
    text = _DOCS_LINK.sub(f"]({depth}", text) if name in GENERATED else text
    source[0] = _NOTEBOOK_LINK.sub(rf"]({depth}notebooks/\1.ipynb)", text)


def always_read(*_of_the_build: Any) -> list[str]:
    """Generated pages, whose sources Sphinx does not watch."""
    return list(GENERATED)


def docstring(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Formulas of docstrings are plain text, indented ones as they are written."""
    shown, formula = list[str](), False
    for number, line in enumerate(lines):
        indented = line.startswith("    ") and bool(line.strip())
        if indented and not formula and number and not lines[number - 1].strip() and _is_text(lines, number):
            shown += ["::", ""]
            formula = True
        formula = formula and (indented or not line.strip())
        shown.append(line if formula else _MARKUP.sub(r"\\\g<0>", line))
    lines[:] = shown


def copy_notebooks(_app: Any) -> None:
    """notebooks/ is next to docs/, where Sphinx does not look."""
    folder = DOCS / "notebooks"
    folder.mkdir(exist_ok=True)
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        target, text = folder / path.name, path.read_text(encoding="utf-8")
        if not target.is_file() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")


def setup(app: Any) -> None:
    """Connect the above."""
    app.connect("builder-inited", copy_notebooks)
    app.connect("env-get-outdated", always_read)
    app.connect("source-read", page_text)
    app.connect("autodoc-process-docstring", docstring, priority=100)


def _is_text(lines: list[str], number: int) -> bool:
    """Whether the paragraph before is text, and no heading such as "Args:"."""
    before = [line for line in lines[:number] if line.strip()]
    return bool(before) and not re.fullmatch(r"\s*\w+:", before[-1])
