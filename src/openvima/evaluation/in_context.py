"""Evaluation in context: the prompt is a demonstration of the very episode that is then played.

A task that was never trained can still be shown. The oracle plays the episode, and what was seen on the way
becomes the prompt "Follow this motion: frame … frame". The policy begins where the oracle began.

Source: MIDAS (Li et al. 2023), which holds out the three tasks below.
"""

from openvima.data.records import rollout_oracle
from openvima.env.tabletop import TabletopEnv
from openvima.scene import RenderedPrompt
from openvima.training.inverse_dynamics import motion_prompt

HELD_OUT_TASKS = ("twist", "follow_motion", "follow_order")


def demonstrated(env: TabletopEnv) -> RenderedPrompt:
    """Return the motion of the oracle in the episode that an environment has begun, as a prompt.

    Args:
        env: The environment; it is left as it is.

    Raises:
        OracleError: The oracle finds no action.
    """
    own = TabletopEnv(
        env.task,
        level=env.level,
        domain=env.domain,
        assets=env.assets,
        compat=env.compat,
        hide_arm=env.hide_arm,
        **env.task_options,
    )
    demo = rollout_oracle(own, env.episode.seed)
    return motion_prompt([demo.observation(t) for t in range(demo.num_steps + 1)], demo.objects)
