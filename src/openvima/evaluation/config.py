"""Configuration of an evaluation: policies, tasks, levels and seeds, divided into batches.

The division into batches depends on the configuration alone. Workers take whole batches, so their number
does not change the results.
"""

import hashlib
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import LEVELS
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import ConfigError, brief_repr, unknown_name
from openvima.evaluation.ablations import (
    ABLATIONS,
    DETECTED_BOXES,
    IN_CONTEXT,
    MORE_ABLATIONS,
    NOISY_BOXES,
    ablated_environment,
    ablation_parts,
    applies_to,
    names_in,
)
from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS
from openvima.evaluation.sources import PolicySource, policy_sources
from openvima.input_files import settle
from openvima.multiprocess import engine_problems
from openvima.policies.naming import ORACLE, RANDOM
from openvima.serving.chat import DEFAULT_VLM, VlmConfig
from openvima.serving.lerobot import lerobot_server
from openvima.tasks.registry import list_tasks, named_tasks, task_spec
from openvima.tasks.sampling import MAX_SEED, check_task_options, check_text_form, takes_prompts
from openvima.user_code import is_code

REFERENCE_POLICIES = (RANDOM, ORACLE)  # lower and upper bound
DEFAULT_EPISODES = 200  # as in the published tables
PRECISIONS = ("float64", "float32", "bfloat16")
Engine = Literal["processes", "ray"]
DEFAULT_DEVICE = "cpu"
DEFAULT_BATCH = 40  # 16 take a tenth longer; divides 200 and fits the limit of 64 of policy servers


@dataclass(frozen=True, slots=True)
class EvaluationConfig:
    """Configuration of an evaluation.

    Args:
        policies: Each "oracle", "random", "untrained", or what else `load_policy` takes: "openvima-small",
            "untrained:PRESET", a run folder, a published file, OWNER/NAME[@REVISION] on the Hub,
            "FILE.py:FUNCTION" or "MODULE:FUNCTION"; or the address of a policy server such as
            "ws://127.0.0.1:8000". "name=source" gives a name for the results; by default it is that of the
            folder, file or server.
        tasks: Names of tasks, or ("all",) for every task that the level holds, with text
            prompts every one that has a text form.
        levels: From `openvima.catalog.LEVELS`.
        episodes: Episodes for each policy, task and level.
        seed: First seed, of domain "eval"; the others follow without gaps.
        workers: Processes; the results do not depend on their number. None means one, or as many as the Ray
            cluster at `address` has CPUs.
        out: Folder to write to.
        env_config: Settings of the environments.
        batch: Episodes that are run together, with batched inference.
        force: Overwrite results of another evaluation in `out`.
        device: Where networks compute, such as "cpu" or "cuda". Only in float64 on a CPU are decisions
            independent of the division into batches.
        precision: Of networks: "float64", "float32" or "bfloat16"; None: float64 on a CPU, float32
            elsewhere. Episodes that rounding may have decided are listed in the results, row by row.
        ablations: Input ablations to evaluate besides, for each policy that reads prompts: names of
            `openvima.evaluation.ablations.INPUT_ABLATIONS` such as "no_prompt" or "masked_words:0.2", or
            several joined by "+"; "random" and "oracle", which are added as policies; or "all", for
            `openvima.evaluation.ablations.ABLATIONS` and both policies. They are kept in one spelling. With
            "in_context" all tasks are those that have an edited prompt.
        boxes: For the ablation "detected_boxes", which it implies: "detector" for the bundled one,
            "detector=folder" for another trained one, or "module:function" or "file.py:function", which makes
            the `ObjectExtractor` to plug in. "all" takes this ablation in only where boxes are given.
        engine: "processes" of this machine, or "ray".
        address: Ray cluster; None starts Ray on this machine. See `openvima.multiprocess`.
        trust_code: Run the code that run folders name, as those of learners of your own do.
        python: For policies "lerobot:PATH" or "lerobot:OWNER/NAME": the Python of an environment with LeRobot
            and the plugin `lerobot-env-openvima`, which serves them.
        vlm: How policies "vlm:MODEL", vision-language models of a chat server, are asked; their answers are
            kept in `out`.

    Raises:
        ConfigError: A number is out of its range, a name is not known, or settings contradict each other.
    """

    policies: tuple[str, ...]
    tasks: tuple[str, ...] = ("all",)
    levels: tuple[str, ...] = ("L1", "L2", "L3", "L4")
    episodes: int = DEFAULT_EPISODES
    seed: int = 0
    workers: int | None = None
    out: Path = Path("evaluation")
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    batch: int = DEFAULT_BATCH
    force: bool = False
    device: str = DEFAULT_DEVICE
    precision: str | None = None
    ablations: tuple[str, ...] = ()
    boxes: str | None = None
    engine: Engine = "processes"
    address: str | None = None
    trust_code: bool = False
    python: str | None = None
    vlm: VlmConfig = DEFAULT_VLM

    __repr__ = brief_repr

    def __post_init__(self) -> None:
        settle(self, paths=("out",), texts=("python",), names=("policies", "tasks", "levels", "ablations"))
        is_implied = self.boxes is not None and "all" not in self.ablations and not self.uses(DETECTED_BOXES)
        spelled = [
            name if name in MORE_ABLATIONS else "+".join(map(str, ablation_parts(name)))
            for name in filter(None, (*self.ablations, *[DETECTED_BOXES] * is_implied))
        ]
        object.__setattr__(self, "ablations", tuple(dict.fromkeys(spelled)))
        if problems := " ".join(self._problems()):
            raise ConfigError(problems)

    def _problems(self) -> Iterator[str]:
        for name, least in (("episodes", 1), ("seed", 0), ("workers", 1), ("batch", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                yield f"{name} is {value}; it must be at least {least}."
        if self.seed + self.episodes - 1 > MAX_SEED:
            yield f"seed is {self.seed}; seeds of all episodes must lie within 0 to 2**63 - 1."
        for name, values in (("policy", self.policies), ("tasks", self.tasks), ("levels", self.levels)):
            if not values:
                yield f"{name} is empty; give at least one."
        if self.precision is not None and self.precision not in PRECISIONS:
            yield f"precision is {self.precision!r}; allowed are {', '.join(PRECISIONS)}."
        yield from engine_problems(self.engine, self.address)
        if self.boxes is None and self.uses(DETECTED_BOXES):
            yield f"ablation {DETECTED_BOXES} needs a detector; name it with boxes, such as 'detector'."

    @property
    def sources(self) -> tuple[PolicySource, ...]:
        """The policies, those that the ablations add last.

        Raises:
            ConfigError: As for `policy_sources`.
        """
        given = policy_sources(self.policies)
        asked = REFERENCE_POLICIES if "all" in self.ablations else self.ablations
        there = {source.source for source in given}
        added = [name for name in REFERENCE_POLICIES if name in asked and name not in there]
        return (*given, *policy_sources(added))

    def ablations_of(self, source: PolicySource) -> tuple[str, ...]:
        """Return the input ablations of a policy.

        Oracle and random policy read no prompts; policy servers and users' code extract objects themselves.
        """
        if source.kind in (ORACLE, RANDOM):
            return ()
        extracts = source.kind in ("code", "remote", "vlm") or source.learner is not None
        unusable = {DETECTED_BOXES, NOISY_BOXES} if extracts else set()
        if self.boxes is None:
            unusable.add(DETECTED_BOXES)
        return tuple(name for name in self.all_ablations if unusable.isdisjoint(names_in(name)))

    @property
    def all_ablations(self) -> tuple[str, ...]:
        """Input ablations that are named or that "all" stands for."""
        return tuple(dict.fromkeys([*(ABLATIONS if "all" in self.ablations else ()), *self.asked_ablations]))

    def uses(self, ablation: str) -> bool:
        """Whether an ablation is named, alone or among others."""
        return any(ablation in names_in(name) for name in self.ablations)

    @contextmanager
    def served(self) -> "Iterator[EvaluationConfig]":
        """Serve the LeRobot policies while the block runs.

        Yields:
            The config with policy servers in their place.

        Raises:
            ConfigError: `python` cannot be started, or as for `policy_sources`.
            ServerError: A policy cannot be served.
        """
        if self.python is None:
            yield self
            return
        with ExitStack() as stack:
            policies = []
            for source in policy_sources(self.policies):
                where = source.source
                if source.kind == "lerobot":
                    where = stack.enter_context(lerobot_server(where, self.python, device=self.device))
                policies.append(f"{source.name}={where}")
            yield replace(self, policies=tuple(policies), python=None)

    def batch_of(
        self, source: PolicySource, ablation: str, task: str, level: str, first_seed: int, episodes: int
    ) -> "Batch":
        """Return some episodes of a policy; answers of vision-language models are kept in `out`."""
        return Batch(
            policy=source.name,
            source=source.source,
            task=task,
            level=level,
            first_seed=first_seed,
            episodes=episodes,
            env_config=ablated_environment(ablation, self.env_config),
            device=self.device,
            ablation=ablation,
            precision=self.precision or "",
            boxes=(self.boxes or "") if DETECTED_BOXES in names_in(ablation) else "",
            trust_code=self.trust_code,
            vlm=replace(self.vlm, answers=self.out / "answers"),
        )

    @property
    def asked_ablations(self) -> tuple[str, ...]:
        """Input ablations that are named, without "all" and the policies."""
        return tuple(name for name in self.ablations if name not in MORE_ABLATIONS)

    def record(self) -> dict[str, object]:
        """Settings that the results depend on, as plain JSON values."""
        unless_usual = {
            "device": "" if self.device == DEFAULT_DEVICE else self.device,
            "precision": self.precision,
            "ablations": list(self.ablations),
            "boxes": self.boxes,
        }
        return {
            "policies": [source.name for source in self.sources],
            "tasks": list(self.tasks),
            "levels": list(self.levels),
            "episodes": self.episodes,
            "seed": self.seed,
            "domain": "eval",
            "batch": self.batch,
            **self.env_config.record(),
            **{name: value for name, value in unless_usual.items() if value},
        }


@dataclass(frozen=True, slots=True)
class Batch:
    """Episodes of one policy, task and level with consecutive seeds, run as one batch.

    Args:
        policy: Name of the policy in the results.
        source: Where the policy comes from, as in `PolicySource`.
        task: Name of the task.
        level: Level of the episodes.
        first_seed: Seed of the first one.
        episodes: How many.
        env_config: As in `EvaluationConfig`.
        device: As in `EvaluationConfig`.
        ablation: Input ablation; empty for none.
        precision: As in `EvaluationConfig`; empty for the policy's own.
        boxes: Detector, as in `EvaluationConfig`; empty for boxes of the segmentation.
        trust_code: As in `EvaluationConfig`.
        vlm: As in `EvaluationConfig`.
        fingerprint: Text that stands for the policy's weights, wherever they lie, and the versions.
        may_fail: Whether the policy may raise throughout. Where it does so in all of its first batch, that is
            an error, not a result.
    """

    policy: str
    source: str
    task: str
    level: str
    first_seed: int
    episodes: int
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    device: str = DEFAULT_DEVICE
    ablation: str = ""
    precision: str = ""
    boxes: str = ""
    trust_code: bool = False
    vlm: VlmConfig = DEFAULT_VLM
    fingerprint: str = ""
    may_fail: bool = field(default=False, compare=False)

    @property
    def cell(self) -> tuple[str, str, str, str]:
        """Policy, ablation, task and level: what a row of the results is of."""
        return self.policy, self.ablation, self.task, self.level

    @property
    def episode(self) -> tuple[str, str, str, int]:
        """Policy, task, level and seed of the first episode."""
        return self.policy, self.task, self.level, self.first_seed

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        return range(self.first_seed, self.first_seed + self.episodes)

    def make_env(self, *, realtime: bool = False) -> TabletopEnv:
        """Build an environment for one of the episodes, which records `frames` if it is `realtime`."""
        return self.env_config.make(self.task, self.level, domain="eval", realtime=realtime)

    @property
    def key(self) -> str:
        """Name for the batch's stored outcomes: changes with anything that they depend on."""
        settings = {**asdict(self), "source": "", "trust_code": False}
        del settings["vlm"], settings["may_fail"]  # the fingerprint stands for the model's settings
        fingerprint = settings.pop("fingerprint")
        content = json.dumps([settings, fingerprint], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:24]


def cells(config: EvaluationConfig, ablation: str = "") -> list[tuple[str, str]]:
    """Pairs of task and level, by level and then by task.

    A task is left out at levels that do not hold it, as `sweep_without_exceeding` at L3, and under ablations
    that do not apply to it.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: There is no such level, or none of the levels holds a task that was named.
        ConfigError: No level holds any of the tasks, one that was named has no text form, which the
            prompts need, a task option does not fit, or the ablation applies to none of the tasks.
    """
    for level in config.levels:
        if level not in LEVELS:
            raise ConfigError(unknown_name("level", level, LEVELS))
    if is_code(config.env_config.assets):
        load_assets(config.env_config.assets)  # registers objects of the tasks that are sampled below
    prompts = config.env_config.prompts
    if "all" in config.tasks:
        known = IN_CONTEXT_TASKS if config.uses(IN_CONTEXT) else list_tasks()
        tasks = [task for task in known if takes_prompts(task, prompts)]
    else:
        tasks = list(named_tasks(config.tasks))
        for task in tasks:
            check_text_form(task, prompts)
    pairs = [
        (task, level)
        for level in dict.fromkeys(config.levels)
        for task in tasks
        if level in task_spec(task).levels
    ]
    played = dict.fromkeys(task for task, _ in pairs)
    stranded = [task for task in tasks if task not in played]
    if not pairs or (stranded and "all" not in config.tasks):
        raise ConfigError(
            f"nothing to play: {', '.join(stranded)} at {', '.join(config.levels)}; `openvima tasks` shows "
            "the levels of each task."
        )
    check_task_options(tuple(played), config.env_config.task_options)
    ablated = ablated_environment(ablation, config.env_config)
    kept = [(task, level) for task, level in pairs if applies_to(ablation, task, ablated)]
    if not kept:
        others = [task for task in list_tasks() if applies_to(ablation, task, ablated)]
        raise ConfigError(
            f"ablation {ablation} applies to none of the tasks {', '.join(played)}; it does to "
            f"{', '.join(others)}."
        )
    return kept


def plan(config: EvaluationConfig) -> list[Batch]:
    """Divide an evaluation into batches: by policy, ablation, level and task, then by `config.batch` seeds.

    Raises:
        ConfigError: An ablation fits none of the policies.
    """
    played = [
        (source, ablation) for source in config.sources for ablation in ("", *config.ablations_of(source))
    ]
    used = {ablation for _, ablation in played}
    if useless := [name for name in config.asked_ablations if name not in used]:
        raise ConfigError(
            f"ablation {', '.join(useless)} changes nothing for {', '.join(config.policies)}; add a policy "
            "that reads prompts, or leave the ablation out."
        )
    return [
        config.batch_of(
            source, ablation, task, level, config.seed + offset, min(config.batch, config.episodes - offset)
        )
        for source, ablation in played
        for task, level in cells(config, ablation)
        for offset in range(0, config.episodes, config.batch)
    ]
