"""The command line's reference, from the parsers themselves: what `--help` prints, command by command."""

import contextlib
import importlib
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Final

#: Columns of the help in the pages.
WIDTH: Final = 86

_ESCAPES: Final = re.compile(r"\x1b\[[\d;]*m")

_ABOUT: Final = """# Command line

What `vestcl COMMAND --help` prints. `python -m vestcl` is the same command where `vestcl` is not on the `PATH`.
`vestcl --version` prints the version. Ctrl-C ends any command by one line; an error that you can correct is one line
with exit status 2.

## Shell completion

`vestcl --tyro-print-completion SHELL` prints a completion script for `bash` or `zsh`; for bash:

```sh
mkdir -p ~/.local/share/bash-completion/completions
vestcl --tyro-print-completion bash > ~/.local/share/bash-completion/completions/vestcl
```
"""

_TRAINING: Final = """# Training scripts

What `python -m train.NAME --help` prints. They are part of a checkout, not of the installed package, and need
`pip install '.[train]'`. The keys of training configurations are in `train/settings/`, those of the shipped ones in
`train/configs/*.yaml`.
"""

#: Modules of train/ with a command line.
SCRIPTS: Final = ("fit", "evaluate", "export", "card", "forecasts", "refinement", "refinement_scores", "peer")


def vestcl() -> str:
    """The page of `vestcl`: every command and every bench."""
    from vestcl.cli.main import main

    commands = [[name] for name in _subcommands(help_of(main, [])) if name != "bench"]
    benches = [["bench", name] for name in _subcommands(help_of(main, ["bench"]))]
    return "\n".join([_ABOUT, *(_section("vestcl", main, each) for each in ([], *commands, *benches))])


def train() -> str:
    """The page of the scripts in train/."""
    return "\n".join([_TRAINING, *(_section(f"python -m train.{name}", _script(name), []) for name in SCRIPTS)])


def _script(name: str) -> Callable[[Sequence[str]], object]:
    module = importlib.import_module(f"train.{name}")
    if not hasattr(module, "main"):
        module = importlib.import_module(f"train.{name}.__main__")
    main: Callable[[Sequence[str]], object] = module.main
    return main


def _subcommands(text: str) -> list[str]:
    """Of a help that begins with `usage: vestcl [-h] {forecast,prepare}`."""
    found = re.search(r"\{([\w,\s-]+)\}", text)
    return [name.strip() for name in found[1].split(",")] if found else []


def _section(prog: str, main: Callable[[Sequence[str]], object], arguments: list[str]) -> str:
    title = " ".join([prog, *arguments])
    return f"## `{title}`\n\n```text\n{help_of(main, arguments)}\n```\n"


def help_of(main: Callable[[Sequence[str]], object], arguments: Sequence[str]) -> str:
    """What a command prints with --help, as plain text."""
    screen = io.StringIO()
    with contextlib.redirect_stdout(screen), _columns(), contextlib.suppress(SystemExit):
        main([*arguments, "--help"])
    text = _ESCAPES.sub("", screen.getvalue()).strip()
    return "\n".join(line.rstrip() for line in text.splitlines())


@contextlib.contextmanager
def _columns() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ("COLUMNS", "NO_COLOR")}
    os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1")
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
