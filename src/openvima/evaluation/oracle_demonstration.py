"""Oracle demonstration: the prompt is the oracle's solution of the very episode.

The oracle's observations become the prompt "Follow this motion: frame … frame". The policy starts from the
same initial state. The prompt contains the answer, so this measures whether a policy reproduces what it sees;
the in-context evaluation of the papers is in `in_context.py`.
"""

from openvima.env.tabletop import TabletopEnv
from openvima.errors import OracleError
from openvima.scene import ObjectRecord, RenderedPrompt
from openvima.training.augmentation.prompts import motion_prompt


def demonstrated(env: TabletopEnv) -> RenderedPrompt:
    """Return the motion of the oracle in the episode that an environment has begun, as a prompt.

    If the oracle fails or has no action, the demonstration ends there.

    Args:
        env: The environment; it is left as it is.
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
    seen = [own.reset(seed=env.episode.seed)[0]]
    while not own.outcome.is_over and len(seen) <= own.episode.oracle_max_steps:
        try:
            action = own.oracle_decision().action
        except OracleError:
            break
        seen.append(own.step(action)[0])
    objects = [ObjectRecord(p.id, p.object, p.texture) for p in own.scene.placements]
    return motion_prompt(seen, objects)
