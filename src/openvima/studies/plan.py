"""The stages of a study: demonstrations, subsets, trainings and evaluations, each with its own folder.

STUDY/settings.json                        what the folder holds
STUDY/data/1                               demonstrations
STUDY/data/1-0.01-seed-0                   a fraction of them
STUDY/initial/1/seed-0                     trainings that others start from
STUDY/runs/LABEL/seed-0                    trainings
STUDY/evaluations/LABEL/seed-0             evaluations
STUDY/study.json, report.html              results
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

from openvima.data import GenerateConfig
from openvima.data.subsets import SubsetConfig
from openvima.errors import ConfigError
from openvima.evaluation.config import DEFAULT_DEVICE, EvaluationConfig
from openvima.studies.study import Demonstrations, Run, Settings, Study, StudyInputs
from openvima.training.config import TrainingConfig
from openvima.training.recipes import override, recipe_settings

COST_FILE = "cost.json"  # in the folder of a training that is done


@dataclass(frozen=True, slots=True)
class Training:
    """One training.

    Args:
        config: Its settings.
        run: Label of the run; empty for a training that others start from.
    """

    config: TrainingConfig
    run: str = ""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The evaluation of one run and seed.

    Args:
        run: The run.
        seed: Training seed; 0 for a policy that exists.
        config: Its settings.
    """

    run: Run
    seed: int
    config: EvaluationConfig


Subset = tuple[SubsetConfig, float]  # and the fraction


@dataclass(slots=True)
class Plan:
    """All stages of a study, in order; what several runs share is planned once.

    Args:
        study: The study.
        inputs: What it was made from.
        out: Its folder.
        how: `workers`, `engine` and `address` of the stages that run in parallel, as for `run_study`.
        device: Where networks are trained and act; None trains on a GPU if there is one, and acts on a CPU.
        data: Generation of each data set.
        subsets: Fractions of data sets, by folder.
        initial: Trainings that others start from, by folder.
        trainings: Trainings of the runs.
        evaluations: Evaluations of the runs.
        initial_kinds: Settings and demonstrations of those in `initial`, in the order of their numbers.
    """

    study: Study
    inputs: StudyInputs
    out: Path
    how: Mapping[str, Any]
    device: str | None = None
    data: dict[Demonstrations, GenerateConfig] = field(default_factory=dict)
    subsets: dict[Path, Subset] = field(default_factory=dict)
    initial: dict[Path, Training] = field(default_factory=dict)
    trainings: list[Training] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    initial_kinds: list[tuple[Settings, Demonstrations]] = field(default_factory=list)

    @property
    def all_trainings(self) -> list[Training]:
        """Those that others start from, and those of the runs."""
        return [*self.initial.values(), *self.trainings]

    @property
    def num_stages(self) -> int:
        """Number of stages."""
        return sum(map(len, (self.data, self.subsets, self.all_trainings, self.evaluations)))


def plan_study(
    study: Study, inputs: StudyInputs, out: Path, *, seeds: int, device: str | None = None, **how: Any
) -> Plan:
    """Divide a study into stages; policies that exist have a single seed.

    Args:
        study: The study.
        inputs: What it was made from.
        out: Its folder.
        seeds: Training seeds.
        device: As in `Plan`.
        **how: As in `Plan`.

    Raises:
        ConfigError: Settings are not allowed, or two labels give the same folder.
    """
    if seeds < 1:
        raise ConfigError(f"seeds is {seeds}; it must be at least 1.")
    names = {run.label: _folder_name(run.label) for run in study.runs}
    if len(set(names.values())) < len(names):
        raise ConfigError(f"labels {', '.join(names)} give the same folders; choose others.")
    plan = Plan(study, inputs, out, how, device)
    for run in study.runs:
        name, settings = names[run.label], run.evaluation or study.evaluation
        for seed in range(seeds if run.policy is None else 1):
            # Runs of one seed play the same episodes, each seed its own.
            config = EvaluationConfig(
                policies=(run.policy or f"{name}={_plan_training(plan, run, name, seed)}",),
                tasks=settings.tasks,
                levels=settings.levels,
                episodes=settings.episodes,
                seed=seed * settings.episodes,
                out=out / "evaluations" / name / f"seed-{seed}",
                env_config=settings.env_config,
                ablations=settings.ablations,
                device=device or DEFAULT_DEVICE,
                **how,
            )
            plan.evaluations.append(Evaluation(run, seed, config))
    return plan


def _plan_training(plan: Plan, run: Run, name: str, seed: int) -> Path:
    """Plan the training of a run and seed, with its demonstrations and initial weights; return its folder."""
    demonstrations = run.data or plan.study.data
    assert demonstrations is not None  # checked by `Study`
    generated = GenerateConfig(
        out=plan.out / "data" / str(1 + len(plan.data)),
        tasks=demonstrations.tasks,
        episodes=demonstrations.episodes,
        env_config=demonstrations.env_config,
        **plan.how,
    )
    data = plan.data.setdefault(demonstrations, generated).out
    if run.data_fraction != 1:
        source, data = data, data.with_name(f"{data.name}-{run.data_fraction:g}-seed-{seed}")
        plan.subsets[data] = SubsetConfig(source, data, seed=seed), run.data_fraction
    settings = dict(run.settings)
    if run.init is not None:
        kind = (run.init, demonstrations)
        if kind not in plan.initial_kinds:
            plan.initial_kinds.append(kind)
        initial = plan.out / "initial" / str(1 + plan.initial_kinds.index(kind)) / f"seed-{seed}"
        plan.initial[initial] = Training(_training_config(plan, run.init, data, initial, seed))
        settings["init_from"] = str(initial)
    out = plan.out / "runs" / name / f"seed-{seed}"
    plan.trainings.append(Training(_training_config(plan, settings, data, out, seed), run.label))
    return out


def _training_config(plan: Plan, settings: Settings, data: Path, out: Path, seed: int) -> TrainingConfig:
    scale = plan.inputs.scale
    merged: dict[str, Any] = recipe_settings(scale.recipe)
    for others in (scale.settings, plan.study.settings, settings):
        merged = override(merged, others)
    here = {"data": data, "out": out, "seed": seed, "assets": plan.inputs.assets}
    return TrainingConfig.of({**merged, **here, "runtime.device": plan.device or "auto"})


def _folder_name(label: str) -> str:
    """Return a label as the name of a folder and policy.

    Example:
        >>> _folder_name("0.1 %"), _folder_name("object perceiver")
        ('0.1', 'object-perceiver')
    """
    return re.sub(r"[^\w.+-]+", "-", label).strip("-.") or "run"


def record_of(plan: Plan) -> dict[str, Any]:
    """Return what identifies the content of a study's folder, the number of seeds apart, as JSON values."""
    study, inputs = plan.study, plan.inputs
    record = {
        "study": study.name,
        "scale": inputs.scale.name,
        "assets": inputs.assets,
        "device": plan.device,
        "recipe": inputs.scale.recipe,
        "settings": {**inputs.scale.settings, **study.settings},
        "data": study.data,
        "evaluation": study.evaluation,
        "runs": {run.label: run for run in study.runs},
    }
    return json.loads(json.dumps(record, default=_plain))


def _plain(value: Any) -> object:
    """Return a value as those that JSON has, or as text."""
    if is_dataclass(value):
        return {each.name: getattr(value, each.name) for each in fields(value)}
    return dict(value) if isinstance(value, Mapping) else str(value)
