"""`examples/vla_policy.py`: what a rule for language should solve, it solves behind a policy server."""

import re
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openvima.catalog.textures import TEXTURES
from openvima.env import TabletopEnv
from openvima.errors import ActionError, PolicyError
from openvima.evaluation import score
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.policies import load_policy
from openvima.serving import RemotePolicy, serve_in_thread

FILE = Path(__file__).parents[2] / "examples/vla_policy.py"
ROTATE = {"tasks": ("rotate",), "levels": ("L1",), "episodes": 1, "prompts": "text"}


@pytest.fixture(params=["primitives", "end_effector"])
def policy(request: pytest.FixtureRequest) -> Any:
    return load_policy(f"{FILE}:{request.param}")


def test_the_files_are_short() -> None:
    for file in (FILE, FILE.with_name("language_rule.py")):
        assert len(file.read_text(encoding="utf-8").splitlines()) <= 70


@pytest.mark.parametrize(("task", "level", "seed"), [("visual_manipulation", "L3", 5), ("rotate", "L1", 0)])
def test_the_rule_solves_what_words_for_colours_tell(policy: Any, task: str, level: str, seed: int) -> None:
    cells = {"tasks": (task,), "levels": (level,), "episodes": 3, "seed": seed, "prompts": "text"}
    with serve_in_thread(policy) as url, RemotePolicy(url) as remote:
        assert (remote.control, remote.modalities) == (policy.control, ("rgb", "joints"))
        results = score({"rule": remote}, **cells, control=policy.control)
    assert results.rows[0].successes == 3


def is_told_by_colours(info: dict) -> bool:
    """Whether all descriptions of a prompt name colours that one object alone has."""
    shown = [colours(names["texture"]) for names in info["objects"].values()]
    wanted = [colours(text) for text in re.findall(r"the (.+?)(?= into |\.| \d)", info["prompt"])]
    return all(each[0] and shown.count(each) == 1 for each in wanted)


def colours(text: str) -> tuple[frozenset[str], bool, bool]:
    found = frozenset(
        re.findall(
            "|".join(
                spec.name for spec in TEXTURES.values() if spec.category == "plain" and not spec.is_dark
            ),
            text,
        )
    )
    return found, "dark" in text, bool(re.search("swirl|paisley", text))


@pytest.mark.slow
def test_the_rule_solves_every_episode_that_colours_tell(policy: Any) -> None:
    solved = []
    for task, level in product(("visual_manipulation", "rotate"), ("L1", "L2", "L3")):
        for seed in range(3 if policy.control == "end_effector" else 12):
            settings = {"prompts": "text", "modalities": policy.modalities, "control": policy.control}
            env = TabletopEnv(task, level=level, domain="eval", **settings)
            if is_told_by_colours(env.reset(seed=seed)[1]):
                (outcome,) = play([env], [seed], PromptedRolloutPolicy(policy))
                solved.append(outcome.success)
    assert solved and all(solved)
    if policy.control == "primitives":
        assert len(solved) == 50  # of 72


def test_the_rule_reads_the_text() -> None:
    policy: Any = load_policy(f"{FILE}:primitives")
    model = policy.model
    policy.model = lambda text, images, state: model(text.replace("degrees", "centimetres"), images, state)
    (row,) = score({"deaf": policy}, **ROTATE).rows
    assert row.successes == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.zeros(7, np.float32), r"shape \(7,\), dtype float32; it must be {} floating-point numbers"),
        (np.zeros((2, 3, 4)), r"shape \(3, 4\)"),
        (np.zeros((2, 0), np.float32), r"shape \(0,\)"),
    ],
)
def test_actions_of_another_shape_end_the_evaluation(policy: Any, given: np.ndarray, message: str) -> None:
    policy.model = lambda text, images, state: given
    numbers = {"primitives": 12, "end_effector": 5}[policy.control]
    with pytest.raises(ActionError, match=message.format(numbers)):
        score({"bad": policy}, **ROTATE, control=policy.control)
    policy.model = lambda text, images, state: np.zeros((4, numbers), np.int64)
    with (
        serve_in_thread(policy) as url,
        RemotePolicy(url) as remote,
        pytest.raises(
            PolicyError, match=f"refuses: ActionError: the action has .* dtype int64; .* {numbers} fl"
        ),
    ):
        score({"bad": remote}, **ROTATE, control=policy.control)


def test_an_action_that_is_not_finite_fails_the_episode_and_the_results_say_so(policy: Any) -> None:
    numbers = {"primitives": 12, "end_effector": 5}[policy.control]
    policy.model = lambda text, images, state: np.full(numbers, np.nan, np.float32)
    results = score({"bad": policy}, **ROTATE, control=policy.control)
    assert "finite" in results.rows[0].outcomes[0].reason
    assert results.invalid_actions()
