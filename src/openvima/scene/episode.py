"""Sampled problems, episodes and outcomes."""

from dataclasses import dataclass

from openvima.errors import SceneError, brief_repr
from openvima.html import notebook_html
from openvima.scene.goal import AtPose, Constraint, Goal, is_condition
from openvima.scene.prompt import Prompt
from openvima.scene.scene import Scene

COMPOSED = "composed"  # task of composed episodes
HOST_TASK = "visual_manipulation"  # whose environments play them; those of any task would


@dataclass(frozen=True, slots=True)
class Problem:
    """A sampled problem: pure data, without physics or images.

    Args:
        scene: All objects at their start, at rest.
        prompt: The prompt.
        goals: The goals, in the order of the oracle unless it may choose; anything with `is_met(scene)`.
        constraints: The constraints, in the order of their tests; those of `scene.goal`, or anything
            with `is_met(scene)`.
        stages: Sizes of groups of consecutive goals. After a step only goals of the first group with an open
            one are tested, so a step never completes goals of two groups. Empty: all goals are one group.
        num_required: Exact number of goals to fulfil (more at once is a failure); None means all.
        prerequisites: Moves that the oracle makes before it works on the goals, such as clearing a target;
            optional for a policy.
        oracle_max_steps: Step limit of the oracle; None: that of the task.

    Raises:
        SceneError: The stages do not add up to the number of goals, or a goal or constraint cannot be tested.
    """

    scene: Scene
    prompt: Prompt
    goals: tuple[Goal, ...]
    constraints: tuple[Constraint, ...] = ()
    stages: tuple[int, ...] = ()
    num_required: int | None = None
    prerequisites: tuple[AtPose, ...] = ()
    oracle_max_steps: int | None = None

    __repr__ = brief_repr

    def __post_init__(self) -> None:
        for goal in self.goals:
            if not is_condition(goal):
                raise SceneError(f"a goal is a {type(goal).__name__}; it must have a method is_met(scene).")
        for constraint in self.constraints:
            if not is_condition(constraint) and not callable(getattr(constraint, "violation", None)):
                raise SceneError(
                    f"a constraint is a {type(constraint).__name__}; it must have a method is_met(scene) or "
                    "violation(context)."
                )
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
    """A problem with its task, level and seed.

    Args:
        task: Name of the task, such as "rotate".
        level: one of `openvima.catalog.LEVELS`.
        domain: Domain of the seed: "train", "eval" or "user"; equal seeds of two domains are unrelated.
        seed: The episode's number.
        problem: The sampled problem.
        oracle_max_steps: Step limit of the oracle.
        max_steps: Step limit of a policy (`oracle_max_steps` + 2).
        num_redraws: Failed draws before this one.
    """

    task: str
    level: str
    domain: str
    seed: int
    problem: Problem
    oracle_max_steps: int
    max_steps: int
    num_redraws: int = 0

    __repr__ = brief_repr

    @staticmethod
    def of_scene(scene: Scene, *, seed: int, max_steps: int) -> "Episode":
        """Return an episode of a composed scene without prompt and goals."""
        problem = Problem(scene, Prompt("", ()), ())
        return Episode(COMPOSED, "train", "user", seed, problem, max_steps, max_steps)

    def _repr_html_(self) -> str | None:
        return notebook_html("episode", episode=self, parts=self.problem.prompt.described_parts())


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of an episode after a step: success, failure, or neither yet.

    Args:
        success: The task is solved.
        failure: The task can no longer be solved.
        reason: Empty while neither; else one sentence, such as "object 6 (letter A) left the workspace".
    """

    success: bool = False
    failure: bool = False
    reason: str = ""

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self.success or self.failure
