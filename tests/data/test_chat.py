"""Chats with vision-language models: messages, points, answers, and conversations for fine-tuning."""

import importlib.util
import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.chat import UNREADABLE, ChatFormat, demo_turns, encode_picture, family_of
from openvima.data.chat_export import export_chat
from openvima.data.chat_settings import POINTS
from openvima.env import EnvConfig
from openvima.errors import AnswerError, DatasetError
from openvima.perception.objects import GROUND_TRUTH
from openvima.scene import Action
from openvima.tasks import list_tasks, task_spec

FORM = ChatFormat()
CELLS = [(task, level) for level in ("L1", "L2", "L3", "L4") for task in list_tasks()
         if level in task_spec(task).levels]  # fmt: skip


def make_env(task: str, level: str = "L1"):
    return EnvConfig().make(task, level, domain="eval")


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(BytesIO(png)))


def test_images_stand_where_the_sentence_has_them() -> None:
    env = make_env("visual_manipulation")
    observation, _ = env.reset(seed=0)
    parts = FORM.first_turn(env.prompt, observation).parts
    kinds = "".join("t" if isinstance(part, str) else "i" for part in parts)
    assert kinds == "titititt".replace("tt", "t")
    assert parts[0].endswith("Put the") and parts[2] == "into the" and parts[4].startswith(".")
    assert parts[4].endswith("seen from above:")
    assert pixels(parts[5]).shape == (512, 1024, 3)
    assert np.array_equal(pixels(parts[5])[::4, ::4], np.moveaxis(observation["rgb"]["top"], 0, -1))
    assert all(pixels(parts[n]).shape[1] < 512 for n in (1, 3))  # crops of the objects


def test_scenes_of_a_prompt_stay_whole_and_both_views_can_be_shown() -> None:
    env = make_env("rearrange")
    observation, _ = env.reset(seed=0)
    parts = ChatFormat(view="front+top", enlarge=2).first_turn(env.prompt, observation).parts
    shapes = [pixels(part).shape for part in parts if isinstance(part, bytes)]
    assert shapes == [(256, 512, 3)] * 3
    assert "first of these pictures" in parts[-1]


@pytest.mark.parametrize("enlarge", [1, 3])
def test_pictures_are_enlarged_without_smoothing(enlarge: int) -> None:
    rgb = np.random.default_rng(0).integers(256, size=(3, 5, 7), dtype=np.uint8)
    large = np.moveaxis(rgb, 0, -1).repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    assert np.array_equal(pixels(encode_picture(rgb, enlarge)), large)


@pytest.mark.parametrize("points", POINTS)
@pytest.mark.parametrize("view", ["top", "front"])
def test_an_answer_is_read_as_it_was_written(points: str, view: str) -> None:
    form = ChatFormat(points, view)  # type: ignore[arg-type]
    action = Action.planar((0.31, -0.42), (0.68, 0.2), np.deg2rad(-60))
    read = form.read_answer(form.answer(action, "suction"), "suction")
    assert np.allclose(read.pose0_position, action.pose0_position, atol=2.1e-3)
    assert np.allclose(read.pose1_position, action.pose1_position, atol=2.1e-3)
    assert np.isclose(read.yaw1_rad, action.yaw1_rad, atol=1e-2)
    assert json.loads(form.answer(action, "suction"))["rotate"] == 60  # clockwise, as prompts count


def test_conventions_differ_in_scale_and_order() -> None:
    action = Action.planar((0.5, 0.25), (0.5, 0.25))
    written = {points: json.loads(ChatFormat(points).answer(action, "spatula"))["from"] for points in POINTS}
    x, y = written["1000-xy"]
    assert 740 < x < 750 and 490 < y < 510
    assert written["1000-yx"] == [y, x]
    assert written["1-xy"] == pytest.approx([x / 1000, y / 1000], abs=1e-3)
    assert written["pixels-yx"] == pytest.approx([y * 0.512, x * 1.024], abs=1)


def test_the_last_object_of_an_answer_counts() -> None:
    text = 'First {"pick": [1, 2]} seemed right. {"pick": [10, 10], "place": [20, 20], "rotate": 0}\n'
    text += '```json\n{"pick": [400, 500], "place": [600, 500]}\n```'
    action = FORM.read_answer(text, "suction")
    assert FORM.point(action.pose0_position) == [400, 500] and action.yaw1_rad == 0


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "it is empty"),
        ("<html><body>502</body></html>", "no JSON"),
        ('{"pick": [1, 2]}', "no JSON with pick and place"),
        ('{"pick": [NaN, 2], "place": [1, 2]}', "a point is not two numbers"),
        ('{"pick": [1e400, 2], "place": [1, 2]}', "a point is not two numbers"),
        ('{"pick": [' + "9" * 400 + ', 2], "place": [1, 2]}', "a point is not two numbers"),
        ('{"pick": [' + "9" * 5000 + ', 2], "place": [1, 2]}', "no JSON"),
        ('{"pick": [true, 2], "place": [1, 2]}', "a point is not two numbers"),
        ('{"pick": "1, 2", "place": [1, 2]}', "a point is not two numbers"),
        ('{"pick": [1500, 2], "place": [1, 2]}', "a point beside the picture"),
        ('{"pick": [-1, 2], "place": [1, 2]}', "a point beside the picture"),
        ('{"pick": [1, 2], "place": [1, 2], "rotate": "left"}', "rotate is no number"),
        ('{"pick": [\u0661\u0662, 2], "place": [1, 2]}', "no JSON"),
        ('{"pick": ' * 5000, "no JSON"),
        ("{" * 10_000_000, "no JSON"),
        ("\x00\x1b[2J\ud800", "no JSON"),
    ],
)
def test_what_holds_no_action_is_said_to(text: str, why: str) -> None:
    with pytest.raises(AnswerError, match=why) as caught:
        FORM.read_answer(text, "suction")
    assert caught.value.kind.startswith(UNREADABLE) and str(caught.value).isprintable()


def test_boxes_are_those_of_the_view() -> None:
    env = make_env("visual_manipulation")
    observation, _ = env.reset(seed=0)
    text = FORM.first_turn(env.prompt, observation, GROUND_TRUTH).parts[-1]
    listed = [
        json.loads(f"[{box}]") for box in text.partition("bottom]: [")[2].partition("].")[0].split("], [")
    ]
    segm = observation["segm"]["top"]
    ids = [i for i in np.unique(segm) if 5 <= i < 255]
    assert len(listed) == len(ids)
    for left, top, right, bottom in listed:
        inside = segm[int(top * 0.128) : int(bottom * 0.128) + 1, int(left * 0.256) : int(right * 0.256) + 1]
        assert np.isin(inside, ids).any()


def test_families_point_in_their_way() -> None:
    found = {name: family_of(name).points for name in (
        "Qwen/Qwen3-VL-8B-Instruct", "Qwen/Qwen2.5-VL-7B-Instruct", "gemini-3-flash", "gpt-5", "mine",
        "OpenGVLab/InternVL3-8B", "llava-1.5-7b")}  # fmt: skip
    assert [*found.values()] == ["1000-xy", "pixels-xy", "1000-yx", "pixels-xy", "1000-xy", "1000-xy", "1-xy"]
    assert family_of("qwen2.5-vl").image_tokens(1792, 896) == 2048


@pytest.mark.parametrize(
    ("task", "form"),
    [("twist", ChatFormat()), ("sweep_without_exceeding", ChatFormat("pixels-yx", "front", 1))],
    ids=str,
)
def test_rounded_answers_of_the_oracle_solve_the_task(task: str, form: ChatFormat) -> None:
    assert solved_by_answers([(task, "L1")], form, episodes=2) == 2


@pytest.mark.slow
def test_rounding_costs_less_than_a_hundredth_of_the_episodes() -> None:
    assert solved_by_answers(CELLS, ChatFormat(), episodes=8) >= 0.99 * 8 * len(CELLS)


def solved_by_answers(cells: list[tuple[str, str]], form: ChatFormat, episodes: int) -> int:
    """Count the episodes that the oracle's answers solve, once they were written and read."""
    solved = 0
    for task, level in cells:
        env = make_env(task, level)
        env.modalities = ("joints",)  # nothing is rendered
        for seed in range(episodes):
            env.reset(seed=seed)
            tool, answers = env.scene.end_effector, []
            while not env.outcome.is_over:
                decision = env.oracle_decision()
                answers.append(form.answer(decision.action, tool))
                env.advance(decision.action)
            env.reset(seed=seed)
            for answer in answers:
                if not env.outcome.is_over:
                    env.advance(form.read_answer(answer, tool))
            solved += env.outcome.success
    return solved


EXPERIMENT = Path(__file__).parents[2] / "experiments" / "vlm" / "closed_loop.py"
EXPORTED = ChatFormat("1000-yx", enlarge=2)


@pytest.fixture(scope="module")
def conversed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos") / "demos"
    generate(GenerateConfig(tasks=("pick_in_order_then_restore", "rotate"), episodes=2, out=out))
    return out


@pytest.fixture(scope="module")
def chats(conversed: Path) -> Path:
    return export_chat(conversed, conversed.parent / "chats", form=EXPORTED, questions=3)


def examples(folder: Path) -> Iterator[dict[str, Any]]:
    return map(json.loads, (folder / "train.jsonl").read_text(encoding="utf-8").splitlines())


def test_what_is_trained_is_what_is_asked(conversed: Path, chats: Path) -> None:
    steps = [each for each in examples(chats) if "question" not in each["id"]]
    written = iter(steps)
    for demo in Dataset(conversed):
        turns = demo_turns(demo, EXPORTED)
        assert [turn.role for turn in turns] == ["user", "assistant"] * demo.num_steps
        for end in range(2, len(turns) + 1, 2):
            example = next(written)
            asked = [json.loads(turn.message) for turn in turns[:end]]
            images = iter(example["images"])
            for message, sent in zip(example["messages"], asked, strict=True):
                for block, part in zip(message["content"], sent["content"], strict=True):
                    if block["type"] == "text":
                        assert block == part
                    else:
                        file = chats / next(images)
                        assert part["type"] == "image_url" and file.is_file()
            assert next(images, None) is None
            answer = EXPORTED.read_answer(example["messages"][-1]["content"][0]["text"], demo.end_effector)
            action = demo.actions[end // 2 - 1]
            assert answer.pose0_position == pytest.approx(action.pose0_position, abs=1.1e-3)
    assert next(written, None) is None
    view = np.asarray(Image.open(chats / steps[0]["images"][-1]))
    assert view.shape == (256, 512, 3)
    assert np.array_equal(view[::2, ::2], np.moveaxis(Dataset(conversed)[0].rgb["top"][0], 0, -1))


def test_questions_are_on_the_scene(chats: Path) -> None:
    asked = [each for each in examples(chats) if "question" in each["id"]]
    texts = [each["messages"][0]["content"][-1]["text"] for each in asked]
    assert len(asked) > 6 and len({text.split()[0] for text in texts}) >= 2
    for each, text in zip(asked, texts, strict=True):
        answer = each["messages"][1]["content"][0]["text"]
        if text.startswith("Where in the picture"):
            assert answer in ("left", "right", "above", "below")
        elif text.startswith("Where is"):
            y, x = json.loads(answer)["point"]
            assert -50 <= y <= 1050 and -50 <= x <= 1050
        else:
            assert json.loads(answer).keys() <= {"objects", "moved"}


def test_llava_has_a_mark_for_each_image(conversed: Path) -> None:
    folder = export_chat(conversed, conversed.parent / "llava", format="llava", tasks=("rotate",))
    for example in examples(folder):
        said = example["conversations"]
        assert [turn["from"] for turn in said] == ["human", "gpt"] * (len(said) // 2)
        assert sum(turn["value"].count("<image>") for turn in said) == len(example["image"])


def test_exports_are_repeatable_and_not_overwritten(conversed: Path, chats: Path) -> None:
    again = export_chat(str(conversed), str(conversed.parent / "again"), form=EXPORTED, questions=3)
    assert (again / "train.jsonl").read_bytes() == (chats / "train.jsonl").read_bytes()
    with pytest.raises(DatasetError, match="is not empty"):
        export_chat(conversed, again)


def closed_loop() -> ModuleType:
    spec = importlib.util.spec_from_file_location("closed_loop", EXPERIMENT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_datasets_and_trl_read_it(chats: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip("datasets")
    trainer = pytest.importorskip("trl.trainer.sft_trainer")
    monkeypatch.chdir(chats)  # paths of images are relative to the export
    loaded = datasets.load_dataset(
        "json", data_files="train.jsonl", split="train", cache_dir=str(chats / "cache")
    )
    loaded = loaded.cast_column("images", datasets.Sequence(datasets.Image()))
    texts = [part["text"] for m in loaded[0]["messages"] for part in m["content"] if part["type"] == "text"]
    processor = closed_loop().build_processor(texts)
    collate = trainer.DataCollatorForVisionLanguageModeling(processor)
    batch = collate([loaded[0], loaded[1]])
    assert batch["pixel_values"].shape[0] == len(loaded[0]["images"]) + len(loaded[1]["images"])
    assert batch["input_ids"].shape[0] == 2
