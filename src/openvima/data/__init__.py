"""Writing and reading demonstrations."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.data.generation import generate
    from openvima.data.planning import GenerateConfig, plan
    from openvima.data.progress import GenerationProgress, TaskProgress
    from openvima.data.reader import Dataset
    from openvima.data.records import Demonstration, Step, rollout_oracle
    from openvima.data.shard import Shard
    from openvima.data.user_demonstrations import record_demonstration
    from openvima.data.verification import VerifyConfig, repair, verify
    from openvima.data.writer import ShardWriter

# Reading needs no simulation, so each name brings only what it needs.
_HOMES = {
    "Dataset": "reader",
    "Demonstration": "records",
    "GenerateConfig": "planning",
    "GenerationProgress": "progress",
    "Shard": "shard",
    "ShardWriter": "writer",
    "Step": "records",
    "TaskProgress": "progress",
    "VerifyConfig": "verification",
    "generate": "generation",
    "plan": "planning",
    "record_demonstration": "user_demonstrations",
    "repair": "verification",
    "rollout_oracle": "records",
    "verify": "verification",
}

__all__ = [
    "Dataset",
    "Demonstration",
    "GenerateConfig",
    "GenerationProgress",
    "Shard",
    "ShardWriter",
    "Step",
    "TaskProgress",
    "VerifyConfig",
    "generate",
    "plan",
    "record_demonstration",
    "repair",
    "rollout_oracle",
    "verify",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
