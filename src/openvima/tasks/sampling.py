"""Sampling of episodes: a task's draw from its own generator, and new draws after bad luck."""

from openvima.catalog import Assets
from openvima.errors import ConfigError, SamplingError, unknown_name
from openvima.scene import Episode
from openvima.tasks.ids import shuffled_ids
from openvima.tasks.registry import EXTRA_STEPS, TaskSpec, task_spec
from openvima.tasks.seeding import checked_seed, make_rng
from openvima.tasks.table import TableSampler

MAX_REDRAWS = 100


def sample_episode(
    task: str,
    *,
    level: str | None = None,
    seed: int,
    domain: str = "user",
    assets: "str | Assets" = "procedural",
    compat: bool = False,
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
        **options: The task's own options, as `task_spec(task).options` lists them.

    Returns:
        The episode; equal arguments give an equal one on every machine.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: There is no such level, or the task is not defined there.
        ConfigError: The seed, the domain or an option is not allowed.
        SamplingError: No draw in a hundred could place all objects.

    Example:
        >>> sample_episode("rotate", seed=7).problem.scene.end_effector
        'suction'
    """
    from openvima.catalog.packs import load_assets

    spec = task_spec(task)
    level, number = spec.checked_level(level), checked_seed(seed)
    _check_options(spec, options)
    pool, pack = spec.pool(level), load_assets(assets)
    reason = SamplingError()
    for attempt in range(MAX_REDRAWS + 1):
        rng = make_rng(domain, task, level, number, "scene", attempt=attempt)
        table = TableSampler(rng, pool, assets=pack, end_effector=spec.end_effector, compat=compat)
        try:
            problem = spec.sample(table, **options)
        except SamplingError as error:
            reason = error
            continue
        if not compat:
            problem = shuffled_ids(problem, make_rng(domain, task, level, number, "ids", attempt=attempt))
        oracle_max_steps = problem.oracle_max_steps or spec.oracle_max_steps
        max_steps = oracle_max_steps + EXTRA_STEPS
        return Episode(task, level, domain, number, problem, oracle_max_steps, max_steps, num_redraws=attempt)
    raise SamplingError(
        f"{MAX_REDRAWS + 1} draws of {task} at level {level}, seed {number}, failed: {reason}"
    )


def _check_options(spec: TaskSpec, options: dict[str, object]) -> None:
    for name in options:
        if name not in spec.options:
            raise ConfigError(unknown_name(f"option of task {spec.name!r}:", name, spec.options))
