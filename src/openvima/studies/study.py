"""A study as data: its runs, how they are evaluated, published numbers beside, and the scales it comes in."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.errors import ConfigError, unknown_name
from openvima.evaluation.sources import policy_sources
from openvima.policies.naming import SMALL, VIMA
from openvima.policies.presets import SIZE_NAMES
from openvima.report.published import PublishedModel
from openvima.training.recipes import default_recipe, override, recipe_settings

NANO = "nano"
TRAINING_TASKS = (  # of the papers
    "visual_manipulation",
    "scene_understanding",
    "rotate",
    "rearrange",
    "rearrange_then_restore",
    "novel_adj",
    "novel_noun",
    "twist",
    "follow_order",
    "sweep_without_exceeding",
    "same_shape",
    "manipulate_old_neighbor",
    "pick_in_order_then_restore",
)
_T5_SIZES = ("t5-small", "t5-base", "t5-large")
L4_TASKS = ("novel_adj_and_noun", "follow_motion", "sweep_without_touching", "same_texture")


@dataclass(frozen=True, slots=True)
class Scale:
    """Sizes of a study.

    Args:
        name: A size of the presets: "nano", "2m" to "200m".
        recipe: Training settings; `settings` take precedence.
        settings: Training settings by dotted name.
        tasks: Tasks to train on.
        new_tasks: Tasks that are evaluated and not trained on, at L4.
        demonstrations: Demonstrations of each task.
        levels: Levels to evaluate.
        episodes: Episodes of each task, level and training seed.
    """

    name: str
    recipe: str
    settings: Mapping[str, Any]
    tasks: tuple[str, ...]
    new_tasks: tuple[str, ...]
    demonstrations: int
    levels: tuple[str, ...] = ("L1", "L2", "L3", "L4")
    episodes: int = 200

    @property
    def is_nano(self) -> bool:
        """Whether it is the scale of two cores, with networks that have their own vocabulary."""
        return self.name == NANO


# Contrastive pretraining takes most of a training: it is shorter than in the recipe, and equal for all runs.
NANO_POINTER: Mapping[str, Any] = MappingProxyType(
    {"preset": NANO, "pretraining.steps": 150, "pretraining.num_scenes": 1200}
)
# Of the recipes of the papers' networks on two cores. With the crops of a finished training no run pretrains
# its own; without random appearance it sees the demonstrations of the study alone.
_NANO_PAPERS: Mapping[str, Any] = MappingProxyType(
    {
        "schedule.steps": 1000,
        "loader.rerendered_prob": 0.0,
        "loader.first_steps": 0,  # MIDAS would see nothing but two tasks
        "runtime.processes": 1,
    }
)
# Two cores: one training takes minutes.
_NANO = Scale(
    name=NANO,
    recipe="nano",
    settings=MappingProxyType({"schedule.steps": 400, "loader.batch_size": 64, "runtime.tensorboard": False}),
    tasks=("visual_manipulation", "scene_understanding", "rotate", "novel_noun"),
    new_tasks=("novel_adj_and_noun",),
    demonstrations=4000,
    episodes=50,
)


def scale_named(name: str) -> Scale:
    """Return a scale: nano, or everything as in the papers, save the size of the network.

    Raises:
        ConfigError: There is none of that name.
    """
    if name == NANO:
        return _NANO
    if name not in SIZE_NAMES:
        raise ConfigError(unknown_name("scale", name, SIZE_NAMES))
    return Scale(
        name=name,
        recipe="paper",
        settings=MappingProxyType({"schedule.steps": 47_000}),  # 10 epochs of 600,000, in batches of 128
        tasks=TRAINING_TASKS,
        new_tasks=L4_TASKS,
        demonstrations=50_000,
    )


Settings = Mapping[str, Any]  # of `TrainingConfig`, by dotted name


@dataclass(frozen=True, slots=True)
class Demonstrations:
    """Demonstrations to generate; runs with equal ones share them.

    Args:
        tasks: Names of tasks.
        episodes: Demonstrations of each task.
        env_config: Assets and task options.
    """

    tasks: tuple[str, ...]
    episodes: int
    env_config: EnvConfig = DEFAULT_ENV_CONFIG


@dataclass(frozen=True, slots=True)
class EvaluationSettings:
    """How runs are evaluated.

    Args:
        tasks: Names of tasks; each is played at the levels that hold it.
        levels: Levels.
        episodes: Episodes of each task, level and seed.
        ablations: Input ablations.
        env_config: Assets, task options, prompts, compatibility.
        plain: Whether to report scores without ablation.
    """

    tasks: tuple[str, ...]
    levels: tuple[str, ...]
    episodes: int
    ablations: tuple[str, ...] = ()
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    plain: bool = True


@dataclass(frozen=True, slots=True)
class StudyInputs:
    """What a study is made from: the scale, and options of the command.

    Args:
        scale: Sizes.
        policies: Policies to evaluate, for studies that train none.
        t5: Source of the T5 weights and tokenizer.
        assets: Asset pack.
        checkpoint: A published checkpoint.
    """

    scale: Scale
    policies: tuple[str, ...] = ()
    t5: str | None = None
    assets: str = "procedural"
    checkpoint: str | None = None

    def network(self, architecture: str, recipe: str | None = None) -> Settings:
        """Return the training settings of an architecture of the papers, such as "vima", at this scale.

        Args:
            architecture: Its name.
            recipe: At scale nano, a recipe other than the default of the preset.

        Raises:
            ConfigError: It needs T5, which is not given.
        """
        preset = f"{architecture}-{self.scale.name}"
        if not self.scale.is_nano:
            return {"preset": preset, "t5": self.needed_t5()}
        settings = recipe_settings(recipe or default_recipe(preset))
        crops = {"crops_from": VIMA} if settings.get("pretraining.steps") else {}
        return override(settings, {"preset": preset, **_NANO_PAPERS, **crops})

    def needed_t5(self) -> str:
        """Return the source of T5.

        Raises:
            ConfigError: It is not given.
        """
        if self.t5 is None:
            raise ConfigError(
                f"scale {self.scale.name} encodes prompts with T5; give --t5 the folder that holds it, or "
                "'t5-base' to fetch it from the Hugging Face Hub."
            )
        return self.t5

    @property
    def t5_folder(self) -> str:
        """Folder of T5 in all sizes, with a slash; empty where they are fetched.

        Raises:
            ConfigError: T5 is not given, or as a folder of one size.
        """
        where = self.needed_t5()
        if where.rstrip("/").endswith(_T5_SIZES) and "/" in where:
            raise ConfigError(
                f"--t5 is {where!r}; this study needs several sizes: give the folder that holds "
                f"{', '.join(_T5_SIZES)}, or 't5-base' to fetch them from the Hugging Face Hub."
            )
        return "" if where in _T5_SIZES else f"{where}/"

    def demonstrations(self, tasks: tuple[str, ...] = ()) -> Demonstrations:
        """Return the demonstrations of the scale; of its tasks if none are named."""
        scale = self.scale
        return Demonstrations(tasks or scale.tasks, scale.demonstrations, EnvConfig(self.assets))

    def policy_runs(self) -> "tuple[Run, ...]":
        """Return a run for each policy to evaluate as it is; by default the bundled one.

        Raises:
            ConfigError: As for `policy_sources`.
        """
        policies = self.policies or (SMALL,)
        return tuple(
            Run(source.name, policy=given)
            for source, given in zip(policy_sources(policies), policies, strict=True)
        )

    def evaluation(
        self, tasks: tuple[str, ...] = (), levels: tuple[str, ...] = (), **values: Any
    ) -> EvaluationSettings:
        """Return the evaluation of the scale; on its tasks and new ones if none are named."""
        scale = self.scale
        tasks, levels = tasks or (*scale.tasks, *scale.new_tasks), levels or scale.levels
        return EvaluationSettings(
            tasks, levels, scale.episodes, **{"env_config": EnvConfig(self.assets), **values}
        )


@dataclass(frozen=True, slots=True)
class Run:
    """One training, or one policy that exists, and its evaluation.

    Args:
        label: Name, unique in the study.
        x: Value of the quantity that is varied, or its name; by default the label.
        series: Curve of the figure; empty if there is one only.
        settings: Training settings that differ from those of the study.
        data_fraction: Fraction of the demonstrations of each task; each seed draws its own.
        init: Settings of a training whose weights this one starts from; it is trained once for each seed and
            shared by all runs with the same.
        data: Demonstrations, if not those of the study.
        policy: A policy to evaluate as it is, as `openvima evaluate --policy` takes it; nothing is trained.
        evaluation: Evaluation, if not that of the study.
    """

    label: str
    x: float | str = ""
    series: str = ""
    settings: Settings = field(default_factory=dict)
    data_fraction: float = 1.0
    init: Settings | None = None
    data: Demonstrations | None = None
    policy: str | None = None
    evaluation: EvaluationSettings | None = None


@dataclass(frozen=True, slots=True)
class PublishedPoint:
    """A published success rate.

    Args:
        series: Name of the model.
        x: Value or name on the x axis, as that of runs.
        level: Level.
        rate: Success rate, as a fraction.
        mark: Put behind the number in tables.
    """

    series: str
    x: float | str
    level: str
    rate: float
    mark: str = ""


def published_points(
    models: Iterable[PublishedModel],
    *,
    series: Callable[[PublishedModel], str] = lambda model: f"{model.model} {model.size}",
    x: Callable[[PublishedModel], float | str] = lambda model: "",
) -> tuple[PublishedPoint, ...]:
    """Return the points of published models, such as those of `openvima.report.published`, at each level.

    Args:
        models: The models.
        series: Name of the curve of a model.
        x: Value or name on the x axis; where it is empty, the level is on it.
    """
    return tuple(
        PublishedPoint(series(model), x(model) or level, level, rate / 100, model.mark(level))
        for model in models
        for level, rate in model.levels.items()
    )


@dataclass(frozen=True, slots=True)
class Study:
    """An experiment: several runs that differ in one respect.

    Args:
        name: Name.
        question: What it asks, one sentence.
        quantity: What is varied, with its unit: label of the x axis.
        runs: The runs, in the order of the table.
        evaluation: How they are evaluated.
        data: Demonstrations of the runs that train.
        settings: Training settings of all runs, over those of the scale.
        x_axis: What is on the axis: "run", the quantity of the runs; "level"; "ablation"; or "rate", the
            number in the names of ablations.
        logarithmic: Whether the x axis is.
        ticks: Names of values of the quantity, where they are not plain numbers.
        published: Published numbers to show beside.
        notes: Sentences for the page: what the numbers do not show.

    Raises:
        ConfigError: There is no run, two have the same label, or one trains and there are no demonstrations.
    """

    name: str
    question: str
    quantity: str
    runs: tuple[Run, ...]
    evaluation: EvaluationSettings
    data: Demonstrations | None = None
    settings: Settings = field(default_factory=dict)
    x_axis: Literal["run", "level", "ablation", "rate"] = "run"
    logarithmic: bool = False
    ticks: Mapping[float, str] = field(default_factory=dict)
    published: tuple[PublishedPoint, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        labels = [run.label for run in self.runs]
        if not labels or len(set(labels)) < len(labels):
            raise ConfigError(
                f"study {self.name!r} has runs {labels}; give at least one, all of other labels."
            )
        for run in self.runs:
            if run.policy is None and run.data is None and self.data is None:
                raise ConfigError(
                    f"run {run.label!r} trains, but has no demonstrations; give the study `data`."
                )
