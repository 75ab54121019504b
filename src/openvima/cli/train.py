"""`openvima train`: train a policy on demonstrations."""

import sys
from pathlib import Path

from openvima.cli.progress import progress_bar


def main(
    *,
    data: Path,
    out: Path,
    preset: str = "nano",
    steps: int | None = None,
    batch: int | None = None,
    learning_rate: float | None = None,
    pretraining_steps: int | None = None,
    checkpoint_every: int | None = None,
    seed: int = 0,
    threads: int = 1,
    t5: str | None = None,
    assets: str = "procedural",
    force: bool = False,
) -> int:
    """Train a policy on demonstrations, or go on with a run that was interrupted.

    First the crop encoder learns to match objects in prompt images with objects in scenes drawn for that.
    Then the whole policy learns by behaviour cloning. The same command continues an interrupted run exactly
    where its last checkpoint stands.

    Example: openvima train --data demos --preset nano --out run

    Args:
        data: Folder of demonstrations, as `openvima generate` writes it.
        out: Run folder for checkpoints, settings and metrics; `openvima evaluate --policy` takes it.
        preset: Network sizes: nano (2.2 M parameters, points at objects) or nano-bins (the published bins).
        steps: Steps of behaviour cloning; by default what the preset needs.
        batch: Demonstrations a step.
        learning_rate: Highest learning rate of cloning.
        pretraining_steps: Steps of matching prompt and scene; 0 leaves it out.
        checkpoint_every: Steps between checkpoints.
        seed: Decides weights, order of the data and augmentation.
        threads: Threads to compute with; equal numbers give equal weights.
        t5: Where the published sizes (vima-2m …) take T5 from: a folder with weights and tokenizer, or
            t5-base to fetch it from the Hugging Face Hub.
        assets: Pack of the demonstrations: procedural, original, or a checkout of the original benchmark.
        force: Throw away a run with other settings that is in the run folder.
    """
    from openvima.training import TrainingConfig, train

    given = {
        "steps": steps,
        "batch": batch,
        "learning_rate": learning_rate,
        "pretraining_steps": pretraining_steps,
        "checkpoint_every": checkpoint_every,
    }
    config = TrainingConfig(
        data=data,
        out=out,
        preset=preset,
        seed=seed,
        threads=threads,
        t5=t5,
        assets=assets,
        force=force,
        **{name: value for name, value in given.items() if value is not None},
    )
    with progress_bar("training") as report:
        run = train(config, report)
    print(f"`openvima evaluate --policy {run} --out results` scores it.", file=sys.stderr)
    print(run)
    return 0
