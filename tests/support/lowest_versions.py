"""Prints setup.py's requirements at their lowest versions, one per line: what `make test-lowest` installs.

torch keeps the version of constraints.txt: PyPI has no CPU build of the lowest one. The tools of the extra `dev` are
current ones: nobody needs them to use vestcl.
"""

import runpy
from pathlib import Path
from unittest import mock

SETUP = Path(__file__).resolve().parents[2] / "setup.py"


def lowest_versions() -> list[str]:
    """The requirements, each `name>=version` of a user's as `name==version`; the tools of `dev` as they are."""
    with mock.patch("setuptools.setup") as setup:
        runpy.run_path(str(SETUP))
    arguments = setup.call_args.kwargs
    extras = arguments["extras_require"]
    used = [*arguments["install_requires"], *extras["train"], *extras["estimators"], *extras["viewer"]]
    pinned = [requirement.replace(">=", "==") for requirement in used if not requirement.startswith("torch>=")]
    return pinned + [tool for tool in extras["dev"] if tool not in used]


if __name__ == "__main__":
    print(*lowest_versions(), sep="\n")
