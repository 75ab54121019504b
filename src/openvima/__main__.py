"""Lets `python -m openvima` stand for the `openvima` program."""

import sys

from openvima.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
