"""What all commands have in common: how they parse, and what they print where something is wrong."""

import contextlib
import errno
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, TextIO, TypeVar

import tyro
from rich.console import Console
from rich.text import Text

from vestcl import interrupt
from vestcl.cli import options

#: Exit status of an error that the user can correct.
REFUSED: Final = 2

#: What memory that can't be allocated is called in errors that are not a MemoryError: torch's and OpenCL's.
_NO_MEMORY: Final = (
    "can't allocate memory",
    "not enough memory",
    "OUT_OF_HOST_MEMORY",
    "MEM_OBJECT_ALLOCATION_FAILURE",
)

Options = TypeVar("Options")

Parsed = tuple[Any, Callable[[], int]]
"""A command's options, and what to call for them."""


def subcommand(kinds: Mapping[str, Callable[..., Any]], prog: str, arguments: Sequence[str], about: str = "") -> Any:
    """The options of one of several commands, parsed and checked.

    Args:
        kinds: dataclass by command.
        prog: what it is called by.
        arguments: the command line.
        about: what its help begins with.

    Raises:
        ValueError: an option that is empty, out of range, or an output that can't be written.
        SystemExit: 2 and a message where it does not parse, 0 after the help.
    """
    options.check_arguments(arguments)
    parsed = tyro.extras.subcommand_cli_from_dict(
        dict(kinds), prog=prog, description=about or None, args=list(arguments)
    )
    options.check_options(parsed)
    return parsed


def parsed(kind: type[Options], prog: str, about: str | None, arguments: Sequence[str] | None) -> Options:
    """The options of a command without subcommands, parsed and checked.

    Args:
        kind: a dataclass.
        prog: what it is called by.
        about: what its help begins with.
        arguments: the command line; None is the process's own.

    Raises:
        SystemExit: 2 and a message where it does not parse or an option is refused, 0 after the help.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        options.check_arguments(given)
        config = tyro.cli(kind, prog=prog, description=about, args=given)
        options.check_options(config)
    except (ValueError, OSError) as error:
        print_error(f"error: {in_words(error)}")
        raise SystemExit(REFUSED) from error
    return config


def run(parse: Callable[[], Parsed], own: bool) -> int:
    """Parse and call; the exit status. An error that the user can correct is one line on stderr.

    Args:
        parse: as `Parsed`.
        own: whether this process is the command's, so that warnings may be lines of it, too.
    """
    config: Any = None
    with _notes_as_lines() if own else contextlib.nullcontext():
        try:
            config, call = parse()
            status = call()
            sys.stdout.flush()
            return status
        except BrokenPipeError:  # who read the output, `head` for one, has seen enough
            _drop_output()
            return 128 + 13
        except Exception as error:
            if interrupt.is_interrupt(error) or not is_known(error):
                raise
            print_error(f"error: {options.as_typed(in_words(error), config)}")
            return REFUSED


@contextlib.contextmanager
def loudness(quiet: bool, verbose: bool) -> Iterator[None]:
    """What a command prints inside the ``with`` block.

    Args:
        quiet: only what goes to stderr.
        verbose: what vestcl logs, too, to stderr, each stage with its seconds, and the traceback of an error.

    Raises:
        ValueError: both.
    """
    if quiet and verbose:
        raise ValueError("`quiet` and `verbose` exclude each other")
    with contextlib.ExitStack() as stack:
        if quiet:
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))  # noqa: PTH123
        if verbose:
            stack.enter_context(_log_to_stderr())
        try:
            yield
        except Exception:
            if verbose:
                traceback.print_exc()
            raise


@contextlib.contextmanager
def _log_to_stderr() -> Iterator[None]:
    """What vestcl logs below warnings, which have lines of their own."""
    logger, handler = logging.getLogger("vestcl"), logging.StreamHandler()
    handler.addFilter(lambda record: record.levelno < logging.WARNING)
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def is_known(error: Exception) -> bool:
    """Whether ``error`` is one that the user can correct; other errors are vestcl's own, and need their traceback."""
    # Where nothing has loaded the module, which takes a tenth of a second, no error is from there.
    errors = sys.modules.get("vestcl.opencl.errors")
    if errors is not None and isinstance(error, errors.DeviceError):
        return True
    if isinstance(error, RuntimeError):
        return any(words in str(error) for words in _NO_MEMORY)
    return isinstance(error, ValueError | OSError | MemoryError)


def in_words(error: Exception) -> str:
    """The message of an error that `is_known`: an OSError's file comes first, as in all other messages."""
    if isinstance(error, OSError) and error.strerror:
        if error.errno == errno.ENOSPC and error.filename is None:
            _drop_output()
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY):
        return f"out of memory: smaller images and fewer steps need less ({str(error).splitlines()[0][:120]})"
    return str(error)


def print_error(line: str, style: str = "red") -> None:
    """On stderr; bars and tables use stdout."""
    Console(stderr=True).print(Text(line, style=style), soft_wrap=True)


class _Lines(logging.Handler):
    """Prints each message once: clips are opened more than once."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        if (message := record.getMessage()) not in self._said:
            self._said.add(message)
            print_error(f"warning: {message}", "yellow")


@contextlib.contextmanager
def _notes_as_lines() -> Iterator[None]:
    """Warnings, and what vestcl logs, are for the user of a command: a line each, without the location in the code."""

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, UserWarning):
            print_error(f"warning: {message}", "yellow")
        else:
            before(message, category, filename, lineno, file, line)

    before, lines = warnings.showwarning, _Lines()
    warnings.showwarning = show
    logging.getLogger("vestcl").addHandler(lines)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its warnings are about its own cache
    try:
        yield
    finally:
        warnings.showwarning = before
        logging.getLogger("vestcl").removeHandler(lines)


def _drop_output() -> None:
    """Nothing more can be written to stdout: what is left in its buffer must not raise when Python ends."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
