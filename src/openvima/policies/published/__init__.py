"""Published checkpoints of VIMA and its baselines: names, sizes and files."""

from openvima.policies.published.checkpoint import load_published
from openvima.policies.published.config import config_from_published
from openvima.policies.published.names import from_published, to_published

__all__ = ["config_from_published", "from_published", "load_published", "to_published"]
