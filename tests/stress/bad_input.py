"""Bad input on the command line, seeded: `python tests/stress/bad_input.py --share 1.0 --seed 0`.

Options, inputs and files that vestcl and train must refuse (tests/support/bad_inputs.py draws them). Each must end
within some seconds with exit status 2, one line on stderr (or the parser's box, which says how an option is used, or a
line for each fault of a configuration) and nothing on stdout: no traceback, no hang, no crash.
"""

import argparse
import contextlib
import json
import os
import select
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

CASES = 350
#: Seconds that a case may take; the first one of a process imports torch.
SECONDS = 20.0
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Server:
    """A process that runs cases, started again when one of them ended it."""

    folder: Path
    seed: int
    process: "subprocess.Popen[str] | None" = field(default=None, init=False)

    def answer(self, index: int) -> dict[str, Any]:
        """What case ``index`` came to."""
        if self.process is None:
            command = [sys.executable, str(ROOT / "tests" / "support" / "bad_input_server.py")]
            self.process = subprocess.Popen(
                [*command, str(self.folder), str(self.seed), str(SECONDS)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )  # fmt: skip
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(f"{index}\n")
        self.process.stdin.flush()
        ready, _, _ = select.select([self.process.stdout], [], [], 3 * SECONDS)
        line = self.process.stdout.readline() if ready else ""
        if line:
            return dict(json.loads(line))
        status = "hang that no signal ends" if not ready else f"crash: {self.process.wait()}"
        self.close()
        return {"what": f"case {index}", "program": "", "arguments": [], "status": status, "out": "", "err": ""}

    def close(self) -> None:
        if self.process is not None:
            self.process.kill()
            with contextlib.suppress(OSError):
                self.process.communicate()
            self.process = None


def fault(answer: dict[str, Any]) -> str:
    """What is wrong with the way in which a command refused, or nothing."""
    status, out, err = answer["status"], answer["out"], answer["err"].strip("\n")
    if not isinstance(status, int):
        return str(status)
    if "Traceback" in out + err:
        return "traceback"
    if status != 2:
        return f"exit status {status}"
    if out.strip():
        return "something on stdout"
    is_box = err.startswith("╭") and err.endswith("╯")
    first, *more = err.split("\n")
    is_line = first.startswith("error: ") and all(line.startswith("  `") for line in more)
    return "" if is_box or is_line else "not one line on stderr"


def faults(cases: int, seed: int, root: Path) -> Iterator[tuple[int, dict[str, Any], str]]:
    """(number, answer, fault) of each case; ``root`` is an empty folder."""
    server = Server(root, seed)
    try:
        for index in range(cases):
            answer = server.answer(index)
            yield index, answer, fault(answer)
    finally:
        server.close()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the cases")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    cases, kinds = round(CASES * options.share), Counter[str]()
    with tempfile.TemporaryDirectory() as root:
        for index, answer, wrong in faults(cases, options.seed, Path(root)):
            if wrong:
                kinds[wrong.partition(":")[0]] += 1
                command = " ".join(map(repr, [answer["program"], *answer["arguments"]]))
                print(
                    f"case {index} ({answer['what']}): {wrong}: {command[:300]}\n    {answer['err'][-600:]}", flush=True
                )
    refused = cases - kinds.total()
    print(f"bad input: {cases} command lines, {refused} refused as they should be, {dict(kinds)}, seed {options.seed}")
    return int(kinds.total() > 0)


if __name__ == "__main__":
    sys.exit(main())
