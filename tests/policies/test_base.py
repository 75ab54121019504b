"""Loading by name, and the policy that acts at random."""

import sys

import numpy as np
import pytest

from openvima.errors import CheckpointError, MissingExtraError, PolicyError, UnknownPolicyError
from openvima.policies import RandomPolicy, load_policy
from openvima.scene import Action


def test_an_unknown_name_gets_a_suggestion():
    with pytest.raises(UnknownPolicyError, match="Did you mean 'untrained'"):
        load_policy("untraned")


def test_a_folder_without_checkpoint_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        load_policy(str(tmp_path))


def test_without_torch_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'openvima\[train\]'"):
        load_policy("untrained")


def test_random_actions_are_valid_and_follow_from_seed_and_prompt(demonstrations):
    prompts = [demo.prompt for demo in demonstrations]
    policy = RandomPolicy(seed=3)
    policy.reset(prompts)
    together = policy.act([{}] * len(prompts))
    for prompt, action in zip(prompts, together, strict=True):
        Action.from_arrays(action)
        alone = RandomPolicy(seed=3)
        alone.reset([prompt])
        (same,) = alone.act([{}])
        assert all((same[key] == action[key]).all() for key in action)
    assert len({action["pose0_position"].tobytes() for action in together}) == len(prompts)


def test_another_seed_draws_other_actions(demonstrations):
    drawn = []
    for seed in (0, 1):
        policy = load_policy("random", seed=seed)
        policy.reset([demonstrations[0].prompt])
        drawn.append(policy.act([{}])[0]["pose0_position"])
    assert not np.array_equal(*drawn)


def test_ended_episodes_get_no_action_and_wrong_counts_are_refused(demonstrations):
    policy = RandomPolicy()
    policy.reset([demonstrations[0].prompt, demonstrations[1].prompt])
    first, second = policy.act([None, {}])
    assert first is None
    assert second is not None
    with pytest.raises(PolicyError, match="1 observations for 2 prompts"):
        policy.act([{}])
