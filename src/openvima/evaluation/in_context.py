"""In-context evaluation: the prompt is a demonstration of the same episode.

The oracle's observations become the prompt "Follow this motion: frame … frame". The policy starts from the
same initial state.

Source: MIDAS (Li et al. 2023), which holds out the three tasks below.
"""

from collections.abc import Collection

from openvima.env.tabletop import TabletopEnv
from openvima.errors import OracleError
from openvima.scene import ObjectRecord, RenderedPrompt
from openvima.tasks.registry import task_spec
from openvima.training.augmentation.inverse_dynamics import motion_prompt

HELD_OUT_TASKS = ("twist", "follow_motion", "follow_order")


def held_out_tasks(levels: Collection[str]) -> tuple[str, ...]:
    """Return those of the held-out tasks that some levels hold, or all if none of them does."""
    held = (task for task in HELD_OUT_TASKS if not set(levels).isdisjoint(task_spec(task).levels))
    return tuple(held) or HELD_OUT_TASKS


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
