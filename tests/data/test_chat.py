"""Chats with vision-language models: messages, points, answers."""

import json
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from openvima.data.chat import UNREADABLE, ChatFormat, demo_turns, encode_picture, family_of
from openvima.data.chat_settings import POINTS
from openvima.data.records import rollout_oracle
from openvima.env import EnvConfig
from openvima.errors import AnswerError
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


def test_a_demonstration_is_a_conversation() -> None:
    demo = rollout_oracle(make_env("pick_in_order_then_restore"), 0)
    turns = demo_turns(demo, FORM)
    assert [turn.role for turn in turns] == ["user", "assistant"] * demo.num_steps
    assert FORM.read_answer(turns[1].parts[0], "suction").pose0_position == pytest.approx(  # type: ignore[arg-type]
        demo.actions[0].pose0_position, abs=1.1e-3
    )


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
