"""What a push to the Hugging Face Hub would send."""

import sys
from collections.abc import Mapping
from pathlib import Path


def print_files(files: Mapping[str, Path | bytes]) -> None:
    """Print the card to stdout, and the names and sizes of all files to stderr."""
    from openvima.publishing.card import CARD_NAME

    for name, content in files.items():
        size = len(content) if isinstance(content, bytes) else content.stat().st_size
        print(f"{name}: {size:,} bytes", file=sys.stderr)
        if name == CARD_NAME and isinstance(content, bytes):
            print(content.decode(), end="")
