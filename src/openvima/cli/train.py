"""`openvima train`: train a policy on demonstrations."""

import argparse
import logging
import os
import shlex
import sys
from collections.abc import Collection, Sequence
from contextlib import nullcontext
from dataclasses import fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import tyro

from openvima.cli.terminal import progress_bar
from openvima.errors import ConfigError

if TYPE_CHECKING:
    from openvima.evaluation.recording import OnlineEval
    from openvima.training import TrainingConfig

DESCRIPTION = """Train a policy on demonstrations by behaviour cloning, or resume an interrupted run.

With nano, nano-bins, small, vima-nano and midas-nano, crops are pretrained on rendered scenes first.
The same command resumes an interrupted run from its last checkpoint.

Example: openvima train --data demos --preset nano --out run

--recipe selects default settings: "paper" (as in the VIMA paper), "papers" (vima-nano on two cores),
"papers-midas" and "papers-frames" (midas-nano; gato-nano and the like), "workstation" (one GPU, less data),
"nano" (minutes on a few cores), "small" (the bundled openvima-small), "midas-pretrain", "midas-finetune" or
"midas-in-context". The default is that of the preset, "nano" for your own learners, else "paper".
--init-from disables the pretraining of recipe and file; set --pretraining.steps to pretrain anyway.
--config takes a YAML file of settings, such as the config.yaml of another run. Options take precedence over
the file, and the file over the recipe. The defaults below are those of the selected recipe and file.
--trust-code lets the file name code that is run, such as a learner or detector of your own.
--help-all shows all options, and --help those that most runs set.

Several GPUs or processes: --runtime.processes 8. Several machines: torchrun --nnodes 2 --nproc-per-node 8
-m openvima train --data demos --out run ...
"""


# Settings that --help shows.
COMMON = (
    "data",
    "out",
    "preset",
    "init_from",
    "t5",
    "force",
    "seed",
    "schedule.steps",
    "schedule.checkpoint_every",
    "loader.batch_size",
    "optimizer.learning_rate",
    "optimizer.grad_accum_steps",
    "pretraining.steps",
    "rollout.every",
    "runtime.device",
    "runtime.processes",
)

# Options that change the defaults of others.
_DECIDING = (
    "preset",
    "init_from",
    "crops_from",
    "schedule.steps",
    "schedule.epochs",
    "model.image_tokens",
    "model.head",
)


def run(words: Sequence[str]) -> None:
    """Parse the settings, and train.

    Args:
        words: Arguments after the verb.
    """
    from openvima.policies.presets import PRESETS

    config = parse(words)
    folder = train_in_processes(config, words)
    if os.environ.get("RANK", "0") != "0":
        return
    trust = "" if config.preset in PRESETS else " --trust-code"
    hint = f"`openvima evaluate --policy {shlex.quote(str(folder))}{trust} --out scores` scores it."
    print(hint, file=sys.stderr)
    print(folder)


def parse(words: Sequence[str]) -> "TrainingConfig":
    """Parse the settings; those that are not given are of the recipe and the file that are."""
    from openvima.multiprocess import num_cpus
    from openvima.training import TrainingConfig
    from openvima.training.recipes import default_recipe, override, read_settings, recipe_settings

    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--recipe")
    first.add_argument("--config", type=Path)
    first.add_argument("--trust-code", action="store_true")
    first.add_argument("--help-all", action="store_true")
    chosen, rest = first.parse_known_args(list(words))
    for name in _DECIDING:  # these are parsed again, with the others
        first.add_argument(f"--{name.replace('_', '-')}", f"--{name}", dest=name)
    peeked = vars(first.parse_known_args(rest)[0])
    known = {name: peeked[name] for name in _DECIDING}
    file = read_settings(chosen.config, trust_code=chosen.trust_code) if chosen.config else {}
    preset = known.pop("preset") or file.get("preset")
    settings = override(recipe_settings(chosen.recipe or default_recipe(preset or "nano")), file)
    steps, epochs = known.pop("schedule.steps"), known.pop("schedule.epochs")
    if steps and not epochs:
        settings["schedule.epochs"] = None
    given = {name: value for name, value in known.items() if value not in (None, "None")}
    settings = override(settings, given)
    if preset:
        settings["preset"] = preset  # so that the defaults are consistent before it is parsed again
    settings.setdefault("runtime.workers", num_cpus())
    default = TrainingConfig.of({"data": Path(), "out": Path(), **settings})
    for name in {"data", "out"} - settings.keys():
        object.__setattr__(default, name, tyro.MISSING)  # required, but a config checks that it is a path
    if chosen.help_all:
        rest.append("--help")
    shown = COMMON if {"-h", "--help"} & {*rest} and not chosen.help_all else None
    # The parser would report in a box of its own what a config refuses, so it gets one without checks.
    unchecked = _unchecked(default, shown)
    parsed = tyro.cli(
        type(unchecked), prog="openvima train", description=DESCRIPTION, args=rest, default=unchecked
    )
    return TrainingConfig(**{setting.name: getattr(parsed, setting.name) for setting in fields(parsed)})


def _unchecked(default: Any, shown: Collection[str] | None, prefix: str = "") -> Any:
    """Return a config with the same settings, of a class without checks; it hides what is not shown."""
    kind, hints = type(default), get_type_hints(type(default), include_extras=True)
    settings = []
    for name, value in ((setting.name, getattr(default, setting.name)) for setting in fields(default)):
        hint = hints[name]
        if shown is not None and is_dataclass(value):
            value = _unchecked(value, shown, f"{prefix}{name}.")
            hint = type(value)
        elif shown is not None and prefix + name not in shown:
            hint = Annotated[hint, tyro.conf.Suppress]
        settings.append((name, hint, value))
    namespace = {"__doc__": kind.__doc__, "__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, settings, bases=(kind,), frozen=True, namespace=namespace)()


def train_in_processes(config: "TrainingConfig", words: Sequence[str], label: str = "training") -> Path:
    """Train in as many processes as the settings ask for, with progress on stderr.

    Args:
        config: All settings.
        words: The arguments that `parse` reads them from, for the other processes.
        label: Of the progress bar.

    Returns:
        The run folder.
    """
    import torch

    from openvima.training import train
    from openvima.training.parallel import start_peers

    log = logging.getLogger("openvima.training")
    log.setLevel(logging.INFO)
    if not log.handlers:
        log.addHandler(_Lines())
    is_first = os.environ.get("RANK", "0") == "0"
    others = 0 if "WORLD_SIZE" in os.environ else config.runtime.processes - 1
    if config.runtime.device in ("auto", "cuda") and (num_gpus := torch.cuda.device_count()):
        others = min(others, num_gpus - 1)  # at most one on each
    with (
        start_peers(others, ["-m", "openvima", "train", *words]) if others else nullcontext(),
        progress_bar(label) if is_first else nullcontext() as report,
    ):
        rollout = _rollout(config) if config.rollout.every else None
        return train(config, report, rollout, rollout.animate if rollout and config.rollout.animate else None)


class _Lines(logging.Handler):
    """Writes to what stderr is now: above the progress bar, while one is shown."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = "openvima: warning: " if record.levelno >= logging.WARNING else ""
        print(prefix + record.getMessage(), file=sys.stderr)


def _rollout(config: "TrainingConfig") -> "OnlineEval":
    """Return rollouts of a checkpoint on the tasks of the data, with prompts in their form."""
    from openvima.data.reader import Dataset
    from openvima.evaluation.recording import ONLINE_EVAL_LEVEL, OnlineEval
    from openvima.scene import COMPOSED
    from openvima.scene.action import PRIMITIVES
    from openvima.tasks.registry import task_spec

    dataset = Dataset(config.data)
    trained = sorted(set(dataset.manifest["tasks"]) - {*config.loader.excluded_tasks})
    playable = tuple(t for t in trained if t != COMPOSED and ONLINE_EVAL_LEVEL in task_spec(t).levels)
    if not playable:
        raise ConfigError(
            f"none of the tasks in {config.data} exists at {ONLINE_EVAL_LEVEL}; leave out rollout.every."
        )
    first = dataset.shard(dataset.shard_names()[0])  # merged folders may have others
    env_config = replace(first.info.env_config, assets=config.assets, control=PRIMITIVES)
    return OnlineEval(playable, config.rollout.episodes, env_config)
