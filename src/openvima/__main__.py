"""Run the `openvima` program by `python -m openvima`."""

import sys

from openvima.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
