"""Training, evaluation and export: scripts, run as `python -m train.NAME`."""

import sys

from vestcl import interrupt
from vestcl.cli import threads

if sys.argv[:1] == ["-m"]:  # Python looks for the script that it runs next: its imports take seconds
    interrupt.guard_imports()
    threads.settle(())
