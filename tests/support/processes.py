"""Processes forked from one that has loaded torch, vestcl and train, but used neither torch nor OpenCL.

They begin at once, where a new interpreter takes seconds to load them; what they do is what the command would do.
"""

import multiprocessing
import os
import runpy
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from vestcl.cli import main as cli

ROOT: Final = Path(__file__).resolve().parents[2]

#: Seconds until a process that does not end is killed, and the test fails.
PATIENCE: Final = 150.0

#: torch.optim loads torch._dynamo late.
_PRELOADED: Final = ("train_scenes", "torch.distributed.run", "torch._dynamo", "torch.utils.tensorboard")


def preload() -> None:
    """Let the first process that is forked make the one that all are forked from load `_PRELOADED`."""
    paths = [str(ROOT), str(ROOT / "tests" / "support"), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, dict.fromkeys(paths)))
    multiprocessing.get_context("forkserver").set_forkserver_preload(list(_PRELOADED))


class Process:
    """``function`` in a process of its own; what it prints, to either stream, is ``output``."""

    def __init__(
        self, log: Path, function: Callable[..., Any], *arguments: Any, environment: Mapping[str, str] | None = None
    ) -> None:
        self._log = log
        context, given = multiprocessing.get_context("forkserver"), dict(environment or {})
        self._process = context.Process(target=_logged, args=(log, given, function, arguments))
        self._process.start()
        self.pid = self._process.pid or 0

    @property
    def output(self) -> str:
        return self._log.read_text() if self._log.exists() else ""

    def runs(self) -> bool:
        return self._process.is_alive()

    def kill(self, number: int = signal.SIGKILL) -> None:
        if self.runs():
            os.kill(self.pid, number)

    def wait(self, seconds: float = PATIENCE) -> int:
        """Its exit status, negative for a signal."""
        self._process.join(seconds)
        if self._process.exitcode is None:
            self.kill(signal.SIGTERM)  # a process that has others then ends them, which a SIGKILL would leave behind
            self._process.join(10)
            self.kill()
            raise AssertionError(f"it hangs:\n{self.output}")
        return self._process.exitcode

    def reports(self, line: str) -> None:
        """Wait until it has printed ``line``."""
        end = time.monotonic() + PATIENCE
        while line not in self.output.splitlines():
            assert self.runs() and time.monotonic() < end, self.output
            time.sleep(0.001)


def _logged(log: Path, environment: dict[str, str], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    with log.open("a", buffering=1) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        os.environ.update(environment)
        function(*arguments)


# ---------------------------------------------------------------- what they run


def command(*arguments: str) -> None:
    """`vestcl` with these arguments."""
    sys.exit(cli.main(list(arguments)))


def program(*arguments: str) -> None:
    """`python ARGUMENTS`: a script, or -m and a module."""
    name, *rest = arguments[1:] if arguments[0] == "-m" else arguments
    sys.argv = [name, *rest]
    if arguments[0] == "-m":
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(name, run_name="__main__")


def torchrun(options: Sequence[str], arguments: Sequence[str]) -> None:
    """`torchrun OPTIONS ARGUMENTS`, whose processes are forked as well."""
    from torch.distributed import run as elastic
    from torch.distributed.launcher.api import elastic_launch

    config, _, _ = elastic.config_from_args(elastic.parse_args([*options, *arguments]))
    config.start_method = "fork"
    elastic_launch(config, program)(*arguments)
