"""The oracle's demonstration as prompt: it is that of the very episode, which is left as it was."""

import numpy as np
import pytest

from openvima.data.records import rollout_oracle
from openvima.env import TabletopEnv
from openvima.errors import OracleError
from openvima.evaluation.ablations import ORACLE_DEMONSTRATION, ablate
from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.policies import RandomPolicy
from openvima.policies.tokenizer import WordTokenizer
from openvima.tasks import task_spec


@pytest.mark.parametrize("task", IN_CONTEXT_TASKS)
def test_the_prompt_is_the_motion_of_the_oracle_in_this_episode(task) -> None:
    env = TabletopEnv(task, level=task_spec(task).levels[-1], domain="eval")
    observation, _ = env.reset(seed=3)
    before = env.scene
    prompt = ablate(env, ORACLE_DEMONSTRATION).prompt
    assert env.scene == before
    demo = rollout_oracle(TabletopEnv(task, level=env.level, domain="eval"), 3)
    assert demo.outcome.success
    assert list(prompt.images) == [f"frame_{t}" for t in range(demo.num_steps + 1)]
    for t, image in enumerate(prompt.images.values()):
        for view in ("front", "top"):
            np.testing.assert_array_equal(image.rgb[view], demo.rgb[view][t])
            np.testing.assert_array_equal(image.segm[view], demo.segm[view][t])
        assert image.objects == tuple(sorted(demo.objects, key=lambda record: record.object_id))
    np.testing.assert_array_equal(prompt.images["frame_0"].rgb["top"], observation["rgb"]["top"])
    words = [piece for piece in prompt.sequence() if isinstance(piece, str)]
    assert words[0] == "Follow this motion:"
    WordTokenizer().encode(" ".join(words))


def test_an_oracle_that_finds_no_action_shows_what_it_did_until_then(monkeypatch) -> None:
    env = TabletopEnv("follow_order", level="L1", domain="eval")
    env.reset(seed=3)
    whole = ablate(env, ORACLE_DEMONSTRATION).prompt
    decide, asked = TabletopEnv.oracle_decision, []

    def once(own):
        asked.append(own)
        if len(asked) > 1:
            raise OracleError("nothing can be seen from above")
        return decide(own)

    monkeypatch.setattr(TabletopEnv, "oracle_decision", once)
    prompt = ablate(env, ORACLE_DEMONSTRATION).prompt
    assert list(prompt.images) == ["frame_0", "frame_1"]
    np.testing.assert_array_equal(prompt.images["frame_1"].rgb["top"], whole.images["frame_1"].rgb["top"])


class Noting(RandomPolicy):
    """Notes what it is told."""

    def reset(self, prompts):
        super().reset(prompts)
        self.prompts = prompts


def test_the_motion_is_the_prompt_of_a_policy() -> None:
    policy, env = Noting(), TabletopEnv("twist", level="L1", domain="eval")
    play([env], [0], PromptedRolloutPolicy(policy, ORACLE_DEMONSTRATION))
    assert policy.prompts[0].text.startswith("Follow this motion: {frame_0} {frame_1}")
