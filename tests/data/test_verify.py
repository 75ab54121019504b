"""Verification beyond checksums, and replayed episodes."""

import dataclasses
import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from openvima.cli.main import main
from openvima.data import (
    Dataset,
    Demonstration,
    GenerateConfig,
    Shard,
    ShardWriter,
    VerifyConfig,
    generate,
    verify,
)
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import MANIFEST_NAME, finish_folder
from openvima.data.verification import Verification
from openvima.errors import DatasetError
from openvima.scene import Action
from small_data_sets import TASKS, contents, finish, with_plain_images, write_folder

MadeUp = Callable[..., Demonstration]
FIRST = "rotate-train-00000.arrow"
ALL, NONE = VerifyConfig(replay=None), VerifyConfig(replay=0)


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "demos")


def causes(found: Verification) -> dict[str, list[str]]:
    result: dict[str, list[str]] = {}
    for problem in found.problems:
        result.setdefault(problem.file, []).append(problem.cause)
    return result


def rewrite(folder: Path, name: str, change: Callable[[Demonstration], Demonstration]) -> None:
    """Write a shard and then the folder anew as if the oracle had done something else."""
    shard = Shard(folder / name)
    demos = [change(shard[row]) for row in range(len(shard))]
    manifest = Dataset(folder).manifest
    with ShardWriter(folder / name, shard.info) as writer:
        for demo in demos:
            writer.write(demo)
    origin = {key: manifest[key] for key in ("command", "config", "versions", "licence")}
    finish_folder(folder, sorted(folder.glob("*.arrow")), **origin)


def test_a_generated_data_set_is_clean_and_replays(whole: Path) -> None:
    calls = []
    found = verify(whole, ALL, lambda *call: calls.append(call))
    assert found.is_clean, found.problems
    assert found.notes == ()
    assert (found.num_shards, found.num_episodes, found.num_replayed) == (4, 6, 6)
    assert calls[-1] == (6, 6, "replaying")


def test_what_killed_writers_left_is_noted_and_what_the_manifest_does_not_list_is_none(folder: Path) -> None:
    (folder / ".rotate-train-00000.arrow.17.tmp").write_bytes(b"half")
    found = verify(folder, NONE)
    assert found.is_clean
    assert ".rotate-train-00000.arrow.17.tmp: a process was killed" in found.notes[0]
    shutil.copy(folder / FIRST, folder / "rotate-train-00009.arrow")
    assert causes(verify(folder, NONE)) == {"rotate-train-00009.arrow": ["the manifest does not list it"]}


def test_an_edited_manifest_is_refused(folder: Path) -> None:
    path = folder / MANIFEST_NAME
    manifest = json.loads(path.read_text(encoding="utf-8"))
    manifest["config"]["start_seed"] += 1
    path.write_text(json.dumps(manifest), encoding="utf-8")
    assert causes(verify(folder, NONE)) == {
        MANIFEST_NAME: ["it is damaged or was edited (its checksum is wrong)"]
    }
    with pytest.raises(DatasetError, match="was edited"):
        Dataset(folder)


def test_a_content_hash_that_is_not_that_of_the_content_is_found(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo
) -> None:
    write_folder(tmp_path, info, [[with_plain_images(made_up(seed)) for seed in (1, 2)]])
    path = tmp_path / "stack-train-00000.arrow"
    first, second = (Shard(path).batch(row) for row in (0, 1))
    place = second.schema.get_field_index("content_hash")
    forged = second.set_column(place, second.schema.field(place), pa.array(["0" * 32]))
    with ShardWriter(path, info) as writer:
        writer.copy(first)
        writer.copy(forged)
    finish(tmp_path, info)
    cause = "its content hash is not that of its content (1 of 2 records, first 1)"
    assert causes(verify(tmp_path, NONE)) == {"stack-train-00000.arrow": [cause]}


def _with_a_pixel_changed(demo: Demonstration) -> Demonstration:
    rgb = {view: images.copy() for view, images in demo.rgb.items()}
    rgb["top"][1, 0, 5, 5] ^= 1
    return dataclasses.replace(demo, rgb=rgb)


def _with_an_object_moved(demo: Demonstration) -> Demonstration:
    scene = demo.scenes[-1]
    placement = scene.placements[0]
    pose = dataclasses.replace(placement.pose, position=(0.5, 0.0, 0.0))
    return dataclasses.replace(demo, scenes=(*demo.scenes[:-1], scene.with_poses({placement.id: pose})))


def _with_another_action(demo: Demonstration) -> Demonstration:
    return dataclasses.replace(demo, actions=(Action.planar((0.3, 0.1), (0.6, -0.2)),) * demo.num_steps)


def _with_another_path(demo: Demonstration) -> Demonstration:
    first, *rest = demo.joint_paths
    return dataclasses.replace(demo, joint_paths=(first + np.float32(1e-6), *rest))


@pytest.mark.parametrize(
    ("change", "columns"),
    [
        (_with_a_pixel_changed, "rgb_top"),
        (_with_an_object_moved, "poses"),
        (_with_another_path, "joint_paths"),
        (_with_another_action, "pose0_position, pose1_position, pose1_rotation"),
        (lambda demo: dataclasses.replace(demo, num_redraws=9), "redraws"),
        (
            lambda demo: dataclasses.replace(demo, prompt=dataclasses.replace(demo.prompt, text="Do it.")),
            "prompt",
        ),
    ],
)
def test_replaying_names_the_columns_that_differ(
    folder: Path, change: Callable[[Demonstration], Demonstration], columns: str
) -> None:
    rewrite(folder, FIRST, change)
    found = causes(verify(folder, ALL))
    assert [text for text in found[FIRST] if text.startswith("replayed")] == [
        f"replayed, it differs in {columns} (2 of 2 records, first 0)"
    ]


def test_what_other_versions_wrote_is_compared_and_noted(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewrite(folder, FIRST, _with_another_path)
    monkeypatch.setattr(
        "openvima.data.verification.package_versions", lambda: {"openvima": "9", "pyarrow": "1"}
    )
    found = verify(folder, ALL)
    assert found.is_clean
    assert "installed are openvima 9, pyarrow 1. Only equal versions promise equal" in found.notes[0]
    assert "written by other versions: replayed, it differs in joint_paths" in found.notes[1]


def test_imported_episodes_are_not_replayed(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> None:
    info = dataclasses.replace(info, domain="published")
    demo = dataclasses.replace(with_plain_images(made_up()), domain="published", joint_paths=(), scenes=())
    found = verify(write_folder(tmp_path, info, [[demo]]), ALL)
    assert found.is_clean, found.problems
    assert found.num_replayed == 0
    assert found.notes == ("Imported episodes cannot be replayed.",)


def test_a_task_that_is_not_installed_is_noted(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> None:
    found = verify(write_folder(tmp_path, info, [[with_plain_images(made_up())]]), ALL)
    assert found.is_clean
    assert "there is no task 'stack'" in found.notes[1]


def test_every_task_replays(tmp_path: Path) -> None:
    found = verify(generate(GenerateConfig(out=tmp_path, episodes=1)), ALL)
    assert found.is_clean, found.problems
    assert found.num_replayed == found.num_episodes >= 13


def test_the_command_names_problems_and_exits_with_1_if_there_are_any(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["data", "verify", str(folder), "--replay", "1"]) == 0
    shown = capsys.readouterr().out
    assert "4 shards, 6 episodes compared with their hashes, 2 replayed" in shown
    assert "no problems" in shown
    (folder / FIRST).unlink()
    assert main(["data", "verify", str(folder), "--replay", "0"]) == 1
    shown = capsys.readouterr().out
    assert f"{FIRST}: it is missing" in shown
    assert f"`openvima generate --out {folder} --tasks {','.join(TASKS)} --episodes 3" in shown
    assert main(["data", "verify", str(folder), "--replay", "0", "--json"]) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["clean"] is False
    assert record["problems"][0]["file"] == FIRST


@pytest.mark.parametrize("name", [FIRST, "index.parquet", "dataset.json"])
def test_the_command_that_is_named_makes_a_damaged_file_again(folder: Path, whole: Path, name: str) -> None:
    (folder / name).write_bytes((whole / name).read_bytes()[:-9])
    remedies = {problem.remedy for problem in verify(folder, NONE).problems if problem.file == name}
    (folder / name).unlink()
    if name != "dataset.json":  # which alone holds the settings
        (command,) = (re.findall(r"Delete it and make it again: `(.*)`", remedy)[0] for remedy in remedies)
    else:
        command = f"openvima generate --out {folder} --tasks {','.join(TASKS)} --episodes 3 --shard-size 2"
    assert main(shlex.split(command)[1:]) == 0
    assert contents(folder) == contents(whole)
