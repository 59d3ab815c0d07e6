"""The command line: `vestcl forecast`, `view`, `prepare`, `devices`, `doctor`, `demo`, `bench`.

Importing this module takes no time: whatever does is imported by `main`, which Ctrl-C ends by one line at any moment.
"""

import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from vestcl import interrupt

if TYPE_CHECKING:
    from vestcl.cli.commands import Bench, Demo, Devices, Doctor, Forecast, Prepare, View

__all__ = ["Bench", "Demo", "Devices", "Doctor", "Forecast", "Prepare", "View", "main"]

#: Modules in vestcl.bench: the ``main`` of `vestcl bench train-step`'s takes a TrainStepBench, may return an exit code.
_BENCHES: Final = {
    "splat": "splat.bench",
    "operators": "splat.operators",
    "pipeline": "pipeline.bench",
    "train-step": "network.train_step",
    "network": "network.bench",
    "pareto": "pareto.bench",
    "stability": "stability.bench",
    "inpaint": "forecast.inpaint",
    "camera": "camera",
    "depth": "depth",
    "front": "front",
    "forecast": "forecast.bench",
    "compare": "common.compare",
}


#: Module and function of each command; the function takes the command, and may return an exit code.
_COMMANDS: Final = {
    "Forecast": ("vestcl.cli.forecast", "run"),
    "Prepare": ("vestcl.cli.prepare", "run"),
    "View": ("vestcl.cli.view", "run"),
    "Devices": ("vestcl.cli.devices", "run"),
    "Doctor": ("vestcl.cli.devices", "run_doctor"),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'vestcl.cli.main' has no attribute {name!r}")
    return getattr(import_module("vestcl.cli.commands"), name)


@interrupt.command
def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; an error that the user can correct is one line on stderr, with exit code 2.

    Args:
        arguments: the command line; None takes the process's own.
    """
    from vestcl._version import __version__
    from vestcl.cli import threads

    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        threads.settle(given)
    from vestcl.cli import command_line

    if given == ["--version"]:
        print(f"vestcl {__version__}")
        return 0
    parse = _parsed_bench if given[:1] == ["bench"] else _parsed_command
    return command_line.run(lambda: parse(given), own=arguments is None)


def _parsed_command(arguments: Sequence[str]) -> tuple[Any, Callable[[], int]]:
    """The options, and what to call for them."""
    from vestcl.cli import command_line, commands

    kinds: dict[str, Callable[..., Any]] = {
        "forecast": commands.Forecast,
        "view": commands.View,
        "prepare": commands.Prepare,
        "devices": commands.Devices,
        "doctor": commands.Doctor,
        "demo": commands.Demo,
        "bench": commands.Bench,
    }
    about = (
        "Forecasts of driving video from new views, in OpenCL. `vestcl --version` prints the version, "
        "`vestcl --tyro-print-completion bash` (or zsh) a script that completes its options."
    )
    command = command_line.subcommand(kinds, "vestcl", arguments, about)
    return command, lambda: _run(command)


def _run(command: Any) -> int:
    from vestcl.cli import command_line, threads

    threads.apply(getattr(command, "threads", None))
    start, busy = time.perf_counter(), time.process_time()
    with command_line.loudness(command.quiet, command.verbose):
        status = _run_here(command)
    if type(command).__name__ == "View":  # which waits for its visitors
        return status
    if line := threads.slow_line(time.perf_counter() - start, time.process_time() - busy):
        print(line, file=sys.stderr)
    return status


def _run_here(command: Any) -> int:
    if type(command).__name__ == "Demo":
        return _run_demo(command)
    module, function = _COMMANDS[type(command).__name__]
    return int(getattr(import_module(module), function)(command) or 0)


def _run_demo(options: "Demo") -> int:
    from vestcl import opencl
    from vestcl.cli import demo

    with opencl.use(options.device):
        demo.run(options.out, options.height, options.width, options.seed, options.model, options.quality)
    return 0


def _parsed_bench(arguments: Sequence[str]) -> tuple[Any, Callable[[], int]]:
    """As `_parsed_command`, of the bench that is asked for: one that can't be imported must not stop the others."""
    from vestcl.cli import command_line, threads

    count, arguments = threads.asked_for(arguments), threads.without_option(arguments)
    names = arguments[1:2]
    benches = _benches(sorted({*names} & {*_BENCHES}), asked=True) or _benches([*_BENCHES], asked=False)
    kinds: dict[str, Callable[..., Any]] = {name: kind for name, (_, kind) in benches.items()}
    config = command_line.subcommand(kinds, "vestcl bench", arguments[1:])
    module = next(module for module, kind in benches.values() if type(config) is kind)

    def measure() -> int:
        threads.apply(count)
        return int(module.main(config) or 0)

    return config, measure


def _benches(names: Sequence[str], asked: bool) -> dict[str, tuple[ModuleType, type]]:
    """Modules and settings of those of ``names`` that this installation has."""
    return {name: bench for name in names if (bench := _bench_of(name, asked)) is not None}


def _bench_of(name: str, asked: bool) -> tuple[ModuleType, type] | None:
    """None where there is none of that name; a broken one that was not asked for is a warning, not an error."""
    path = f"vestcl.bench.{_BENCHES[name]}"
    try:
        module = import_module(path)
        return module, getattr(module, f"{name.title().replace('-', '')}Bench")
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name and f"{path}.".startswith(f"{error.name}."):
            return None
        if asked or interrupt.is_interrupt(error):
            raise
        from vestcl.cli import command_line

        command_line.print_error(f"bench {name} is left out: {error!r}", "yellow")
        return None
