"""`openvima quickstart`: the whole way from nothing to a scored policy, in one command."""

from pathlib import Path

from openvima.cli.terminal import progress_bar
from openvima.errors import ConfigError
from openvima.multiprocess import num_cpus
from openvima.policies.naming import SMALL, bundled_folder

TASKS = ("visual_manipulation", "rotate", "sweep_without_exceeding")
LEVELS = ("L1", "L2", "L3")
BASELINES = (SMALL, "oracle", "untrained", "random")  # scored beside the policy that is trained here
# Half of what preset nano does by default: three tasks need no more; see results/2026-11-30_quickstart.md.
SHORT_TRAINING = (
    "--schedule.steps=200",
    "--pretraining.steps=250",
    "--pretraining.batch_size=64",
    "--pretraining.num_scenes=1250",
)


def main(
    *,
    out: Path = Path("quickstart"),
    demonstrations: int = 300,
    episodes: int = 30,
    seed: int = 0,
    workers: int | None = None,
) -> None:
    """Write demonstrations, train a small pointer network on them, score it, and leave a report.

    openvima-small, which comes trained with the package, is scored beside it. Takes some three minutes on
    two cores. It can be interrupted at any time; the same command goes on where it stopped.

    Example: openvima quickstart --out quickstart

    Args:
        out: Folder for everything that is made.
        demonstrations: Demonstrations a task to train on.
        episodes: Evaluation episodes for each policy, task and level.
        seed: Seed of the training and number of the first episode.
        workers: Processes for demonstrations and evaluation; by default one for each CPU, at most 8.
    """
    from openvima.cli.evaluate import print_results
    from openvima.cli.train import parse, train_in_processes
    from openvima.data import GenerateConfig, generate
    from openvima.evaluation import EvaluationConfig, Results
    from openvima.policies.base import require_torch
    from openvima.report import evaluate_and_report
    from openvima.report.videos import require_extra

    if demonstrations < 1:
        raise ConfigError(f"demonstrations is {demonstrations}; it must be at least 1.")
    workers = min(8, num_cpus()) if workers is None else workers
    run = out / "trained"
    demonstrated = GenerateConfig(
        tasks=TASKS, episodes=demonstrations, out=out / "demonstrations", workers=workers, start_seed=seed
    )
    evaluated = EvaluationConfig(
        policies=(f"trained={run}", *BASELINES),
        tasks=TASKS,
        levels=LEVELS,
        episodes=episodes,
        seed=seed,
        workers=workers,
        out=out,
    )
    require_torch("training")
    require_extra()
    bundled_folder(SMALL)  # fails before any work if missing
    out.mkdir(parents=True, exist_ok=True)
    with progress_bar("1/3 demonstrations") as report:
        data = generate(demonstrated, report)
    processes = f"--runtime.processes={min(2, num_cpus())}"
    words = (f"--data={data}", f"--out={run}", f"--seed={seed}", processes, *SHORT_TRAINING)
    train_in_processes(parse(words), words, label="2/3 training")
    with progress_bar("3/3 evaluation") as report:
        path = evaluate_and_report(evaluated, progress=report)
    print_results(Results.read(path))
    print(f"Report: {out / 'report.html'}")
