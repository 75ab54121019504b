"""Training data of the bundled checkpoint: appearance statistics, partitions and generator."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

import openvima
from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, pool, tasks_at
from openvima.scene import ObjectImage, Placement, SceneImage
from openvima.tasks import sample_episode
from openvima.tasks.sampling import make_rng
from small_data_sets import seeds_of
from training_data import appearances_of, find_leaks

FOLDER = Path(openvima.__file__).parent / "policies" / "trained" / "openvima-small"
RECORD = json.loads((FOLDER / "training_data.json").read_text(encoding="utf-8"))
TASKS = tasks_at("train")
NOVEL_SHAPES = {*OBJECT_SETS["D_novel"], *OBJECT_SETS["B_novel"]}


def appearances(task: str, role: str) -> frozenset[tuple[str, str]]:
    roles = RECORD["tasks"][task]["roles"]
    return appearances_of(roles[role]) if role in roles else frozenset()


def training_pairs(task: str) -> frozenset[tuple[str, str]]:
    """On the table or in prompts."""
    return frozenset().union(*(appearances(task, role) for role in RECORD["tasks"][task]["roles"]))


def placements_of(image: ObjectImage | SceneImage) -> tuple[Placement, ...]:
    return image.scene.placements if isinstance(image, SceneImage) else (image.placement,)


def with_appearance(task: str, role: str, *appearance: str) -> dict[str, Any]:
    changed = deepcopy(RECORD)
    changed["tasks"][task]["roles"][role]["appearances"].append(
        {"objects": [appearance[0]], "textures": [appearance[1]]}
    )
    return changed


def test_it_learnt_the_training_tasks_at_the_training_level_and_nothing_else() -> None:
    assert set(RECORD["tasks"]) == set(TASKS)
    assert not set(RECORD["tasks"]) & set(tasks_at("L4"))
    for entry in RECORD["tasks"].values():
        assert (entry["levels"], entry["domains"]) == (["train"], ["train"])
        assert len(seeds_of(entry)) == entry["episodes"]
    config = RECORD["manifest"]["config"]
    assert (config["level"], config["domain"], config["assets"]) == ("train", "train", "procedural")
    for count in ("episodes", "steps"):
        assert sum(entry[count] for entry in RECORD["tasks"].values()) == RECORD["manifest"]["counts"][count]


def test_all_that_it_saw_is_from_the_training_partition() -> None:
    assert find_leaks(RECORD) == []


def test_a_novel_appearance_among_its_data_would_be_noticed() -> None:
    for task, role, name, texture in (
        ("rotate", "dragged", "letter A", "brick"),
        ("rotate", "dragged", "letter R", "red"),
        ("rotate", "other_movable", "letter A", "blue"),  # L2 shows it
        ("same_shape", "base", "pan", "blue"),
        ("same_shape", "base", "bowl", "red"),  # so does this
        ("rearrange", "dragged", "letter A", "brick"),
        ("rearrange", "distractor", "star", "red"),
        ("twist", "prompted", "letter A", "brick"),
    ):
        problem = f"{task} shows {name!r} in {texture!r} as {role}."
        assert find_leaks(with_appearance(task, role, name, texture)) == [problem]
    levels = deepcopy(RECORD)
    levels["tasks"]["rotate"]["levels"].append("L3")
    assert find_leaks(levels) == ["rotate has episodes of level L3."]


@pytest.mark.parametrize("task", TASKS)
def test_what_l2_combines_was_neither_dragged_nor_a_base(task: str) -> None:
    swapped = pool(task, "L2")
    assert not {texture for _, texture in appearances(task, "dragged")} & set(swapped.dragged_textures)
    assert not {texture for _, texture in appearances(task, "base")} & set(swapped.base_textures)


@pytest.mark.parametrize("task", TASKS)
def test_it_saw_no_novel_shape_in_any_role(task: str) -> None:
    assert not {name for name, _ in training_pairs(task)} & NOVEL_SHAPES


def test_novel_textures_are_only_on_distractors_of_rearrangements_as_the_benchmark_has_them() -> None:
    known = {texture for task in TASKS for texture in pool(task, "train").dragged_textures}
    known |= {texture for task in TASKS for texture in pool(task, "train").base_textures} | {"gray"}
    places = {
        (task, role)
        for task in TASKS
        for role in RECORD["tasks"][task]["roles"]
        if {texture for _, texture in appearances(task, role)} - known
    }
    assert places == {("rearrange", "distractor"), ("rearrange_then_restore", "distractor")}
    assert len(set(TEXTURE_SETS["T"]) - known) == 10


@pytest.mark.parametrize("task", TASKS)
def test_the_table_speaks_of_what_the_generator_makes(task: str) -> None:
    seeds = seeds_of(RECORD["tasks"][task])
    for seed in (seeds[0], seeds[len(seeds) // 2], seeds[-1]):
        problem = sample_episode(task, level="train", domain="train", seed=seed).problem
        free = [part for part in problem.scene.placements if not part.fixed]
        fixed = [part for part in problem.scene.placements if part.fixed]
        shown = [part for _, image in problem.prompt.images for part in placements_of(image)]
        for parts, roles in (
            (free, ("dragged", "distractor", "other_movable")),
            (fixed, ("base", "other_fixed")),
            (shown, ("prompted",)),
        ):
            known = frozenset().union(*(appearances(task, role) for role in roles))
            assert {(part.object, part.texture) for part in parts} <= known


@pytest.mark.parametrize("task", TASKS)
def test_episodes_of_evaluation_are_others_even_for_equal_seeds(task: str) -> None:
    seed = seeds_of(RECORD["tasks"][task])[0]
    trained = sample_episode(task, level="train", domain="train", seed=seed).problem.scene.placements
    drawn = [make_rng("train", task, "train", seed, "scene").integers(2**62)]
    for level in ("L1", "L2"):
        scored = sample_episode(task, level=level, domain="eval", seed=seed).problem.scene.placements
        assert scored != trained
        drawn.append(make_rng("eval", task, level, seed, "scene").integers(2**62))
    assert len(set(drawn)) == len(drawn)
    assert RECORD["tasks"][task]["domains"] == ["train"]
