"""README.md and docs/: what they show runs, parses and exists."""

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import conf
import help_pages
import pytest

from vestcl.cli import main as cli
from vestcl.cli.main import main

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONVENTIONS.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]

_BLOCK = re.compile(r"^```(?P<kind>[\w{}-]+)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"\]\((?!https?://|#)(?P<target>[^)\s#]+)(?:#[^)\s]*)?\)")

#: Scripts of train/, whose own parsers take minutes of imports; that they exist is enough here.
_TRAINING = re.compile(r"(?:torchrun .*)?(?:python )?-m (?P<module>train\.\w+)")


def blocks(page: Path, kind: str) -> list[str]:
    return [match["text"] for match in _BLOCK.finditer(page.read_text(encoding="utf-8")) if match["kind"] == kind]


def commands() -> Iterator[tuple[str, str]]:
    """(page, line) of each command of the pages' sh blocks, without comments."""
    for page in PAGES:
        for text in blocks(page, "sh"):
            for line in text.replace("\\\n", " ").splitlines():
                bare = line.split(" #")[0].strip()
                if bare and not bare.startswith("#"):
                    yield page.relative_to(ROOT).as_posix(), bare


def test_readme_is_short_and_has_its_parts() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    for part in ("docs/street.webp", "download.pytorch.org/whl/cpu", "activate", "@inproceedings{", "Apache-2.0"):
        assert part in text
    assert 10_000 < (ROOT / "docs" / "street.webp").stat().st_size < 2_000_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files(page: Path) -> None:
    targets = [match["target"] for match in _LINK.finditer(page.read_text(encoding="utf-8"))]
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize(("page", "line"), list(commands()), ids=lambda value: value[:60])
def test_a_command_parses(page: str, line: str) -> None:
    """It is not run: forecasts, benches and training take from seconds to hours."""
    line = re.sub(r"^(VESTCL_DEVICE=\w+|torchrun .*--no-python) ", "", line)
    script = _TRAINING.match(line)
    if script:
        assert importlib.util.find_spec(script["module"]), f"{page}: {script['module']}"
    elif line.startswith("vestcl ") and "--version" not in line and "--tyro-" not in line:
        arguments = shlex.split(line)[1:]
        parse = cli._parsed_bench if arguments[0] == "bench" else cli._parsed_command
        assert parse(arguments)
    elif line.startswith("make "):
        assert re.search(rf"^{line.split()[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    else:
        assert line.split()[0] in ("vestcl", "python3", "source", "pip", "mkdir", "python", "export"), f"{page}: {line}"


def test_readme_splats() -> None:
    """The example of README.md, as it is."""
    (example,) = (text for text in blocks(README, "python") if "vestcl.splat(" in text)
    names: dict[str, object] = {}
    exec(example, names)
    assert names["translation"].grad.abs().min() > 0  # type: ignore[attr-defined]
    assert names["colour"].grad.abs().max() > 0  # type: ignore[attr-defined]


def test_readme_forecasts_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of README.md, of a smaller street."""
    (example,) = (text for text in blocks(README, "python") if "vestcl.forecast(" in text)
    small = example.replace('"street:3")', '"street:3", height=64, width=208, frames=4)').replace("steps=5", "steps=3")
    assert small.count("height=64") == 1 and small.count("steps=3") == 1
    monkeypatch.chdir(tmp_path)
    exec(small, {})
    assert (tmp_path / "future" / "forecast.json").is_file()


def test_the_reference_lists_every_command() -> None:
    assert {"forecast", "devices", "bench"} <= set(help_pages._subcommands(help_pages.help_of(main, [])))
    assert set(help_pages._subcommands(help_pages.help_of(main, ["bench"]))) == set(cli._BENCHES)
    text = help_pages.help_of(main, ["forecast"])
    assert "--compare" in text and "\x1b" not in text and not re.search(r" $", text, re.MULTILINE)


def test_links_to_source_files_stay_as_names() -> None:
    page = ["[`a.py:A`](../vestcl/a.py), [notebook 03](../../notebooks/03_training.ipynb), [memory](../memory.md)"]
    conf.page_text(None, "guides/train", page)
    assert page == ["`a.py:A`, [notebook 03](../notebooks/03_training.ipynb), [memory](../memory.md)"]
    conventions = [""]
    conf.page_text(None, "concepts/conventions", conventions)
    assert "(../paper.md)" in conventions[0] and conventions[0].startswith("# Conventions")


def test_formulas_of_docstrings_are_no_markup() -> None:
    lines = ["Of |x| * y.", "", "    a_i = |p - q|", "", "Args:", "    x_: px."]
    conf.docstring(None, "function", "f", None, None, lines)
    assert lines == ["Of \\|x\\| \\* y.", "", "::", "", "    a_i = |p - q|", "", "Args:", "    x\\_: px."]


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_scripts(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--tyro-print-completion", shell])
    script = capsys.readouterr().out
    assert not caught.value.code and "forecast" in script and "bench" in script


def test_python_m_vestcl() -> None:
    """The module is there, and is the command."""
    text = (ROOT / "vestcl" / "__main__.py").read_text(encoding="utf-8")
    assert "from vestcl.cli.main import main" in text and importlib.util.find_spec("vestcl.__main__")
