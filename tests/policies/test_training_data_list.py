"""Appearance statistics by task and role, and the leakage check."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from openvima.catalog import TEXTURE_SETS
from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.manifest import MANIFEST_NAME
from openvima.errors import ConfigError
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

TASKS = ("rearrange", "visual_manipulation", "novel_noun", "sweep_without_exceeding")


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(GenerateConfig(out=tmp_path_factory.mktemp("demos"), tasks=TASKS, episodes=6))


@pytest.fixture(scope="module")
def record(demos: Path) -> dict[str, Any]:
    return appearance_record(Dataset(demos))


def test_every_object_and_every_prompt_image_is_in_the_table(demos: Path, record: dict[str, Any]) -> None:
    dataset = Dataset(demos)
    shown = dict.fromkeys(TASKS, 0)
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
    ("role", "appearance"),
    [
        ("dragged", ("letter R", "red")),  # a novel object
        ("dragged", ("letter A", "brick")),  # a novel texture
        ("dragged", ("letter A", "blue")),  # as L2 combines them
        ("base", ("bowl", "red")),
        ("base", ("pan", "blue")),
        ("distractor", ("letter A", "brick")),
        ("prompted", ("letter A", "gray")),
    ],
)
def test_appearances_outside_the_partition_are_named(
    record: dict[str, Any], role: str, appearance: tuple[str, str]
) -> None:
    changed = deepcopy(record)
    roles = changed["tasks"]["visual_manipulation"]["roles"]
    roles.setdefault(role, {"appearances": []})["appearances"].append(
        {"objects": [appearance[0]], "textures": [appearance[1]]}
    )
    assert find_leaks(changed) == [
        f"visual_manipulation shows {appearance[0]!r} in {appearance[1]!r} as {role}."
    ]


def test_other_tasks_and_levels_are_named(record: dict[str, Any]) -> None:
    changed = deepcopy(record)
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
