"""Policies and demonstrations on the Hugging Face Hub, each with a card that says what it is."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.publishing.demonstrations import demonstrations_card, push_demonstrations
    from openvima.publishing.policy import policy_card, push_policy

_HOMES = {
    "demonstrations_card": "demonstrations",
    "policy_card": "policy",
    "push_demonstrations": "demonstrations",
    "push_policy": "policy",
}

__all__ = ["demonstrations_card", "policy_card", "push_demonstrations", "push_policy"]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
