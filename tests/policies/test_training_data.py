"""Appearance statistics by task and role, the leakage check, and the data of the bundled checkpoint."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

import openvima
from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, pool, tasks_at
from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.manifest import MANIFEST_NAME
from openvima.errors import ConfigError
from openvima.scene import ObjectImage, Placement, SceneImage
from openvima.tasks import sample_episode
from small_data_sets import seeds_of
from training_data import (
    ROLES,
    appearance_record,
    appearance_text,
    appearances_of,
    find_leaks,
    main,
    training_appearances,
)

FOLDER = Path(openvima.__file__).parent / "policies" / "trained" / "openvima-small"
RECORD = json.loads((FOLDER / "training_data.json").read_text(encoding="utf-8"))
TASKS = tasks_at("train")
GENERATED = ("rearrange", "visual_manipulation", "novel_noun", "sweep_without_exceeding")
NOVEL_SHAPES = {*OBJECT_SETS["D_novel"], *OBJECT_SETS["B_novel"]}


def appearances(task: str, role: str) -> frozenset[tuple[str, str]]:
    roles = RECORD["tasks"][task]["roles"]
    return appearances_of(roles[role]) if role in roles else frozenset()


def placements_of(image: ObjectImage | SceneImage) -> tuple[Placement, ...]:
    return image.scene.placements if isinstance(image, SceneImage) else (image.placement,)


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


def test_it_saw_no_novel_shape_and_what_l2_combines_was_neither_dragged_nor_a_base() -> None:
    for task in TASKS:
        swapped = pool(task, "L2")
        assert not {texture for _, texture in appearances(task, "dragged")} & set(swapped.dragged_textures)
        assert not {texture for _, texture in appearances(task, "base")} & set(swapped.base_textures)
        for role in RECORD["tasks"][task]["roles"]:  # on the table or in prompts
            assert not {name for name, _ in appearances(task, role)} & NOVEL_SHAPES


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


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(GenerateConfig(out=tmp_path_factory.mktemp("demos"), tasks=GENERATED, episodes=6))


@pytest.fixture(scope="module")
def record(demos: Path) -> dict[str, Any]:
    return appearance_record(Dataset(demos))


def test_every_object_and_every_prompt_image_is_in_the_table(demos: Path, record: dict[str, Any]) -> None:
    dataset = Dataset(demos)
    shown = dict.fromkeys(GENERATED, 0)
    for demo in dataset:
        roles = record["tasks"][demo.task]["roles"]
        on_table = frozenset().union(*(appearances_of(roles[role]) for role in roles if role != "prompted"))
        assert {(part.object, part.texture) for part in demo.objects} <= on_table
        shown[demo.task] += len(demo.objects)
        for image in demo.prompt.images.values():
            assert {(part.object, part.texture) for part in image.objects} <= appearances_of(
                roles["prompted"]
            )
    for task, number in shown.items():
        roles = record["tasks"][task]["roles"]
        assert sum(roles[role]["count"] for role in roles if role != "prompted") == number
        assert set(roles) <= set(ROLES)


def test_what_the_oracle_picks_is_dragged_or_a_distractor(demos: Path, record: dict[str, Any]) -> None:
    for demo in Dataset(demos):
        roles = record["tasks"][demo.task]["roles"]
        appearance = {part.object_id: (part.object, part.texture) for part in demo.objects}
        for pick, place in zip(demo.pick_ids, demo.place_ids, strict=True):
            distractors = appearances_of(roles["distractor"]) if demo.task == "rearrange" else set()
            assert appearance[pick] in appearances_of(roles["dragged"]) | distractors
            assert place == -1 or appearance[place] in appearances_of(roles["base"])


def test_the_table_names_its_data_and_survives_a_file(demos: Path, record: dict[str, Any]) -> None:
    manifest = json.loads((demos / MANIFEST_NAME).read_text())
    assert record["manifest"]["content_hash"] == manifest["content_hash"]
    assert record["manifest"]["index"] == manifest["index"]
    assert json.loads(appearance_text(record)) == record
    for task, entry in record["tasks"].items():
        rows = [row for row in Dataset(demos).index.to_pylist() if row["task"] == task]
        assert seeds_of(entry) == sorted(row["seed"] for row in rows)
        assert entry["steps"] == sum(row["steps"] for row in rows)


def test_demonstrations_for_training_keep_to_their_partition(record: dict[str, Any]) -> None:
    assert find_leaks(record) == []


@pytest.mark.parametrize(
    ("task", "role", "appearance"),
    [
        ("visual_manipulation", "dragged", ("letter R", "red")),  # a novel object
        ("visual_manipulation", "dragged", ("letter A", "brick")),  # a novel texture
        ("visual_manipulation", "dragged", ("letter A", "blue")),  # as L2 combines them
        ("visual_manipulation", "base", ("bowl", "red")),
        ("visual_manipulation", "base", ("pan", "blue")),
        ("visual_manipulation", "distractor", ("letter A", "brick")),
        ("visual_manipulation", "prompted", ("letter A", "gray")),
        ("rotate", "other_movable", ("letter A", "blue")),
        ("rearrange", "dragged", ("letter A", "brick")),
        ("rearrange", "distractor", ("star", "red")),
    ],
)
def test_appearances_outside_the_partition_are_named(task: str, role: str, appearance: tuple) -> None:
    changed = deepcopy(RECORD)
    roles = changed["tasks"][task]["roles"]
    roles.setdefault(role, {"appearances": []})["appearances"].append(
        {"objects": [appearance[0]], "textures": [appearance[1]]}
    )
    assert find_leaks(changed) == [f"{task} shows {appearance[0]!r} in {appearance[1]!r} as {role}."]


def test_other_tasks_and_levels_are_named() -> None:
    changed = deepcopy(RECORD)
    changed["tasks"]["follow_motion"] = changed["tasks"]["rearrange"]
    changed["tasks"]["rearrange"] = {**changed["tasks"]["rearrange"], "levels": ["L1", "train"]}
    problems = find_leaks(changed)
    assert "follow_motion is none of the training tasks." in problems
    assert "rearrange has episodes of level L1." in problems
    with pytest.raises(ConfigError):
        training_appearances("follow_motion")


def test_only_distractors_of_rearrangements_have_all_textures() -> None:
    everything = set(TEXTURE_SETS["T"])
    for task in ("rearrange", "twist", "visual_manipulation"):
        for role, appearances in training_appearances(task).items():
            has_all = {texture for _, texture in appearances} >= everything
            assert has_all == (task == "rearrange" and role == "distractor")


def test_the_script_writes_the_statistics_and_names_leaks(
    demos: Path, record: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "training_data.json"
    main(str(demos), str(file))
    assert json.loads(file.read_text()) == record
    assert "everything is inside the training partition" in capsys.readouterr().out
    novel = generate(GenerateConfig(out=tmp_path / "novel", tasks=("rotate",), level="L3", episodes=2))
    main(str(novel), str(file))
    assert "rotate shows 'letter R'" in capsys.readouterr().out
