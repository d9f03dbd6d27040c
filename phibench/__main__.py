"""The command line as ``python -m phibench``."""

import sys

from phibench.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
