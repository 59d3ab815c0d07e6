"""Runs command lines of bad_inputs, each asked for by a line with its number on stdin, answered by a line of JSON.

`python tests/support/bad_input_server.py FOLDER SEED SECONDS`, with the repository's root on PYTHONPATH. One process
serves many cases, for importing torch takes seconds. Its file descriptors 1 and 2 go to files while a case runs, so
that what libraries print is seen, too.
"""

import importlib
import json
import os
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from bad_inputs import Case, draw


class Hang(BaseException):
    """The case took too long."""


def ring(number: int, frame: FrameType | None) -> None:
    raise Hang


@contextmanager
def captured() -> Iterator[list[str]]:
    """What is written to file descriptors 1 and 2 meanwhile."""
    said: list[str] = []
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        kept = [os.dup(1), os.dup(2)]
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        try:
            yield said
        finally:
            for number, stream in ((1, sys.stdout), (2, sys.stderr)):
                stream.flush()
                os.dup2(kept[number - 1], number)
                os.close(kept[number - 1])
            for file in (out, err):
                file.seek(0)
                said.append(file.read().decode(errors="replace"))


def run(case: Case) -> int | str:
    """The exit status, or what else happened."""
    name = {"vestcl": "vestcl.cli.main"}.get(case.program, case.program)
    try:
        sys.argv = [case.program, *case.arguments]
        return int(importlib.import_module(name).main())
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    except Hang:
        return f"hang: {traceback.extract_tb(sys.exc_info()[2])[-1]}"
    except BaseException:
        traceback.print_exc()
        return "exception"


def serve(folder: Path, seed: int, seconds: float) -> None:
    signal.signal(signal.SIGALRM, ring)
    os.environ["COLUMNS"] = "400"
    before = dict(os.environ)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for line in sys.stdin:
        work = folder / f"case-{int(line)}"
        work.mkdir()
        os.chdir(work)
        case = draw(seed, int(line), work)
        os.environ.update(case.environment)
        with captured() as said:
            signal.setitimer(signal.ITIMER_REAL, seconds)
            try:
                status = run(case)
            except Hang:
                status = "hang at the end"
            signal.setitimer(signal.ITIMER_REAL, 0)
        os.environ.clear()
        os.environ.update(before)
        os.chdir(folder)
        shutil.rmtree(work)
        answer = {"what": case.what, "program": case.program, "arguments": case.arguments, "status": status}
        answers.write(json.dumps(answer | dict(zip(("out", "err"), said, strict=True))) + "\n")


if __name__ == "__main__":
    serve(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
