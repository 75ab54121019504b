"""`openvima train`: train a policy on demonstrations."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from openvima.cli.progress import progress_bar

if TYPE_CHECKING:
    from openvima.evaluation.online_eval import OnlineEval
    from openvima.training import TrainingConfig

DESCRIPTION = """Train a policy on demonstrations, or go on with a run that was interrupted.

The whole policy learns by behaviour cloning. Before that, with nano, nano-bins and small, the crop encoder
learns to match objects in prompt images with objects in scenes drawn for that. The same command continues an
interrupted run exactly where its last checkpoint stands.

Example: openvima train --data demos --preset nano --out run

--recipe names settings to begin with: "paper" trains as the VIMA paper does, "workstation" on one GPU with
less data, "nano" for minutes on a few cores, "small" for a policy like that of the package. By default it
is "small" for the preset of that name, "nano" for nano presets and learners of your own, else "paper". With
--init no recipe or file brings pretraining; --pretraining-steps does.
--config takes a YAML file of settings, such as the config.yaml of another run. What is given here counts
most. The defaults below are those of the recipe and file that were chosen.

Several GPUs or machines: torchrun --nproc-per-node 8 -m openvima train --data demos --out run ...
"""


def run(words: Sequence[str]) -> int:
    """Read the settings, and train.

    Args:
        words: The words after the verb.

    Returns:
        Exit status.
    """
    import tyro

    from openvima.training import TrainingConfig, train
    from openvima.training.recipes import default_recipe, overridden, read_settings, recipe_settings

    basis = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    basis.add_argument("--recipe")
    basis.add_argument("--config", type=Path)
    begun, rest = basis.parse_known_args(list(words))
    peek = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("--preset", "--init", "--steps", "--epochs"):
        peek.add_argument(name)
    known, _ = peek.parse_known_args(rest)
    file = read_settings(begun.config) if begun.config else {}
    preset = known.preset or file.get("preset")
    recipe = begun.recipe or default_recipe(preset or "nano")
    settings = overridden(recipe_settings(recipe), file)
    if known.steps and not known.epochs:
        settings["epochs"] = None
    if known.init not in (None, "None"):
        settings = overridden(settings, {"init": known.init})
    given = {name: settings.get(name, tyro.MISSING) for name in ("data", "out")}
    others = {name: value for name, value in settings.items() if name not in given}
    if preset:
        others["preset"] = preset  # so that the defaults fit together even before it is parsed again
    config = tyro.cli(
        TrainingConfig,
        prog="openvima train",
        description=DESCRIPTION,
        args=rest,
        default=TrainingConfig(**given, **others),
    )
    is_first = os.environ.get("RANK", "0") == "0"  # among those that torchrun starts
    with progress_bar("training") if is_first else nullcontext() as report:
        folder = train(config, report, _rollout(config) if config.rollout_every else None)
    if not is_first:
        return 0
    if ":" not in config.preset:
        print(f"`openvima evaluate --policy {folder} --out results` scores it.", file=sys.stderr)
    print(folder)
    return 0


def _rollout(config: "TrainingConfig") -> "OnlineEval":
    """What plays a checkpoint in the simulator, on the tasks of the data."""
    from openvima.data.reader import read_manifest
    from openvima.env import EnvConfig
    from openvima.evaluation.online_eval import ONLINE_EVAL_LEVEL, OnlineEval
    from openvima.tasks.registry import task_spec

    tasks = sorted(read_manifest(config.data)["tasks"])
    playable = tuple(task for task in tasks if ONLINE_EVAL_LEVEL in task_spec(task).levels)
    return OnlineEval(playable, config.rollout_episodes, EnvConfig(config.assets))
