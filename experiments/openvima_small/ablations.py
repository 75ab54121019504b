r"""Ablations of the preset `small`, and its scaling with demonstrations.

    python experiments/openvima_small/ablations.py --data train400 --crops crops --out ablations \
        --only full,no-correspondence

All variants are trained for the same number of steps and evaluated on the same episodes. Most start from
the frozen crop encoder of the run `--crops`, so that only behaviour cloning differs. Two have a short
pretraining of their own, with and without appearance randomization. Repeating a command resumes it.
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from safetensors.torch import load_file

from openvima.atomic_io import atomic_write_file
from openvima.cli.progress import progress_bar
from openvima.data import Dataset
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.policies.build import build_network
from openvima.policies.checkpoint import save_checkpoint
from openvima.policies.config import PolicyConfig
from openvima.policies.file_names import WEIGHTS_FILE
from openvima.policies.nn.text_encoder import TextEncoderConfig
from openvima.policies.pointer.config import CandidateHeadConfig, ObjectHeadConfig, small
from openvima.policies.presets import PRESETS
from openvima.policies.sizes import SIZES
from openvima.policies.sources import find_checkpoint
from openvima.policies.vima.config import vima
from openvima.training import TrainingConfig, train
from openvima.training.recipes import RECIPES

_CROPS = ("images.crop_encoder.", "images.appearance.", "images.rotation.")
_SETTINGS = {
    **{name: value for name, value in RECIPES["small"].items() if not name.startswith("pretraining.")},
    "pretraining.steps": 0,
    "loader.batch_size": 64,
    "runtime.tensorboard": False,
}
_PRETRAINING = {
    **{name: value for name, value in RECIPES["small"].items() if name.startswith("pretraining.")},
    "pretraining.steps": 1000,
    "pretraining.num_scenes": 4000,
}


@dataclass(frozen=True, slots=True)
class Variant:
    """A network and how it is trained.

    Args:
        what: In a few words.
        sizes: Makes the network's sizes.
        settings: Settings of training that differ.
        crops: Whether the crop encoder is initialised from another run's contrastive pretraining.
    """

    what: str
    sizes: Callable[[], PolicyConfig] = small
    settings: dict[str, Any] = field(default_factory=dict)  # Any: as in `TrainingConfig`
    crops: bool = True


def _without_rotations() -> PolicyConfig:
    config = small()
    return replace(config, images=replace(config.images, rotation_bins=0))


def _with_dropout(probability: float) -> PolicyConfig:
    config = small()
    return replace(config, images=replace(config.images, crop_dropout=probability))


def _without_appearance_loss() -> PolicyConfig:
    config = small()
    assert isinstance(config.head, CandidateHeadConfig)
    return replace(config, head=replace(config.head, appearance_loss_weight=0.0))


def _without_coreference() -> PolicyConfig:
    return replace(small(), coreference=False)


def _vima() -> PolicyConfig:
    """VIMA with as many parameters as `small`, and its text encoder."""
    text = TextEncoderConfig(width=192, num_layers=3, num_heads=6, head_width=32, hidden_width=384)
    nano = SIZES["nano"]
    prompt = replace(nano.prompt, text=text, image_width=192)
    return vima(
        replace(nano, width=192, num_layers=4, num_heads=6, image_width=160, image_heads=5, prompt=prompt)
    )


VARIANTS = {
    "full": Variant("full model"),
    "pointing": Variant(
        "object head: place positions relative to visible objects only",
        lambda: replace(small(), head=ObjectHeadConfig()),
    ),
    "no-correspondence": Variant(
        "no correspondence between images",
        lambda: replace(small(), correspondence=None),
    ),
    "no-appearance-loss": Variant("no appearance loss", _without_appearance_loss),
    "no-coreference": Variant("no coreference", _without_coreference),
    "no-rotation": Variant("no relative rotation", _without_rotations),
    "no-inverse-dynamics": Variant(
        "no inverse dynamics", settings={"augmentation.inverse_dynamics_prob": 0.0}
    ),
    "no-renaming": Variant("no renamed objects", settings={"augmentation.rename_objects_prob": 0.0}),
    "no-shuffling": Variant("no shuffled sentences", settings={"augmentation.shuffle_sentences_prob": 0.0}),
    "no-distractors": Variant("no inserted distractors", settings={"augmentation.distractor_prob": 0.0}),
    "no-dropout": Variant("no crop dropout", lambda: _with_dropout(0.0)),
    "short-pretraining": Variant("own pretraining of 1,000 steps", settings=_PRETRAINING, crops=False),
    "no-appearance-randomization": Variant(
        "the same without appearance randomization",
        settings={**_PRETRAINING, "pretraining.appearance_randomization_prob": 0.0},
        crops=False,
    ),
    "vima": Variant(
        "VIMA architecture with action bins, vision transformer trained jointly",
        _vima,
        {"optimizer.learning_rate": 5e-4, "augmentation.inverse_dynamics_prob": 0.0},
        crops=False,
    ),
}


def main() -> int:
    """Train and evaluate the selected variants."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of demonstrations")
    parser.add_argument("--crops", type=Path, required=True, help="run of `small` after pretraining")
    parser.add_argument("--out", type=Path, required=True, help="folder of runs and results")
    parser.add_argument("--only", default=",".join(VARIANTS), help="variants, separated by commas")
    parser.add_argument("--name", default="", help="name in the table, instead of the variant's")
    parser.add_argument("--what", default="", help="short description, instead of the variant's")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights, order and augmentation")
    parser.add_argument("--steps", type=int, default=400, help="steps of behaviour cloning")
    parser.add_argument("--episodes", type=int, default=40, help="episodes per task and level")
    parser.add_argument("--levels", default="L1,L3,L4", help="levels of the evaluation")
    given = parser.parse_args()
    for name in given.only.split(","):
        if name not in VARIANTS:
            parser.error(f"there is no variant {name!r}; allowed: {', '.join(VARIANTS)}.")
    for name in given.only.split(","):
        row = _measure(given, name)
        atomic_write_file(given.out / f"{row['name']}.json", json.dumps(row, indent=2) + "\n")
        print(row)
    return 0


def _measure(given: argparse.Namespace, name: str) -> dict[str, Any]:  # Any: plain JSON values
    variant, folder = VARIANTS[name], given.out / (given.name or name)
    preset = f"small-{name}"
    PRESETS[preset] = variant.sizes
    settings = {**_SETTINGS, **variant.settings}
    if variant.crops:
        settings |= {"init_from": str(_begin(variant.sizes(), given.crops, folder / "init", given.seed))}
    settings |= {"data": given.data, "out": folder / "run", "preset": preset, "seed": given.seed}
    settings |= {"schedule.steps": given.steps, "schedule.checkpoint_every": min(200, given.steps)}
    config = TrainingConfig.of(settings)
    started = time.process_time()
    with progress_bar(f"training {name}") as report:
        run = train(config, report)
    minutes = (time.process_time() - started) / 60
    evaluation = EvaluationConfig(
        policies=(f"{given.name or name}={run}",),
        levels=tuple(given.levels.split(",")),
        episodes=given.episodes,
        workers=1,
        out=folder / "evaluation",
    )
    with progress_bar(f"evaluation of {name}") as report:
        evaluate(evaluation, report)
    return {
        "name": given.name or name,
        "what": given.what or variant.what,
        "demonstrations": len(Dataset(given.data)),
        "steps": given.steps,
        "seed": given.seed,
        "parameters": sum(p.numel() for p in build_network(variant.sizes(), seed=0).parameters()),
        "minutes": round(minutes, 1),
        "evaluation": os.fspath(folder / "evaluation" / "results.json"),
    }


def _begin(sizes: PolicyConfig, crops: Path, folder: Path, seed: int) -> Path:
    """Write initial weights: fresh ones, with the crop encoder of another run."""
    network = build_network(sizes, seed=seed)
    own, other = network.state_dict(), load_file(find_checkpoint(str(crops)) / WEIGHTS_FILE)
    pretrained = {name: other[name] for name in own if name.startswith(_CROPS)}
    network.load_state_dict({**own, **pretrained})
    save_checkpoint(network, folder)
    return folder


if __name__ == "__main__":
    raise SystemExit(main())
