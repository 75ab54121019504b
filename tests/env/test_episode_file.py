"""Episodes as files: nothing is lost, and what is hostile is refused."""

import os
import random
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from PIL import Image

import openvima
from openvima.errors import InputFileError, OpenVimaError
from openvima.scene import Scene
from openvima.tasks import list_tasks, sample_episode, task_spec

HAND_WRITTEN = """
prompt: Put the {photo} into the {bowl}.
objects:
  block: [block, red, [0.5, -0.2]]
  bowl: {object: bowl, texture: green, position: [0.5, 0.2]}
images: {photo: block.png}
goals:
  - [in, block, bowl]
"""


class AnywhereGoal:
    def is_met(self, scene: Scene) -> bool:
        return True


@pytest.mark.parametrize("task", list_tasks())
def test_a_sampled_episode_is_equal_after_saving_and_loading(task: str, tmp_path: Path) -> None:
    episode = sample_episode(task, level=task_spec(task).levels[-1], seed=1)
    for suffix in (".yaml", ".json"):
        assert openvima.load_episode(openvima.save_episode(episode, tmp_path / f"e{suffix}")) == episode


def test_a_composed_episode_with_all_kinds_of_images_survives(tmp_path: Path) -> None:
    Image.new("RGB", (80, 50), "red").save(tmp_path / "block.png")
    (tmp_path / "scene.yaml").write_text(HAND_WRITTEN, encoding="utf-8")
    episode = openvima.load_episode(tmp_path / "scene.yaml")
    again = openvima.save_episode(episode, tmp_path / "elsewhere" / "saved.json")
    assert openvima.load_episode(again) == episode  # with the photo


def test_reset_takes_episodes_files_and_values(tmp_path: Path) -> None:
    env = openvima.TabletopEnv("rotate")
    values = {"objects": [["heart", "red", [0.5, 0.0]]], "prompt": "Lift the {a}."}
    path = openvima.save_episode(openvima.compose(**values), tmp_path / "scene.json")
    for given in (openvima.compose(**values), path, str(path), values):
        _, info = env.reset(options={"episode": given})
        assert (info["task"], info["prompt"]) == ("composed", "Lift the {a}.")
    with pytest.raises(InputFileError, match="needs an episode file"):
        env.reset(options={"episode": {**values, "images": {"a": "x.png"}}})


def test_goals_of_ones_own_cannot_be_saved(tmp_path: Path) -> None:
    episode = openvima.compose([("heart", "red", (0.5, 0.0))], "Look.", goals=[AnywhereGoal()])
    with pytest.raises(
        InputFileError, match="AnywhereGoal cannot be saved in a file; allowed are AtPose, InZone"
    ):
        openvima.save_episode(episode, tmp_path / "scene.yaml")
    with pytest.raises(InputFileError, match=r"must end in \.yaml, \.yml, \.json"):
        openvima.save_episode(episode, tmp_path / "scene.txt")


def prompted(text: str):
    episode = sample_episode("rotate", seed=1)
    prompt = replace(episode.problem.prompt, text=episode.problem.prompt.text + text)
    return replace(episode, problem=replace(episode.problem, prompt=prompt))


TEXTS = (
    *(
        "\u202f",
        "\u3000",
        "\U0001f468\u200d\U0001f469",
        "\u200c\u200f\u2066",
        "\ufeff",
        "\xad",
        "\u2028\u2029",
    ),
    *(
        "\n",
        "\t",
        " \n  two\n\n",
        "  ",
        ": #x",
        "'\"",
        "\ue000",
        "\ufffe",
        "\U0001fae9",
        "é\u0301",
        "null",
        "- a",
    ),
)


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_any_text_is_equal_after_saving_and_loading(suffix: str, tmp_path: Path) -> None:
    for text in (*TEXTS, "".join(TEXTS), " ".join(TEXTS) * 5):
        episode = prompted(text)
        loaded = openvima.load_episode(openvima.save_episode(episode, tmp_path / f"e{suffix}"))
        assert loaded == episode, repr(text)


@pytest.mark.parametrize(
    "content",
    [
        b"a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]\n" + HAND_WRITTEN.encode(),
        HAND_WRITTEN.replace("prompt:", "prompt: !!python/object/apply:os.system ['true']\nother:").encode(),
        (HAND_WRITTEN + "deep: " + "[" * 1500 + "]" * 1500).encode(),
        HAND_WRITTEN[: len(HAND_WRITTEN) // 3].encode(),
        HAND_WRITTEN.encode("utf-16"),
        HAND_WRITTEN.encode() + b"\n# " + b"x" * 2**20,
        b"",
        HAND_WRITTEN.encode() + b"\n---\n" + HAND_WRITTEN.encode(),
        (HAND_WRITTEN + "? [1, 2]\n: 3\n").encode(),
        (HAND_WRITTEN + "2020-01-01: 3\n").encode(),
        random.Random(5).randbytes(2000),
    ],
)
def test_files_that_are_no_episodes_are_refused(tmp_path: Path, content: bytes) -> None:
    assert_refused(tmp_path, content)


@pytest.mark.parametrize("wrong", [float("nan"), 1e308, 10**30, "x" * 5000, {"x": 1}, [[0.0] * 9] * 300])
def test_episodes_with_an_impossible_value_are_refused(tmp_path: Path, wrong: object) -> None:
    for *path, last in (
        ("seed",),
        ("max_steps",),
        ("problem", "scene", "placements", 0, "pose", "position"),
        ("problem", "scene", "placements", 0, "object"),
        ("problem", "scene", "placements", 0, "import"),
    ):
        saved = openvima.save_episode(sample_episode("follow_motion", seed=0), tmp_path / "saved.yaml")
        values = holder = yaml.safe_load(saved.read_text(encoding="utf-8"))
        for key in path:
            holder = holder[key]
        holder[last] = wrong
        assert_refused(tmp_path, yaml.safe_dump(values).encode())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../outside.png", "inside the folder"),
        ("link.png", "inside the folder"),
        ("/dev/zero.png", "inside the folder"),
        ("pipe.png", ""),
        ("folder.png", ""),
        ("cut.png", ""),
    ],
)
def test_photos_that_must_not_be_read_are_refused(tmp_path: Path, name: str, message: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    Image.new("RGB", (9, 9), "red").save(tmp_path / "outside.png")
    (inside / "link.png").symlink_to(tmp_path / "outside.png")
    os.mkfifo(inside / "pipe.png")
    (inside / "folder.png").mkdir()
    (inside / "cut.png").write_bytes((tmp_path / "outside.png").read_bytes()[:40])
    error = assert_refused(inside, HAND_WRITTEN.replace("block.png", name).encode())
    assert "scene.yaml: image 'photo': " in error and message in error


def assert_refused(folder: Path, content: bytes) -> str:
    Image.new("RGB", (9, 9), "red").save(folder / "block.png")
    path = folder / "scene.yaml"
    path.write_bytes(content)
    with pytest.raises(OpenVimaError) as caught:
        openvima.load_episode(path)
    assert len(str(caught.value)) < 1000 and "\n" not in str(caught.value)
    return str(caught.value)
