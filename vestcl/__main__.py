"""`python -m vestcl` is the command `vestcl`, where that is not on the PATH."""

import sys

from vestcl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
