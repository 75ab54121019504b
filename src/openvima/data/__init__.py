"""Writing and reading demonstrations."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.data.generation import GenerateConfig, generate, plan
    from openvima.data.reader import Dataset
    from openvima.data.records import Demonstration, rollout_oracle
    from openvima.data.shard import Shard, ShardWriter
    from openvima.data.user_demonstrations import record_demonstration
    from openvima.data.verification import VerifyConfig, verify

# Reading needs no simulation, so each name brings only what it needs.
_HOMES = {
    "Dataset": "reader",
    "Demonstration": "records",
    "GenerateConfig": "generation",
    "Shard": "shard",
    "ShardWriter": "shard",
    "VerifyConfig": "verification",
    "generate": "generation",
    "plan": "generation",
    "record_demonstration": "user_demonstrations",
    "rollout_oracle": "records",
    "verify": "verification",
}

__all__ = [
    "Dataset",
    "Demonstration",
    "GenerateConfig",
    "Shard",
    "ShardWriter",
    "VerifyConfig",
    "generate",
    "plan",
    "record_demonstration",
    "rollout_oracle",
    "verify",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
