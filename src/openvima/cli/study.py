"""`openvima study`: an experiment of several trainings and evaluations, and its page."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from openvima.cli.terminal import parse_list, print_table, progress_bar


def main(
    name: Annotated[Positional[str], arg(metavar="NAME")],
    *,
    out: Path,
    scale: Literal["nano", "2m", "4m", "9m", "20m", "43m", "92m", "200m"] = "nano",
    seeds: int = 1,
    episodes: int | None = None,
    policy: str = "",
    t5: str | None = None,
    assets: str = "procedural",
    checkpoint: str | None = None,
    workers: int | None = None,
    engine: Literal["processes", "ray"] = "processes",
    address: str | None = None,
    device: str | None = None,
    dry_run: bool = False,
) -> None:
    """Run an experiment of the papers: generate, train, evaluate, and write report.html and study.json.

    The same command resumes an interrupted study, with the same numbers.

    Example: openvima study data-scaling --scale nano --seeds 3 --workers 2 --out data_scaling

    Args:
        name: model-scaling, data-scaling, image-tokens, conditioning, text-encoder, distractors,
            corrupted-prompts, level-drop, midas, in-context or published; or FILE.py:FUNCTION for a study of
            your own.
        out: Folder of the study.
        scale: Sizes of networks, data and evaluation. nano takes minutes to hours on two cores; the others
            follow the papers.
        seeds: Training seeds; 3 show the variation between trainings. More can be added later.
        episodes: Episodes of each task, level and training seed; by default 50 at nano, else 200.
        policy: Policies to evaluate, comma-separated, for the studies distractors and corrupted-prompts; by
            default openvima-small.
        t5: T5 weights and tokenizer, for scales above nano: a folder, or an id such as t5-base.
        assets: procedural, original, a checkout of the original benchmark, or FILE.py:FUNCTION.
        checkpoint: For the study published: a public checkpoint as `openvima policies convert` writes it.
        workers: Trainings at a time, and processes of generating and evaluating; by default one, or all CPUs
            of the Ray cluster at --address.
        engine: processes of this machine, or ray.
        address: Ray cluster as HOST:PORT; by default Ray is started on this machine and stopped at the end.
        device: Where networks are trained and act: cpu or cuda. By default they are trained on a GPU if
            there is one, and act on a CPU.
        dry_run: Print the stages; write nothing.
    """
    from rich.table import Table

    from openvima.evaluation.config import plan as plan_evaluation
    from openvima.studies import StudyInputs, check_options, make_study, run_study, scale_named
    from openvima.studies.plan import plan_study
    from openvima.studies.runner import check_plan

    sizes = scale_named(scale)
    if episodes is not None:
        sizes = replace(sizes, episodes=episodes)
    inputs = StudyInputs(sizes, parse_list(policy), t5, assets, checkpoint)
    study = make_study(name, inputs)
    check_options(name, inputs)
    options = {
        "episodes": episodes,
        "policy": policy,
        "t5": t5,
        "assets": assets if assets != "procedural" else None,
        "checkpoint": checkpoint,
        "device": device,
    }
    words = [f"--{option} {shlex.quote(str(value))}" for option, value in options.items() if value]
    start = f"openvima study {shlex.quote(name)} --scale {scale} --seeds {seeds}"
    command = " ".join([start, *words, "--out DIR"])
    how = {"device": device, "workers": workers, "engine": engine, "address": address}
    if dry_run:
        found = plan_study(study, inputs, out, seeds=seeds, **how)
        check_plan(found)
        table = Table("stage", "folder")
        for config in found.data.values():
            table.add_row(f"{config.episodes:,} demonstrations of {len(config.tasks)} tasks", f"{config.out}")
        for training in found.all_trainings:
            table.add_row(f"training of {training.config.preset}", f"{training.config.out}")
        for evaluation in found.evaluations:
            number = sum(batch.episodes for batch in plan_evaluation(evaluation.config))
            table.add_row(f"evaluation in {number:,} episodes", f"{evaluation.config.out}")
        print_table(table)
        return
    with progress_bar("stages") as bar:
        page = run_study(study, inputs, out, seeds=seeds, command=command, report=bar, **how)
    print(f"Report: {page}", file=sys.stderr)
    print(page)
