"""`openvima data push-to-hub`: demonstrations on the Hugging Face Hub."""

from pathlib import Path
from typing import Annotated

import tyro

from openvima.cli.terminal import print_files


def push_to_hub(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OWNER/NAME")],
    *,
    private: bool = False,
    message: str = "",
    dry_run: bool = False,
) -> int:
    """Push demonstrations to the Hugging Face Hub, with a generated dataset card.

    The token is that of `hf auth login` or HF_TOKEN. Failed episodes and object caches are not pushed.

    Example: openvima data push-to-hub demos owner/demos

    Args:
        folder: Folder of demonstrations.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        private: Make a new repository private.
        message: Of the commit.
        dry_run: Print the card and list the files; nothing is sent.

    Returns:
        Exit status.
    """
    from openvima.publishing.demonstrations import demonstrations_files, push_demonstrations

    if dry_run:
        print_files(demonstrations_files(folder, name))
    else:
        print(f"hf://{push_demonstrations(folder, name, private=private, message=message)}")
    return 0
