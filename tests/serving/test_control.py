"""Commands of the tool behind a server: the client learns the control, and only that one is answered."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import PolicyError, ServerError
from openvima.evaluation import score
from openvima.policies import RandomPolicy
from openvima.serving import RemotePolicy, serve_in_thread
from served_policies import made_up_observation, made_up_prompt

TOOL = np.array([0.5, 0.1, 0.3, -1.0, 1.0], np.float32)
OBSERVATION = {**made_up_observation(1), "tool": TOOL}
ROTATE = {"tasks": ("rotate",), "levels": ("L1",), "episodes": 1}


class Follows:
    """Moves by a tenth of the tool's pose."""

    control = "end_effector"

    def reset(self, prompts: Sequence[Any]) -> None:
        pass

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:
        return [None if seen is None else self.command(seen) for seen in observations]

    def command(self, seen: Mapping) -> object:
        return seen["tool"] / 10


class Gives(Follows):
    """Gives one thing whatever it sees."""

    def __init__(self, given: object) -> None:
        self.given = given

    def command(self, seen: Mapping) -> object:
        return self.given


def test_commands_and_the_pose_of_the_tool_pass_unchanged() -> None:
    env = TabletopEnv("rotate", level="L1", control="end_effector", modalities=("rgb",))
    seen, _ = env.reset(seed=0)
    with serve_in_thread(Follows()) as url, RemotePolicy(url) as remote:
        assert remote.control == remote.record()["control"] == "end_effector"
        remote.reset([env.prompt, env.prompt])
        for _ in range(2):
            command, none = remote.act([seen, None])
            np.testing.assert_array_equal(command, seen["tool"] / 10, strict=True)
            assert none is None
            seen, *_ = env.step(command)


def test_policies_of_the_other_control_are_refused_on_both_sides() -> None:
    with serve_in_thread(Follows()) as url, RemotePolicy(url) as remote:
        with pytest.raises(PolicyError, match="'end_effector', but the environments have control 'primit"):
            score({"remote": remote}, **ROTATE)
        remote.reset([made_up_prompt(1)])
        with pytest.raises(ServerError, match="observation 0: it lacks 'tool'"):
            remote.act([made_up_observation(1)])
    with serve_in_thread(RandomPolicy()) as url, RemotePolicy(url) as remote:
        assert remote.control == "primitives"
        with pytest.raises(PolicyError, match="'primitives', but the environments have control 'end_eff"):
            score({"remote": remote}, **ROTATE, control="end_effector")
        remote.reset([made_up_prompt(1)])
        with pytest.raises(ServerError, match="it has 'tool', which nobody knows"):
            remote.act([OBSERVATION])


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (np.zeros(12, np.float32), r"shape \(12,\), dtype float32"),
        (np.zeros(5, np.int64), r"shape \(5,\), dtype int64"),
        (np.full(5, np.nan, np.float32), r"\(nan, nan, nan, nan, nan\); all values must be finite"),
    ],
)
def test_a_malformed_command_ends_the_episode_with_the_reason(given: object, reason: str) -> None:
    with serve_in_thread(Gives(given)) as url, RemotePolicy(url) as remote:
        (row,) = score({"remote": remote}, **ROTATE, control="end_effector").rows
    (outcome,) = row.outcomes
    assert not outcome.success and outcome.steps == 0 and re.search(reason, outcome.reason)
