"""Policies are scored through a server as they are without one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from served_policies import Telltale

pytest.importorskip("torch")

from openvima.env import TabletopEnv
from openvima.errors import ConfigError, PolicyRaisedError, PromptError, ServerError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.config import Batch
from openvima.evaluation.results import POLICY_ERROR
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy, load_rollout_policy
from openvima.policies import RandomPolicy, load_policy
from openvima.policies.inference import NetworkPolicy
from openvima.serving import RemotePolicy, serve_in_thread
from small_networks import one_thread, perturbed

__all__ = ["one_thread"]  # as servers compute by default

TASKS = ("rotate", "sweep_without_exceeding")
TINY = EvaluationConfig(("random",), TASKS, ("L1",), episodes=3, batch=2)
ABOUT = {"policy": {"name": "tiny", "sha256": "ab12"}}


@pytest.fixture(scope="module")
def network_policy() -> NetworkPolicy:
    return NetworkPolicy(perturbed("nano"))


def test_a_network_acts_through_a_server_as_here_bit_for_bit(network_policy: NetworkPolicy) -> None:
    envs = [TabletopEnv(task, domain="user") for task in ("visual_manipulation", "rotate", "novel_noun")]
    views = [[env.reset(seed=step)[0] for env in envs] for step in range(3)]
    prompts = [env.prompt for env in envs]
    local = network_policy.new_session()
    with (
        serve_in_thread(network_policy) as url,
        RemotePolicy(url) as remote,
        RemotePolicy(url) as other,
    ):
        for policy in (local, remote):
            policy.reset(prompts)
        other.reset(prompts[::-1])  # another client, in between
        for seen in (*views[:2], [views[2][0], None, views[2][2]]):
            expected, got = local.act(seen), remote.act(seen)
            other.act(views[0][::-1])
            assert remote.near_ties == local.near_ties
            for one, two in zip(expected, got, strict=True):
                if one is None:
                    assert two is None
                    continue
                assert two is not None and two.keys() == one.keys()
                for key, array in one.items():
                    np.testing.assert_array_equal(two[key], array, strict=True)


def test_sessions_share_the_weights_and_nothing_else(network_policy: NetworkPolicy) -> None:
    env = TabletopEnv("rotate", domain="user")
    env.reset(seed=1)
    network_policy.reset([env.prompt])
    session = network_policy.new_session()
    assert session.network is network_policy.network
    with pytest.raises(ValueError, match="call reset"):
        session.act([None])
    session.reset([env.prompt] * 2)
    assert len(network_policy.act([None])) == 1


@pytest.mark.slow
def test_an_evaluation_through_a_server_has_the_outcomes_of_one_without(
    network_policy: NetworkPolicy, tmp_path: Path
) -> None:
    network_policy.save_pretrained(tmp_path / "net")
    served = load_policy(str(tmp_path / "net"))
    here = evaluate(replace(TINY, policies=(f"tiny={tmp_path / 'net'}",), out=tmp_path / "here"))
    with serve_in_thread(served, about=ABOUT) as url:
        config = replace(TINY, policies=(f"tiny={url}",), out=tmp_path / "there")
        there = evaluate(config)
    local, remote = Results.read(here), Results.read(there)
    assert remote.rows == local.rows
    assert remote.policies["tiny"]["kind"] == "remote"
    assert remote.policies["tiny"]["metadata"]["policy"] == ABOUT["policy"]
    assert url not in there.read_text()


def test_outcomes_are_kept_for_the_same_server_and_played_again_for_another(tmp_path: Path) -> None:
    config = replace(TINY, tasks=("rotate",), out=tmp_path)
    with serve_in_thread(RandomPolicy(), about=ABOUT) as url:
        config = replace(config, policies=(f"tiny={url}",))
        path = evaluate(config)
        first = path.read_bytes()
        assert evaluate(config).read_bytes() == first
    same_port = int(url.rpartition(":")[2])
    with serve_in_thread(RandomPolicy(1), port=same_port, about={"policy": {"sha256": "other"}}):
        with pytest.raises(ConfigError, match="another evaluation"):
            evaluate(config)
        evaluate(replace(config, force=True))
        assert json.loads(path.read_text())["policies"]["tiny"]["metadata"]["policy"] == {"sha256": "other"}


def test_a_policy_that_always_fails_on_its_server_is_an_error_of_one_line(tmp_path: Path) -> None:
    class Bad(Telltale):
        def reset(self, prompts):
            raise RuntimeError("out of memory")

    with serve_in_thread(Bad()) as url:
        config = replace(TINY, policies=(f"bad={url}",), out=tmp_path)
        said = "bad: the policy on the server raised RuntimeError: out of memory, in rotate, L1, seeds 0, 1"
        with pytest.raises(PolicyRaisedError, match=said):
            evaluate(config)
    with pytest.raises(ServerError, match="no policy server answers"):
        evaluate(config)


@pytest.mark.parametrize("error", [KeyError("step"), PromptError("no image")])
def test_an_episode_in_which_a_served_policy_raises_has_failed(error: Exception, tmp_path: Path) -> None:
    class Bad(RandomPolicy):
        def act(self, observations):
            self.calls = getattr(self, "calls", 0) + 1
            if self.calls in (2, 3):  # the second step of the first two episodes, and that of the first alone
                raise error
            return super().act(observations)

        def new_session(self):
            return self

    with serve_in_thread(Bad()) as url:
        config = replace(TINY, policies=(f"bad={url}",), tasks=("rotate",), out=tmp_path)
        path = evaluate(config)
    (row,) = Results.read(path).rows
    assert [outcome.kind == POLICY_ERROR for outcome in row.outcomes] == [True, False, False]
    assert "the policy on the server" in row.outcomes[0].reason and url not in path.read_text()


def test_one_connection_serves_all_that_a_process_plays() -> None:
    with serve_in_thread(Telltale()) as url:  # which lets in one client at a time
        for fingerprint in ("for the scores", "for the films"):
            batch = Batch("p", url, "rotate", "L1", first_seed=0, episodes=1, fingerprint=fingerprint)
            assert isinstance(load_rollout_policy(batch), PromptedRolloutPolicy)
