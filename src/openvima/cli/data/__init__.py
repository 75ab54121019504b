"""`openvima data`: look into demonstrations, check them, and make others of them."""

from openvima.cli.data.importing import import_published
from openvima.cli.data.info import info
from openvima.cli.data.lerobot import export_lerobot
from openvima.cli.data.preprocess import preprocess
from openvima.cli.data.pushing import push_to_hub
from openvima.cli.data.subsets import merge, sample, split
from openvima.cli.data.verify import verify

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
    "push-to-hub": push_to_hub,
}
