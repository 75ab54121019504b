"""Sampling of episodes: seeds, the draw of a task from its own generator, and permuted object ids."""

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from openvima.catalog import Assets
from openvima.catalog.partitions import PUBLISHED_LEVELS
from openvima.errors import ConfigError, OpenVimaError, SamplingError, unknown_name
from openvima.scene import (
    Condition,
    Episode,
    ObjectImage,
    PhotoImage,
    Placement,
    Problem,
    Prompt,
    PromptFill,
    Scene,
    SceneImage,
)
from openvima.scene.goal import (
    OracleMove,
    distance_to,
    is_condition,
    is_monitored,
    object_of,
    oracle_move,
    unmet_reason,
)
from openvima.tasks import clutter
from openvima.tasks.options import options_of, parse_options
from openvima.tasks.prompts import MULTIMODAL, check_prompts, rewrite
from openvima.tasks.registry import EXTRA_STEPS, check_steps, list_tasks, task_spec
from openvima.tasks.table import TableSampler, is_wedged
from openvima.user_code import described

Domain = Literal["train", "eval", "user"]
DOMAINS: tuple[Domain, ...] = get_args(Domain)

MAX_SEED = 2**63 - 1
_WORD = 2**32


def make_rng(
    domain: str, task: str, level: str, seed: int, purpose: str, *, attempt: int = 0
) -> np.random.Generator:
    """Return the generator of one purpose of one episode.

    Args:
        domain: "train", "eval" or "user"; equal seeds of two domains give unrelated generators.
        task: Name of the task.
        level: one of `openvima.catalog.LEVELS`.
        seed: The episode's number, 0 … 2⁶³ − 1.
        purpose: Use of the draws, such as "scene", "ids" or "oracle"; purposes are independent.
        attempt: Number of the redraw, 0 for the first try.

    Returns:
        A fresh generator; equal arguments give equal draws on every machine.

    Raises:
        ConfigError: The domain is unknown, or the seed is negative, too large or not an integer.
    """
    if domain not in DOMAINS:
        raise ConfigError(unknown_name("seed domain", domain, DOMAINS))
    number = checked_seed(seed)
    words = [word for name in (domain, task, level, purpose) for word in _name_words(name)]
    entropy = [*words, attempt, number % _WORD, number // _WORD]  # fixed length, so no two keys coincide
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))


def checked_seed(seed: object) -> int:
    """Return the seed as a plain integer.

    Raises:
        ConfigError: It is negative, above 2⁶³ − 1 or not an integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise ConfigError(f"seed is {seed!r} ({type(seed).__name__}); give an integer from 0 to 2**63 - 1.")
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"seed is {seed}; give an integer from 0 to 2**63 - 1.")
    return int(seed)


@functools.lru_cache(maxsize=256)
def _name_words(name: str) -> tuple[int, int]:
    """Two 32-bit words of a stable hash of a name."""
    digest = hashlib.sha256(name.encode("utf-8")).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:8], "little")


def shuffle_ids(problem: Problem, rng: np.random.Generator) -> Problem:
    """Permute the ids of a problem's objects.

    Tasks place objects in a fixed order of roles, so their order would reveal the target.

    Args:
        problem: The problem with ids in the order of placing.
        rng: Generator of the permutation.

    Returns:
        The same problem with new ids in scene, goals, constraints and prompt images.
    """
    new_of = _permutation([placement.id for placement in problem.scene.placements], rng)
    prompt_ids = {
        p.id
        for _, fill in problem.prompt.images
        if isinstance(fill, SceneImage)
        for p in fill.scene.placements
    }
    new_in_prompt = _permutation(sorted(prompt_ids), rng)  # one for all frames
    images = tuple(
        (name, _renumber_image(fill, new_of, new_in_prompt)) for name, fill in problem.prompt.images
    )
    return replace(
        problem,
        scene=_renumber_scene(problem.scene, new_of),
        prompt=Prompt(problem.prompt.text, images),
        goals=tuple(_renumber(goal, new_of) for goal in problem.goals),
        constraints=tuple(_renumber(constraint, new_of) for constraint in problem.constraints),
        prerequisites=tuple(_renumber(goal, new_of) for goal in problem.prerequisites),
    )


def _permutation(ids: Sequence[int], rng: np.random.Generator) -> dict[int, int]:
    return dict(zip(ids, rng.permutation(ids).tolist(), strict=True))


def _renumber_scene(scene: Scene, new_of: dict[int, int]) -> Scene:
    placements = (replace(placement, id=new_of[placement.id]) for placement in scene.placements)
    return replace(scene, placements=tuple(sorted(placements, key=lambda placement: placement.id)))


def _renumber(condition: Any, new_of: dict[int, int]) -> Any:
    """Return a goal or constraint for new ids."""
    if hasattr(condition, "renumbered"):
        return condition.renumbered(new_of)
    return RenumberedCondition(condition, new_of) if is_condition(condition) else condition


@dataclass(frozen=True, slots=True)
class RenumberedCondition:
    """A condition without `renumbered`; it sees scenes with the ids with which it was made.

    Args:
        condition: The goal or constraint.
        new_of: Old id to new id.
    """

    condition: Condition
    new_of: Mapping[int, int]

    @property
    def object_id(self) -> int | None:
        """New id of the object that the condition is about."""
        old_id = object_of(self.condition)
        return None if old_id is None else self.new_of[old_id]

    @property
    def monitored(self) -> bool:
        """Whether it is tested during motion too."""
        return is_monitored(self.condition)

    def is_met(self, scene: Scene) -> bool:
        """Whether the condition is met."""
        return self.condition.is_met(self._as_made(scene))

    def reason(self, scene: Scene) -> str:
        """Why the condition is not met."""
        return unmet_reason(self.condition, self._as_made(scene))

    def distance(self, scene: Scene) -> tuple[float, float] | None:
        """Return how far its object is from meeting it, in metres and radians; None if it does not say."""
        return distance_to(self.condition, self._as_made(scene))

    def oracle_move(self, scene: Scene) -> OracleMove | None:
        """Return what the oracle pursues, with the new ids."""
        move = oracle_move(self.condition, self._as_made(scene))
        return None if move is None else move.renumbered(self.new_of)

    def _as_made(self, scene: Scene) -> Scene:
        return _renumber_scene(scene, {new: old for old, new in self.new_of.items()})


def _renumber_image(fill: PromptFill, new_of: dict[int, int], new_in_prompt: dict[int, int]) -> PromptFill:
    if isinstance(fill, SceneImage):
        return SceneImage(_renumber_scene(fill.scene, new_in_prompt))
    if isinstance(fill, PhotoImage):
        return fill
    placement: Placement = fill.placement
    return replace(fill, placement=replace(placement, id=new_of.get(placement.id, placement.id)))


MAX_REDRAWS = 100


def sample_episode(
    task: str,
    *,
    level: str | None = None,
    seed: int,
    domain: str = "user",
    assets: "str | Assets" = "procedural",
    compat: bool = False,
    prompts: str = MULTIMODAL,
    **options: object,
) -> Episode:
    """Sample one episode of a task.

    Args:
        task: Name of the task.
        level: One of `openvima.catalog.LEVELS`; by default the first of the task.
        seed: The episode's number, 0 … 2⁶³ − 1.
        domain: "train", "eval" or "user"; equal seeds of two domains give unrelated episodes.
        assets: Asset pack: "procedural", a folder with the original pack, or a pack already loaded.
        compat: Sample as the original benchmark does: objects hover at the start, ids follow the order of
            placing, and starts that overlap or are decided already are accepted.
        prompts: "multimodal", "text" (descriptions in place of object images) or "mixed" (in place of each
            with probability ½); "text,paraphrased" and "mixed,paraphrased" use synonyms. Nothing else of
            the episode depends on it.
        **options: The task's own options, as `task_spec(task).options` lists them.

    Returns:
        The episode; equal arguments give an equal one on every machine.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: There is no such level, or the task is not defined there.
        ConfigError: The seed, the domain, the form of prompts or an option is not allowed, the task has no
            text form, its code raises, or the episode would have more than 20 steps.
        SamplingError: No draw in a hundred could place all objects.

    Example:
        >>> sample_episode("rotate", seed=7).problem.scene.end_effector
        'suction'
    """
    from openvima.catalog.packs import load_assets

    spec = task_spec(task)
    level, number = spec.checked_level(level), checked_seed(seed)
    spec.check_options(options)
    pack = load_assets(assets)  # may register objects of the pool and of the text form
    check_text_form(task, prompts)
    pool = spec.pool(level)
    reason = SamplingError()
    for attempt in range(MAX_REDRAWS + 1):
        rng = make_rng(domain, task, level, number, "scene", attempt=attempt)
        table = TableSampler(rng, pool, assets=pack, end_effector=spec.end_effector, compat=compat)
        try:
            problem = spec.sample(table, **options)
            if not isinstance(problem, Problem):
                raise ConfigError(
                    f"`sample` of task {task!r} returned a {type(problem).__name__}; return a Problem, see "
                    "docs/your_own_task.md."
                )
            if level == clutter.LEVEL:
                problem = clutter.add_clutter(table, problem, task)
            if level not in PUBLISHED_LEVELS:
                _check_room(problem.scene, pack)
        except SamplingError as error:
            reason = error
            continue
        except OpenVimaError:
            raise
        except Exception as error:
            raise ConfigError(
                f"`sample` of task {task!r}, seed {number}, raised {described(error)}."
            ) from error
        if not compat:
            problem = shuffle_ids(problem, make_rng(domain, task, level, number, "ids", attempt=attempt))
        if prompts != MULTIMODAL:
            rng = make_rng(domain, task, level, number, "prompt", attempt=attempt)
            problem = replace(problem, prompt=rewrite(problem.prompt, problem.scene, prompts, rng))
        oracle_max_steps = problem.oracle_max_steps or spec.oracle_max_steps
        check_steps(task, oracle_max_steps)
        max_steps = oracle_max_steps + EXTRA_STEPS
        return Episode(task, level, domain, number, problem, oracle_max_steps, max_steps, num_redraws=attempt)
    raise SamplingError(
        f"{MAX_REDRAWS + 1} draws of {task} at level {level}, seed {number}, failed: {reason}"
    )


def _check_room(scene: Scene, assets: Assets) -> None:
    """Check that no object lies where a base would press it into the table; published seeds stay as they are.

    Raises:
        SamplingError: One does.
    """
    for base in scene.placements:
        for placement in scene.placements if base.fixed else ():
            if not placement.fixed and is_wedged(placement, base, assets):
                raise SamplingError(f"the {placement.object} lies in the {base.object}'s hull.")


@functools.cache
def has_text_form(task: str) -> bool:
    """Whether prompts of a task contain images of single objects, which text can replace.

    Raises:
        UnknownTaskError: There is no such task.
    """
    fills = sample_episode(task, seed=0).problem.prompt.images
    return any(isinstance(fill, ObjectImage) for _, fill in fills)


def takes_prompts(task: str, prompts: str) -> bool:
    """Whether prompts of a task can have a form: all can, except text for those without a text form.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: There is no such form.
    """
    check_prompts(prompts)
    return not prompts.startswith("text") or has_text_form(task)


def check_text_form(task: str, prompts: str) -> None:
    """Check that prompts of a task can have a form.

    Raises:
        ConfigError: There is no such form, or it is text and all images of the task's prompts are scenes.
    """
    if not takes_prompts(task, prompts):
        tasks = ", ".join(name for name in list_tasks() if has_text_form(name))
        raise ConfigError(
            f"task {task!r} has no text form: its prompt images are scenes. Tasks with one: {tasks}."
        )


@functools.cache
def check_task_options(tasks: tuple[str, ...], text: str) -> None:
    """Check task options for a run.

    Args:
        tasks: Tasks of the run.
        text: As in `EnvConfig`.

    Raises:
        UnknownTaskError: An option is of an unknown task.
        ConfigError: The task of an option is not in the run, an option fits no task of it, or a task refuses
            its value.
    """
    known = {name for task in tasks for name in task_spec(task).options}
    for task, name in parse_options(text):
        if task and task_spec(task).name not in tasks:
            raise ConfigError(
                f"task option {task}.{name}: this run has no {task}; its tasks are {', '.join(tasks)}."
            )
        if not task and name not in known:
            raise ConfigError(unknown_name(f"option of {', '.join(tasks)}:", name, sorted(known)))
    for task in tasks:
        try:
            if own := options_of(task_spec(task), text):
                sample_episode(task, seed=0, **own)  # the task checks its options
        except SamplingError:  # another seed may succeed
            continue
        except ConfigError as error:
            raise ConfigError(f"task option of {task!r}: {error}") from None
