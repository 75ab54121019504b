"""Tasks: sampling, goals and the oracle."""

from openvima.tasks.goals import Progress, advance, begin, monitor
from openvima.tasks.oracle import OracleDecision, oracle_action
from openvima.tasks.registry import TaskSpec, list_tasks, register_task, task_spec
from openvima.tasks.sampling import DOMAINS, make_rng, sample_episode
from openvima.tasks.table import TableSampler

__all__ = [
    "DOMAINS",
    "OracleDecision",
    "Progress",
    "TableSampler",
    "TaskSpec",
    "advance",
    "begin",
    "list_tasks",
    "make_rng",
    "monitor",
    "oracle_action",
    "register_task",
    "sample_episode",
    "task_spec",
]
