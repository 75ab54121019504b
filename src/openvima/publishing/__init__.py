"""Policies and demonstrations on the Hugging Face Hub, each with a card that says what it is."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.publishing.push import demonstrations_card, policy_card, push_demonstrations, push_policy

_HOMES = {
    "demonstrations_card": "push",
    "policy_card": "push",
    "push_demonstrations": "push",
    "push_policy": "push",
}

__all__ = ["demonstrations_card", "policy_card", "push_demonstrations", "push_policy"]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
