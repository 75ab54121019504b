"""Sampling of episodes: a task's draw from its own generator, and new draws after bad luck."""

import functools
from dataclasses import replace

from openvima.catalog import Assets
from openvima.errors import ConfigError, OpenVimaError, SamplingError, unknown_name
from openvima.scene import Episode, ObjectImage, Problem
from openvima.tasks.ids import shuffled_ids
from openvima.tasks.options import TaskOptions
from openvima.tasks.prompts import MULTIMODAL, check_prompts, rewritten
from openvima.tasks.registry import EXTRA_STEPS, TaskSpec, check_steps, list_tasks, task_spec
from openvima.tasks.seeding import checked_seed, make_rng
from openvima.tasks.table import TableSampler
from openvima.user_code import described

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
        level: "train" or "L1" to "L4"; by default "train", or the only level of a task held out for L4.
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
        LevelError: There is no such level, or the task is not defined there.
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
    _check_options(spec, options)
    pack = load_assets(assets)  # may register objects of the pool and of the text form
    check_text_form(task, prompts)
    pool = spec.pool(level)
    reason = SamplingError()
    for attempt in range(MAX_REDRAWS + 1):
        rng = make_rng(domain, task, level, number, "scene", attempt=attempt)
        table = TableSampler(rng, pool, assets=pack, end_effector=spec.end_effector, compat=compat)
        try:
            problem = spec.sample(table, **options)
        except SamplingError as error:
            reason = error
            continue
        except OpenVimaError:
            raise
        except Exception as error:
            raise ConfigError(
                f"`sample` of task {task!r}, seed {number}, raised {described(error)}."
            ) from error
        if not isinstance(problem, Problem):
            raise ConfigError(
                f"`sample` of task {task!r} returned a {type(problem).__name__}; return a Problem, see "
                "docs/your_own_task.md."
            )
        if not compat:
            problem = shuffled_ids(problem, make_rng(domain, task, level, number, "ids", attempt=attempt))
        if prompts != MULTIMODAL:
            rng = make_rng(domain, task, level, number, "prompt", attempt=attempt)
            problem = replace(problem, prompt=rewritten(problem.prompt, problem.scene, prompts, rng))
        oracle_max_steps = problem.oracle_max_steps or spec.oracle_max_steps
        check_steps(task, oracle_max_steps)
        max_steps = oracle_max_steps + EXTRA_STEPS
        return Episode(task, level, domain, number, problem, oracle_max_steps, max_steps, num_redraws=attempt)
    raise SamplingError(
        f"{MAX_REDRAWS + 1} draws of {task} at level {level}, seed {number}, failed: {reason}"
    )


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
        ConfigError: An option fits no task of the run, or a task refuses its value.
    """
    options = TaskOptions.parse(text)
    options.check(tasks)
    for task in tasks:
        try:
            if own := options.of(task_spec(task)):
                sample_episode(task, seed=0, **own)  # the task checks its options
        except SamplingError:  # another seed may succeed
            continue
        except ConfigError as error:
            raise ConfigError(f"task option of {task!r}: {error}") from None


def _check_options(spec: TaskSpec, options: dict[str, object]) -> None:
    for name in options:
        if name not in spec.options:
            raise ConfigError(unknown_name(f"option of task {spec.name!r}:", name, spec.options))
