"""Running a study: stage after stage, each of which resumes after any kill."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file, folder_lock, is_lock_file
from openvima.catalog.packs import load_assets
from openvima.data import Dataset, generate
from openvima.data.manifest import is_finished
from openvima.data.subsets import sample
from openvima.errors import ConfigError, InputFileError, differences
from openvima.evaluation.config import Engine
from openvima.evaluation.results import Results
from openvima.evaluation.runner import evaluate, prepare
from openvima.input_files import as_path, read_json
from openvima.multiprocess import Report, imap_with_engine
from openvima.policies.base import require_torch
from openvima.report.videos import require_extra
from openvima.studies.plan import COST_FILE, Plan, Training, plan_study, record_of
from openvima.studies.results import study_costs, study_page, study_points
from openvima.studies.study import Study, StudyInputs
from openvima.training.config import flatten

SETTINGS_FILE = "settings.json"
RESULTS_FILE = "study.json"
PAGE_FILE = "report.html"
SCHEMA = 1
_MAX_DIFFERENCES = 3  # in a message
_MAX_SETTINGS_BYTES = 1 << 20


def run_study(
    study: Study,
    inputs: StudyInputs,
    out: str | Path,
    *,
    seeds: int = 1,
    device: str | None = None,
    workers: int | None = None,
    engine: Engine = "processes",
    address: str | None = None,
    command: str = "",
    report: Report | None = None,
) -> Path:
    """Run a study, or what an interrupted one lacks, and write its page.

    Args:
        study: The study.
        inputs: What it was made from.
        out: Its folder.
        seeds: Training seeds; more can be added later.
        device: As for `plan_study`.
        workers: Trainings at a time, of one thread each, and processes of generating and evaluating; None is
            one, or all CPUs of the Ray cluster at `address`.
        engine: "processes" of this machine, or "ray".
        address: Ray cluster, whose machines share the folder; None starts Ray on this machine.
        command: The command, for the page.
        report: Called with stages done, stages in all and a note.

    Returns:
        The page; `study.json` is beside it.

    Raises:
        ConfigError: The folder holds another study, or settings contradict each other.
        MissingExtraError: A package for training or the page is not installed.
        FolderLockedError: Another process writes to the folder.
        OpenVimaError: As for `generate`, `train` and `evaluate`.
    """
    out = as_path(out).absolute()
    how: dict[str, Any] = {"workers": workers, "engine": engine, "address": address}
    plan = plan_study(study, inputs, out, seeds=seeds, device=device, **how)
    check_plan(plan)
    done = 0

    def say(note: str) -> None:
        if report is not None:
            report(done, plan.num_stages, note)

    with folder_lock(out):
        record = record_of(plan)
        _claim(out, record)
        for note in _run_stages(plan, say):
            done += 1
            say(note)
        points, costs = study_points(plan), study_costs(plan)
        versions = Results.read(plan.evaluations[0].config.out).versions
        content = {
            "schema": SCHEMA,
            "settings": record,
            "points": [asdict(point) for point in points],
            "published": [asdict(point) for point in study.published],
            "costs": costs,
            "versions": versions,
        }
        atomic_write_file(out / RESULTS_FILE, json.dumps(content, indent=1, ensure_ascii=False) + "\n")
        page = study_page(plan, points, costs=costs, versions=versions, command=command)
        return atomic_write_file(out / PAGE_FILE, page)


def check_plan(plan: Plan) -> None:
    """Check everything that can be checked before any work.

    Raises:
        OpenVimaError: As for `run_study`.
    """
    require_extra()
    load_assets(plan.inputs.assets)
    for config in plan.data.values():
        config.resolved_tasks()
    if plan.trainings:
        require_torch("training")
        from openvima.training.building import resolve

        for training in plan.all_trainings:
            resolve(training.config)
    for evaluation in plan.evaluations:
        if evaluation.run.policy is not None:
            prepare(evaluation.config)


def _claim(out: Path, record: dict[str, Any]) -> None:
    """Note what the folder holds, or check it.

    Raises:
        ConfigError: It holds something else.
    """
    file = out / SETTINGS_FILE
    if not file.is_file():
        if not all(is_lock_file(path) for path in out.iterdir()):
            raise ConfigError(f"{out} is not empty and holds no study; give another --out.")
        atomic_write_file(file, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
        return
    try:
        there = flatten(read_json(file, max_bytes=_MAX_SETTINGS_BYTES))
    except (OSError, InputFileError) as error:
        raise ConfigError(f"{file} cannot be read ({error}); give another --out.") from None
    here = flatten(record)
    if differing := differences(there, here):
        shown = "; ".join(differing[:_MAX_DIFFERENCES])
        raise ConfigError(f"{out} holds another study: {shown}. Give another --out.")


def _run_stages(plan: Plan, say: Callable[[str], None]) -> Iterator[str]:
    """Run the stages that are not done.

    Args:
        plan: The stages.
        say: Called with notes on the stage that runs.

    Yields:
        A note after each stage.
    """

    def counting(what: str) -> Report:
        return lambda done, total, _: say(f"{what}: {done:,} of {total:,}")

    for config in plan.data.values():
        if not is_finished(config.out):
            generate(config, counting("generating"))
        yield f"demonstrations in {config.out.name}"
    for out, subset in plan.subsets.items():
        if not is_finished(out):
            sample(*subset, report=counting("sampling"))
        yield out.name
    yield from _train_missing([*plan.initial.values()], plan.how, say)
    yield from _train_missing(plan.trainings, plan.how, say)
    for evaluation in plan.evaluations:
        name = f"{evaluation.run.label}, seed {evaluation.seed}"
        evaluate(evaluation.config, counting(f"evaluating {name}"))
        yield f"evaluated {name}"


def _train_missing(
    trainings: Sequence[Training], how: Mapping[str, Any], say: Callable[[str], None]
) -> Iterator[str]:
    missing = [each for each in trainings if not (each.config.out / COST_FILE).is_file()]
    yield from ["trained before"] * (len(trainings) - len(missing))
    for training, _ in imap_with_engine(
        how["engine"],
        train_one,
        missing,
        how["workers"],
        address=how["address"],
        report=lambda steps: say(f"training, {steps:,} steps"),
    ):
        yield f"training {training.run or 'initial weights'}, seed {training.config.seed}"


def train_one(training: Training, count: Callable[[int], None]) -> None:
    """Train, perhaps in a worker process, and note the costs, which also says that it is done."""
    from openvima.policies.checkpoint import load_network
    from openvima.training import train
    from openvima.training.run_folder import read_costs

    config = training.config
    train(config, lambda done, total, note: count(done))
    network, _ = load_network(config.out)
    costs = {
        "parameters": sum(p.numel() for p in network.parameters()),
        "demonstrations": len(Dataset(config.data)),
        **read_costs(config.out),
    }
    atomic_write_file(config.out / COST_FILE, json.dumps(costs, indent=1) + "\n")
