"""Published checkpoints of VIMA and its baselines."""

from openvima.policies.published.names import from_published, to_published

__all__ = ["from_published", "to_published"]
