"""`openvima data`: look into demonstrations, check them, and make others of them."""

from openvima.cli.data.reading import info, verify
from openvima.cli.data.writing import (
    export_chat,
    export_lerobot,
    import_published,
    merge,
    preprocess,
    push_to_hub,
    sample,
    split,
)

# Subcommand → what runs it, in the order in which they are listed.
COMMANDS = {
    "info": info,
    "verify": verify,
    "merge": merge,
    "sample": sample,
    "split": split,
    "import": import_published,
    "preprocess": preprocess,
    "export-lerobot": export_lerobot,
    "export-chat": export_chat,
    "push-to-hub": push_to_hub,
}
