r"""Ablations of the preset `small`, and its scaling with demonstrations.

    python experiments/openvima_small/ablations.py --data train400 --crops openvima-small --out ablations \
        --only full,no-correspondence

All variants are trained for the same number of steps and evaluated on the same episodes. Most start from
the frozen crop encoder, appearance and attributes of the run `--crops`, so that only behaviour cloning
differs. Two have a short pretraining of their own, with and without appearance randomization. Repeating a
command resumes it.
"""

import argparse
import json
import os
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
from openvima.policies.checkpoint import read_info, save_checkpoint
from openvima.policies.config import PolicyConfig
from openvima.policies.file_names import TOKENIZER_FOLDER, WEIGHTS_FILE
from openvima.policies.parameter_counts import policy_size
from openvima.policies.pointer.config import CandidateHeadConfig, ObjectHeadConfig, PointerConfig, small
from openvima.policies.presets import PRESETS
from openvima.policies.sources import find_checkpoint
from openvima.policies.t5 import tokenizer_for
from openvima.training import TrainingConfig, train
from openvima.training.recipes import RECIPES
from weights import read_lines, spent

_CROPS = ("images.crop_encoder.", "images.appearance.", "images.rotation.", "attributes.")


@dataclass(frozen=True, slots=True)
class Variant:
    """A network and how it is trained.

    Args:
        what: In a few words.
        change: Changes the sizes of the network of `--crops`.
        settings: Settings of training that differ.
        is_pretrained: Whether it has a contrastive pretraining of its own, and takes nothing from `--crops`.
    """

    what: str
    change: Callable[[PointerConfig], PointerConfig] = lambda config: config
    settings: dict[str, Any] = field(default_factory=dict)  # Any: as in `TrainingConfig`
    is_pretrained: bool = False


def _without_rotations(config: PointerConfig) -> PointerConfig:
    return replace(config, images=replace(config.images, rotation_bins=0))


def _with_dropout(config: PointerConfig, probability: float) -> PointerConfig:
    return replace(config, images=replace(config.images, crop_dropout=probability))


def _without_appearance_loss(config: PointerConfig) -> PointerConfig:
    assert isinstance(config.head, CandidateHeadConfig)
    return replace(config, head=replace(config.head, appearance_loss_weight=0.0))


VARIANTS = {
    "full": Variant("full model"),
    "pointing": Variant(
        "object head: place positions relative to visible objects only",
        lambda config: replace(config, head=ObjectHeadConfig(), attributes=None),
    ),
    "no-attributes": Variant("no attributes", lambda config: replace(config, attributes=None)),
    "no-correspondence": Variant(
        "no correspondence between images", lambda config: replace(config, correspondence=None)
    ),
    "no-appearance-loss": Variant("no appearance loss", _without_appearance_loss),
    "no-coreference": Variant("no coreference", lambda config: replace(config, coreference=False)),
    "no-rotation": Variant("no relative rotation", _without_rotations),
    "no-dropout": Variant("no crop dropout", lambda config: _with_dropout(config, 0.0)),
    "inverse-dynamics": Variant(
        "with inverse dynamics",
        settings={
            "augmentation.inverse_dynamics_prob": 0.2,
            "augmentation.drop_unused_objects_prob": 0.35,
        },
    ),
    "no-renaming": Variant("no renamed objects", settings={"augmentation.rename_objects_prob": 0.0}),
    "no-shuffling": Variant("no shuffled sentences", settings={"augmentation.shuffle_sentences_prob": 0.0}),
    "no-distractors": Variant("no inserted distractors", settings={"augmentation.distractor_prob": 0.0}),
    "no-rerendering": Variant(
        "no demonstrations with random appearance", settings={"loader.rerendered_prob": 0.0}
    ),
    "no-wording": Variant(
        "no text descriptions, paraphrases and unknown words",
        settings={
            "augmentation.text_description_prob": 0.0,
            "augmentation.paraphrase_prob": 0.0,
            "augmentation.unknown_word_prob": 0.0,
        },
    ),
    "short-pretraining": Variant("own pretraining of 1,000 steps", is_pretrained=True),
    "no-appearance-randomization": Variant(
        "the same without appearance randomization",
        settings={"pretraining.appearance_randomization_prob": 0.0},
        is_pretrained=True,
    ),
}


def main() -> int:
    """Train and evaluate the selected variants."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of demonstrations")
    parser.add_argument("--crops", default="openvima-small", help="run of `small` after pretraining")
    parser.add_argument("--recipe", default="small", help="recipe of the other settings")
    parser.add_argument("--out", type=Path, required=True, help="folder of runs and results")
    parser.add_argument("--only", default=",".join(VARIANTS), help="variants, separated by commas")
    parser.add_argument("--name", default="", help="name in the table, instead of the variant's")
    parser.add_argument("--what", default="", help="short description, instead of the variant's")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights, order and augmentation")
    parser.add_argument("--steps", type=int, default=400, help="steps of behaviour cloning")
    parser.add_argument("--episodes", type=int, default=40, help="episodes per task and level")
    parser.add_argument("--first-episode", type=int, default=0, help="first seed of the evaluation")
    parser.add_argument("--workers", type=int, default=1, help="processes of the evaluation")
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
    settings = _settings(variant, given.recipe)
    sizes: PolicyConfig = small()
    if not variant.is_pretrained:
        sizes, initial = _begin(variant, given.crops, folder / "init", given.seed)
        settings |= {"init_from": str(initial)}
    PRESETS[f"small-{name}"] = lambda: sizes
    settings |= {"data": given.data, "preset": f"small-{name}", "seed": given.seed}
    settings |= {"schedule.steps": given.steps, "schedule.checkpoint_every": min(200, given.steps)}
    with progress_bar(f"training {name}") as report:
        run = train(TrainingConfig.of({**settings, "out": folder / "run"}), report)
    evaluation = EvaluationConfig(
        policies=(f"{given.name or name}={run}",),
        levels=tuple(given.levels.split(",")),
        episodes=given.episodes,
        seed=given.first_episode,
        workers=given.workers,
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
        "parameters": policy_size(read_info(find_checkpoint(run)).config).parameters.total,
        "minutes": round(60 * spent(read_lines(run / "timings_log.jsonl"))[0], 1),
        "evaluation": os.fspath(folder / "evaluation" / "results.json"),
    }


def _settings(variant: Variant, recipe: str) -> dict[str, Any]:  # Any: as in `TrainingConfig`
    """Return the settings of a recipe for a variant; the parts of its network are in its sizes already."""
    kept = {
        name: value
        for name, value in RECIPES[recipe].items()
        if variant.is_pretrained or not name.startswith(("pretraining.", "model."))
    }
    steps = {"pretraining.steps": 1000, "pretraining.num_scenes": 4000} if variant.is_pretrained else {}
    own = {"pretraining.steps": 0, **steps, "loader.batch_size": 64, "runtime.tensorboard": False}
    own["runtime.processes"] = 1  # others do not know the presets that are made here
    return {**kept, **own, **variant.settings}


def _begin(variant: Variant, crops: str, folder: Path, seed: int) -> tuple[PolicyConfig, Path]:
    """Write initial weights: fresh ones, with what contrastive pretraining of another run has learnt."""
    source = find_checkpoint(crops)
    config = read_info(source).config
    assert isinstance(config, PointerConfig)  # `--crops` is a run of `small`
    sizes = variant.change(config)
    network = build_network(sizes, seed=seed)
    own, other = network.state_dict(), load_file(source / WEIGHTS_FILE)
    pretrained = {name: other[name] for name in own if name.startswith(_CROPS)}
    network.load_state_dict({**own, **pretrained})
    save_checkpoint(network, folder, tokenizer_for(sizes.prompt, source / TOKENIZER_FOLDER))
    return sizes, folder


if __name__ == "__main__":
    raise SystemExit(main())
