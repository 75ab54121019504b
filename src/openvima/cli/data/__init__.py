"""`openvima data`: look into demonstrations, check them, and make others of them."""

from openvima.cli.data.info import info

# Subcommand → what runs it, in the order in which they are listed.
COMMANDS = {
    "info": info,
}
