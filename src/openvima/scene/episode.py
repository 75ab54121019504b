"""One sampled problem, and how it stands."""

from dataclasses import dataclass

from openvima.errors import SceneError
from openvima.scene.goal import AtPose, Constraint, Goal
from openvima.scene.prompt import Prompt
from openvima.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class Problem:
    """What a task samples: pure data, no physics and no images.

    Args:
        scene: All objects at their start, at rest.
        prompt: What the robot is told.
        goals: The conditions to fulfil, in the order in which the oracle works on them unless it may choose.
        constraints: What must not happen, in the order in which they are tested.
        stages: Sizes of groups of consecutive goals. After a step only goals of the first group with an open
            one are tested, so a step never completes goals of two groups. Empty: all goals are one group.
        num_required: Exact number of goals to fulfil (more at once is a failure); None means all.
        prerequisites: Moves that the oracle makes before it works on the goals, such as clearing a target. A
            policy need not make them.
        oracle_max_steps: Steps within which the oracle must be done; None: as registered for the task.

    Raises:
        SceneError: The stages do not add up to the number of goals.
    """

    scene: Scene
    prompt: Prompt
    goals: tuple[Goal, ...]
    constraints: tuple[Constraint, ...] = ()
    stages: tuple[int, ...] = ()
    num_required: int | None = None
    prerequisites: tuple[AtPose, ...] = ()
    oracle_max_steps: int | None = None

    def __post_init__(self) -> None:
        if self.stages and sum(self.stages) != len(self.goals):
            raise SceneError(f"stages {self.stages} must add up to the number of goals, {len(self.goals)}.")

    def stage_of(self, goal_index: int) -> range:
        """Indices of the goals that are tested together with one."""
        first = 0
        for size in self.stages or (len(self.goals),):
            if goal_index < first + size:
                return range(first, first + size)
            first += size
        raise SceneError(f"there is no goal {goal_index}; the problem has {len(self.goals)}.")


@dataclass(frozen=True, slots=True)
class Episode:
    """A problem together with where it came from.

    Args:
        task: Name of the task, such as "rotate".
        level: "train", "L1", "L2", "L3" or "L4".
        domain: Domain of the seed: "train", "eval" or "user"; equal seeds of two domains are unrelated.
        seed: The episode's number.
        problem: The sampled problem.
        oracle_max_steps: Steps within which the oracle must be done.
        max_steps: Steps that a policy is given (`oracle_max_steps` + 2).
        num_redraws: Unlucky draws that were thrown away before this one.
    """

    task: str
    level: str
    domain: str
    seed: int
    problem: Problem
    oracle_max_steps: int
    max_steps: int
    num_redraws: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an episode stands after a step: success, failure, or neither yet.

    Args:
        success: The task is done.
        failure: It can no longer be done.
        reason: Empty while open; else one sentence, such as "object 6 (letter A) left the workspace".
    """

    success: bool = False
    failure: bool = False
    reason: str = ""

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self.success or self.failure
