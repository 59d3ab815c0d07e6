"""How many threads a command uses, and that they leave each other the cores.

torch (OpenMP), OpenBLAS, OpenCV and PoCL have a pool of threads each. After an operation torch's threads spin for
milliseconds by default and hold cores that PoCL needs. Commands therefore let them sleep, and give BLAS, whose
matrices are small here, one thread. The libraries read these settings when they are loaded: nothing that loads one may
be imported before `settle`. A variable that the user has set stays as it is.
"""

import os
from collections.abc import Sequence
from typing import Final

OPTION: Final = "--threads"

#: Threads of OpenMP sleep when they wait; BLAS has one thread.
DEFAULTS: Final = {"OMP_WAIT_POLICY": "passive", "OPENBLAS_NUM_THREADS": "1"}

#: What limits each library's threads: OpenMP (torch), OpenCV, PoCL (two versions of it).
LIMITS: Final = ("OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM", "POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")

#: Seconds that a command must take, and the times of its CPU time, before `slow_line` speaks.
_SLOW_SECONDS: Final = 20.0
_SLOW_TIMES: Final = 10.0


def settle(arguments: Sequence[str]) -> None:
    """Set the environment of this process for a command; before torch, OpenCV, NumPy or a driver is loaded.

    Args:
        arguments: the command line; ``--threads N`` in it limits all pools. Other values are left to the parser.
    """
    for name, value in DEFAULTS.items():
        os.environ.setdefault(name, value)
    count = asked_for(arguments)
    if count is not None:
        os.environ.update(dict.fromkeys(LIMITS, str(count)))


def asked_for(arguments: Sequence[str]) -> int | None:
    """The value of ``--threads``; None without it, and for what is not a whole number of 1 or more."""
    _, texts = _split(arguments)
    return int(texts[0]) if texts and _is_count(texts[0]) else None


def without_option(arguments: Sequence[str]) -> list[str]:
    """The command line without ``--threads N``, for commands that do not declare it.

    Raises:
        ValueError: not a number of 1 or more.
    """
    kept, texts = _split(arguments)
    for text in texts:
        if not _is_count(text):
            raise ValueError(f"{OPTION} must be 1 or more, got {text or 'nothing'}")
    return kept


def _split(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments without the option, and its values."""
    kept, texts, rest = list[str](), list[str](), list(arguments)
    while rest:
        argument = rest.pop(0)
        name, equals, value = argument.partition("=")
        if name != OPTION:
            kept.append(argument)
        else:
            texts.append(value if equals else (rest.pop(0) if rest else ""))
    return kept, texts


def _is_count(text: str) -> bool:
    return text.isdecimal() and int(text) > 0


def apply(count: int | None) -> None:
    """Limit the pools of libraries that are loaded already: a command that is called as a function.

    Args:
        count: threads; None leaves all as they are.

    Raises:
        ValueError: less than 1.
    """
    if count is None:
        return
    if count < 1:
        raise ValueError(f"`threads` must be 1 or more, got {count}")
    import cv2
    import torch

    torch.set_num_threads(count)
    cv2.setNumThreads(count)


def slow_line(seconds: float, cpu_seconds: float) -> str | None:
    """The message where a command took ten times its CPU time; None where it did not.

    Args:
        seconds: that it took.
        cpu_seconds: of all its threads.
    """
    if seconds < _SLOW_SECONDS or seconds < _SLOW_TIMES * cpu_seconds:
        return None
    return (
        f"took {seconds:.0f} s for {cpu_seconds:.0f} s of CPU time: other processes use this machine; "
        f"{OPTION} 1 may be faster"
    )
