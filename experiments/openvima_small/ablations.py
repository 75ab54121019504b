r"""Ablations of the preset `small`, and its scaling with demonstrations.

    python experiments/openvima_small/ablations.py --data train --crops run --out ablations \
        --only full,no-correspondence

All variants are trained by one recipe for the same number of steps, each with several seeds, and evaluated on
the same episodes, other ones for each seed. Most start from the frozen crop encoder of the run `--crops`, a
checkpoint of the same recipe, so that only behaviour cloning differs. The others have a short pretraining of
their own, and "short-pretraining" is what those are compared with.

A killed command goes on where it was when repeated. Several may share the work: each takes what no other one
is at. OUT/NAME.json holds the outcomes of each run (NAME-seed-S from the second seed on), so what is there
counts without its training, and OUT/ablations.md has the differences, with intervals over seeds and episodes;
`--table` only writes that.
"""

import argparse
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.cli.terminal import progress_bar
from openvima.data import Dataset
from openvima.errors import FolderLockedError
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.results import Results
from openvima.evaluation.statistics import PairCounts, difference_over_seeds, mean_over_seeds
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_network, save_checkpoint
from openvima.policies.pointer.config import ObjectHeadConfig, PointerConfig
from openvima.policies.presets import PRESETS
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from openvima.policies.variants import with_variant
from openvima.report.table import Estimate, Line, Table, markdown
from openvima.training import TrainingConfig, train
from openvima.training.recipes import override, recipe_settings
from openvima.training.run_folder import read_costs

_PRETRAINED = ("images.crop_encoder.", "images.appearance.", "images.rotation.", "attributes.")
_SHORT_PRETRAINING = {"pretraining.steps": 1000, "pretraining.num_scenes": 4000}
FULL = "full"
_NO_ATTRIBUTES = {"model.attributes": False, "pretraining.attribute_loss_weight": 0.0}

Settings = dict[str, Any]
Solved = dict[str, dict[str, str]]  # outcomes by level and task


@dataclass(frozen=True, slots=True)
class Variant:
    """A network and how it is trained.

    Args:
        what: In a few words.
        change: Changes the network of `--crops`.
        settings: Settings of training that differ from the recipe.
        baseline: The variant that it is compared with.
    """

    what: str
    change: Callable[[PointerConfig], PointerConfig] = lambda config: config
    settings: Settings = field(default_factory=dict)
    baseline: str = FULL

    @property
    def has_own_crops(self) -> bool:
        """Whether it pretrains a crop encoder of its own, instead of that of another run."""
        return "pretraining.steps" in self.settings


@dataclass(frozen=True, slots=True)
class Recorded:
    """The trainings of a variant, whose definition may have changed since.

    Args:
        what: As of the variant.
        baseline: As of the variant.
        seeds: Outcomes by seed.
    """

    what: str
    baseline: str
    seeds: dict[int, Solved] = field(default_factory=dict)


def _without(part: str) -> Callable[[PointerConfig], PointerConfig]:
    """Return a change of the network that sets one of its fields to None, False or 0."""

    def change(config: PointerConfig) -> PointerConfig:
        if part in ("correspondence", "coreference"):
            return replace(config, **{part: None if part == "correspondence" else False})
        if part in ("rotation_bins", "crop_dropout"):
            return replace(config, images=replace(config.images, **{part: 0}))
        return replace(config, head=replace(config.head, **{part: 0.0}))

    return change


def _within_prompts_only(config: PointerConfig) -> PointerConfig:
    assert config.correspondence
    return replace(config, correspondence=replace(config.correspondence, within_view=False))


def _shared_attributes(config: PointerConfig) -> PointerConfig:
    assert config.attributes
    return replace(config, attributes=replace(config.attributes, exclusive=False))


def _probs_of_cloning() -> dict[str, Variant]:
    """Leave out what the recipe draws in behaviour cloning, one at a time, or add what it does not."""
    return {
        "inverse-dynamics": Variant(
            "with inverse dynamics",
            settings={
                "augmentation.inverse_dynamics_prob": 0.2,
                "augmentation.drop_unused_objects_prob": 0.35,
            },
        ),
        "no-rerendering": Variant(
            "no demonstrations with random appearance", settings={"loader.rerendered_prob": 0.0}
        ),
        "no-text-prompts": Variant(
            "no prompts of text alone", settings={"augmentation.text_prompt_prob": 0.0}
        ),
        "no-wording": Variant(
            "no text descriptions, synonyms, paraphrases and unknown words",
            settings={
                f"augmentation.{name}_prob": 0.0
                for name in ("text_description", "text_prompt", "synonym", "paraphrase", "unknown_word")
            },
        ),
        **{
            name: Variant(what, settings={f"augmentation.{setting}": 0.0})
            for name, what, setting in (
                ("no-renaming", "no renamed objects", "rename_objects_prob"),
                ("no-shuffling", "no shuffled sentences", "shuffle_sentences_prob"),
                ("no-distractors", "no inserted distractors", "distractor_prob"),
                ("no-false-positives", "no false positives", "false_positive_prob"),
                ("no-object-shuffling", "prompt objects in order", "shuffle_prompt_objects_prob"),
            )
        },
    }


def _pretraining() -> dict[str, Variant]:
    """A short pretraining, and what it is worth without each of its parts."""
    parts = (
        ("appearance-randomization", "appearance randomization", ("appearance_randomization_prob",)),
        ("hard-negatives", "hard negatives", ("hard_negative_prob",)),
        ("occlusion", "occlusion", ("occlusion_prob",)),
        ("grayscale", "grayscale prompt images", ("grayscale_prob",)),
        ("box-jitter", "box jitter", ("box_jitter_px",)),
        (
            "random-containers",
            "gratings, ears, rings and blocks",
            ("grating_prob", "eared_prob", "ring_and_block_prob"),
        ),
    )
    found = {
        "short-pretraining": Variant("own pretraining of 1,000 steps", settings=_SHORT_PRETRAINING),
        "wide-crops": Variant(
            "the same with a wider crop encoder: 48 channels, kernel 3",
            settings={**_SHORT_PRETRAINING, "model.crop_width": 48, "model.crop_kernel": 3},
            baseline="short-pretraining",
        ),
    }
    for name, what, settings in parts:
        off = {f"pretraining.{setting}": 0.0 for setting in settings}
        found[f"no-{name}"] = Variant(
            f"the same without {what}", settings={**_SHORT_PRETRAINING, **off}, baseline="short-pretraining"
        )
    return found


VARIANTS = {
    FULL: Variant("full model"),
    "pointing": Variant(
        "object head: place positions relative to visible objects only",
        lambda config: replace(config, head=ObjectHeadConfig(), attributes=None),
        _NO_ATTRIBUTES,
        baseline="no-attributes",
    ),
    "no-attributes": Variant("no attributes", settings=_NO_ATTRIBUTES),
    "shared-attributes": Variant("sizes and appearance beside selected attributes", _shared_attributes),
    "no-correspondence": Variant("no correspondence between images", _without("correspondence")),
    "no-view-correspondence": Variant("no correspondence within the view", _within_prompts_only),
    "no-coreference": Variant("no coreference", _without("coreference")),
    "no-rotation": Variant("no relative rotation", _without("rotation_bins")),
    "no-appearance-loss": Variant("no appearance loss", _without("appearance_loss_weight")),
    "no-grounding-loss": Variant("no grounding loss", _without("grounding_loss_weight")),
    "no-dropout": Variant("no crop dropout", _without("crop_dropout")),
    "one-prompt-query": Variant(
        "one prompt object at once",
        lambda config: replace(config, head=replace(config.head, num_prompt_queries=1)),
    ),
    "two-layers": Variant("two decoder layers", settings={"model.num_layers": 2}),
    "four-layers": Variant("four decoder layers", settings={"model.num_layers": 4}),
    **_probs_of_cloning(),
    **_pretraining(),
}


def main() -> int:
    """Train and evaluate the selected variants, and write the table."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--data", type=Path, required=True, help="folder of demonstrations")
    parser.add_argument("--crops", required=True, help="run of the recipe after pretraining, or a checkpoint")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--runs", type=Path, help="folder of trainings and evaluations, if not OUT")
    parser.add_argument("--only", default=",".join(VARIANTS), help="variants, separated by commas")
    parser.add_argument("--recipe", default="small", help="recipe that the variants differ from")
    parser.add_argument("--seeds", default="0,1,2", help="seeds of weights, order and augmentation")
    parser.add_argument("--steps", type=int, default=1500, help="steps of behaviour cloning")
    parser.add_argument("--batch", type=int, default=64, help="demonstrations a step")
    parser.add_argument("--episodes", type=int, default=40, help="episodes per task and level")
    parser.add_argument("--first-episode", type=int, default=60_000, help="seed of the first of them")
    parser.add_argument("--workers", type=int, default=1, help="processes of the evaluation")
    parser.add_argument("--levels", default="L1,L2,L3,L4", help="levels of the evaluation")
    parser.add_argument("--table", action="store_true", help="train nothing")
    given = parser.parse_args()
    names, seeds = given.only.split(","), [int(seed) for seed in given.seeds.split(",")]
    for name in names:
        if name not in VARIANTS:
            parser.error(f"there is no variant {name!r}; allowed: {', '.join(VARIANTS)}.")
    for seed in () if given.table else seeds:  # all variants of one seed, then those of the next
        for name in names:
            row = _row_file(given.out, name, seed)
            try:
                if not row.exists():
                    atomic_write_file(row, json.dumps(_measure(given, name, seed), indent=2) + "\n")
            except FolderLockedError:
                print(f"{name} with seed {seed} is another command's")
    table = differences_table(read_rows(given.out))
    atomic_write_file(given.out / "ablations.md", table)
    print(table)
    return 0


def _row_file(out: Path, name: str, seed: int) -> Path:
    return out / (f"{name}-seed-{seed}.json" if seed else f"{name}.json")


def settings_of(name: str, recipe: str) -> Settings:
    """Return the settings of a variant, without paths, seed and length."""
    alone = {"runtime.processes": 1, "runtime.tensorboard": False}  # several commands share the cores instead
    pretraining = {} if VARIANTS[name].has_own_crops else {"pretraining.steps": 0}
    return override(recipe_settings(recipe), {**alone, **pretraining, **VARIANTS[name].settings})


def _measure(given: argparse.Namespace, name: str, seed: int) -> dict[str, Any]:
    variant, row = VARIANTS[name], _row_file(given.runs or given.out, name, seed)
    folder, preset = row.with_suffix(""), f"small-{name}"
    pretrained, stored = load_network(given.crops)
    assert isinstance(pretrained.config, PointerConfig)
    sizes = variant.change(pretrained.config)
    PRESETS[preset] = lambda: sizes
    settings = settings_of(name, given.recipe)
    settings |= {"data": given.data, "out": folder / "run", "preset": preset, "seed": seed}
    settings |= {"schedule.steps": given.steps, "schedule.checkpoint_every": min(250, given.steps)}
    settings |= {"loader.batch_size": given.batch}
    config = TrainingConfig.of(settings)
    network = build_network(with_variant(sizes, asdict(config.model)), seed=seed)
    if not variant.has_own_crops and not (folder / "init").exists():
        own, other = network.state_dict(), pretrained.state_dict()
        own |= {key: other[key] for key in own if key.startswith(_PRETRAINED)}
        network.load_state_dict(own)
        save_checkpoint(network, folder / "init", WordTokenizer(Vocabulary.read(stored)) if stored else None)
    if not variant.has_own_crops:
        config = replace(config, init_from=str(folder / "init"))
    with progress_bar(f"training {row.stem}") as report:
        run = train(config, report)
    evaluation = EvaluationConfig(
        policies=(f"{row.stem}={run}",),
        levels=tuple(given.levels.split(",")),
        episodes=given.episodes,
        seed=given.first_episode + seed * given.episodes,
        workers=given.workers,
        out=folder / "evaluation",
    )
    with progress_bar(f"evaluation of {row.stem}") as report:
        results = Results.read(evaluate(evaluation, report))
    return {
        "variant": name,
        "what": variant.what,
        "baseline": variant.baseline,
        "demonstrations": len(Dataset(given.data)),
        "steps": given.steps,
        "seed": seed,
        "recipe": given.recipe,
        "parameters": sum(p.numel() for p in network.parameters()),
        "minutes": round(read_costs(run)["seconds"] / 60, 1),
        "first_episode": evaluation.seed,
        "solved": solved(results),
    }


def solved(results: Results) -> Solved:
    """Return which episodes were solved, by level and task: "1" or "0" for each, in the order of seeds."""
    found: Solved = {}
    for row in results.rows:
        bits = "".join(str(int(outcome.success)) for outcome in row.outcomes)
        found.setdefault(row.level, {})[row.task] = bits
    return found


def read_rows(folder: Path) -> dict[str, Recorded]:
    """Read the outcomes of all runs by variant, the full model first."""
    found: dict[str, Recorded] = {}
    rows = [json.loads(file.read_text(encoding="utf-8")) for file in folder.glob("*.json")]
    for row in sorted(rows, key=lambda row: (row["variant"] != FULL, row["variant"], row["seed"])):
        new = Recorded(row["what"], row.get("baseline", FULL))
        found.setdefault(row["variant"], new).seeds[row["seed"]] = row["solved"]
    return found


def differences_table(found: dict[str, Recorded]) -> str:
    """Write the success of all variants and their differences from their baselines, of the seeds of both."""
    levels = list(next(iter(next(iter(found.values())).seeds.values()))) if found else []
    lines = []
    for name, recorded in found.items():
        of_seeds, cells = recorded.seeds, []
        baseline = found[recorded.baseline].seeds if recorded.baseline in found else {}
        shared = sorted(of_seeds.keys() & baseline.keys())
        for level in levels:
            cells.append(_score(list(own[level].values()) for own in of_seeds.values()))
            if not shared or recorded.baseline == name:
                cells.append("")
                continue
            pairs = [(of_seeds[seed][level], baseline[seed][level]) for seed in shared]
            difference, interval = difference_over_seeds(
                [[PairCounts.of(_outcomes(a[task], b[task])) for task in a] for a, b in pairs]
            )
            mark = "≈" if interval[0] <= 0 <= interval[1] else ""
            cells.append(Estimate(difference, interval, True, mark))
        lines.append(Line(recorded.what, (str(len(of_seeds)), *cells)))
    columns = ("", "seeds", *(column for level in levels for column in (level, "difference")))
    return markdown([Table("ablations", "", columns, tuple(lines))])


def attribute_table(found: dict[str, Recorded]) -> str:
    """Write L4 with and without attributes, task by task; empty if one of them was not trained."""
    pair = [found[name] for name in (FULL, "no-attributes") if name in found]
    if len(pair) < 2:
        return ""
    tasks = list(next(iter(pair[0].seeds.values()))["L4"])
    lines = []
    for what, recorded in zip(("with attributes", "without"), pair, strict=True):
        rows = list(recorded.seeds.values())
        of_tasks = [_score([row["L4"][task]] for row in rows) for task in tasks]
        means = _score(row["L4"].values() for row in rows), _score([row["L3"]["same_shape"]] for row in rows)
        lines.append(Line(what, (str(len(rows)), *of_tasks, *means)))
    columns = ("", "seeds", *tasks, "mean of L4", "same_shape, L3")
    return markdown([Table("attributes", "", columns, tuple(lines))])


def _score(outcomes: Iterable[Iterable[str]]) -> Estimate:
    """Return the mean success of the tasks of each seed."""
    score = mean_over_seeds([[(bits.count("1"), len(bits)) for bits in tasks] for tasks in outcomes])
    return Estimate(score.mean, score.interval)


def _outcomes(bits: str, others: str) -> list[tuple[bool, bool]]:
    return [(one == "1", other == "1") for one, other in zip(bits, others, strict=True)]


if __name__ == "__main__":
    raise SystemExit(main())
