"""`openvima train`: train a policy on demonstrations."""

import sys
from pathlib import Path

from openvima.cli.progress import progress_bar


def main(
    *,
    data: Path,
    out: Path,
    preset: str = "nano",
    steps: int = 400,
    batch: int = 64,
    learning_rate: float = 1e-3,
    pretraining_steps: int | None = None,
    checkpoint_every: int = 100,
    seed: int = 0,
    threads: int = 1,
    t5: str | None = None,
    assets: str = "procedural",
    tokens: Path | None = None,
    force: bool = False,
) -> int:
    """Train a policy on demonstrations, or go on with a run that was interrupted.

    The whole policy learns by behaviour cloning. Before that, with nano and nano-bins, the crop encoder
    learns to match objects in prompt images with objects in scenes drawn for that. The same command continues
    an interrupted run exactly where its last checkpoint stands.

    Example: openvima train --data demos --preset nano --out run

    Args:
        data: Folder of demonstrations, as `openvima generate` writes it.
        out: Run folder for checkpoints, settings and metrics; `openvima evaluate --policy` takes it.
        preset: Network and sizes, such as nano or gato-nano; `openvima policies` lists all.
        steps: Steps of behaviour cloning.
        batch: Demonstrations a step.
        learning_rate: Highest learning rate of cloning.
        pretraining_steps: Steps of matching prompt and scene; 0 leaves it out. None is as the preset wants:
            400 for nano and nano-bins, 0 for the others.
        checkpoint_every: Steps between checkpoints.
        seed: Decides weights, order of the data and augmentation.
        threads: Threads to compute with; equal numbers give equal weights.
        t5: Where the published sizes (vima-2m …) take T5 from: a folder with weights and tokenizer, or
            t5-base to fetch it from the Hugging Face Hub.
        assets: Pack of the demonstrations: procedural, original, or a checkout of the original benchmark.
        tokens: Folder to keep objects in that are cut out of the demonstrations; by default beside them.
        force: Throw away a run with other settings that is in the run folder.
    """
    from openvima.training import TrainingConfig, train

    config = TrainingConfig(
        data=data,
        out=out,
        preset=preset,
        steps=steps,
        batch=batch,
        learning_rate=learning_rate,
        pretraining_steps=pretraining_steps,
        checkpoint_every=checkpoint_every,
        seed=seed,
        threads=threads,
        t5=t5,
        assets=assets,
        tokens=tokens,
        force=force,
    )
    with progress_bar("training") as report:
        run = train(config, report)
    print(f"`openvima evaluate --policy {run} --out results` scores it.", file=sys.stderr)
    print(run)
    return 0
