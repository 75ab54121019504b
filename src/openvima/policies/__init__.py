"""The policies and the parts that they share."""

from openvima.policies.base import Policy, RandomPolicy
from openvima.policies.loading import load_policy
from openvima.policies.presets import PRESETS, preset, register_policy

__all__ = ["PRESETS", "Policy", "RandomPolicy", "load_policy", "preset", "register_policy"]
