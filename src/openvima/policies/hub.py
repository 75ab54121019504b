"""Policies on the Hugging Face Hub. No request is made unless a name can only be a repository id."""

import re
from pathlib import Path

from openvima.errors import CheckpointError
from openvima.extras import import_extra

_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


def is_hub_id(text: str) -> bool:
    """Whether a text can only be a repository id: "owner/name", without a local folder named as the owner.

    So "runs/frist" beside a folder "runs" is a mistyped path and causes no request.
    """
    owner = text.partition("/")[0]
    return _HUB_ID.fullmatch(text) is not None and not Path(text).exists() and not Path(owner).exists()


def fetch_from_hub(hub_id: str, patterns: tuple[str, ...]) -> Path:
    """Download the files of a repository that match the patterns; cached files are reused.

    Args:
        hub_id: The repository, as "owner/name".
        patterns: File names, with `*` as wildcard.

    Returns:
        The local folder with the files.

    Raises:
        MissingExtraError: `huggingface_hub` is not installed.
        CheckpointError: There is no such repository, or it cannot be reached.
    """
    hub = import_extra(
        "huggingface_hub",
        f"there is no folder {hub_id!r} here; to fetch it from the Hugging Face Hub, install "
        "huggingface_hub: pip install huggingface_hub",
    )
    try:
        return Path(hub.snapshot_download(hub_id, allow_patterns=list(patterns)))
    except Exception as error:  # the client passes on those of its HTTP library, which has changed before
        first_line = str(error).strip().partition("\n")[0] or type(error).__name__
        raise CheckpointError(
            f"there is no folder {hub_id!r} here, and the download from the Hugging Face Hub failed: "
            f"{first_line}"
        ) from error
