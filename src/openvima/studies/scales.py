"""Sizes of studies: network, demonstrations, training length and episodes by name of the scale."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from openvima.errors import ConfigError, unknown_name
from openvima.policies.presets import SIZE_NAMES

NANO = "nano"
TRAINING_TASKS = (  # of the papers
    "visual_manipulation",
    "scene_understanding",
    "rotate",
    "rearrange",
    "rearrange_then_restore",
    "novel_adj",
    "novel_noun",
    "twist",
    "follow_order",
    "sweep_without_exceeding",
    "same_shape",
    "manipulate_old_neighbor",
    "pick_in_order_then_restore",
)
L4_TASKS = ("novel_adj_and_noun", "follow_motion", "sweep_without_touching", "same_texture")


@dataclass(frozen=True, slots=True)
class Scale:
    """Sizes of a study.

    Args:
        name: A size of the presets: "nano", "2m" to "200m".
        recipe: Training settings; `settings` take precedence.
        settings: Training settings by dotted name.
        tasks: Tasks to train on.
        new_tasks: Tasks that are evaluated and not trained on, at L4.
        demonstrations: Demonstrations of each task.
        levels: Levels to evaluate.
        episodes: Episodes of each task, level and training seed.
    """

    name: str
    recipe: str
    settings: Mapping[str, Any]  # Any: values of any setting
    tasks: tuple[str, ...]
    new_tasks: tuple[str, ...]
    demonstrations: int
    levels: tuple[str, ...] = ("L1", "L2", "L3", "L4")
    episodes: int = 200

    @property
    def is_nano(self) -> bool:
        """Whether it is the scale of two cores, with networks that have their own vocabulary."""
        return self.name == NANO


# Contrastive pretraining takes most of a training: it is shorter than in the recipe, and equal for all runs.
NANO_POINTER: Mapping[str, Any] = MappingProxyType(  # Any: values of any setting
    {"preset": NANO, "pretraining.steps": 150, "pretraining.num_scenes": 1200}
)
# Two cores: one training takes minutes.
_NANO = Scale(
    name=NANO,
    recipe="nano",
    settings=MappingProxyType({"schedule.steps": 400, "loader.batch_size": 64, "runtime.tensorboard": False}),
    tasks=("visual_manipulation", "scene_understanding", "rotate", "novel_noun"),
    new_tasks=("novel_adj_and_noun",),
    demonstrations=1000,
    episodes=50,
)


def _published(size: str) -> Scale:
    """Everything as in the papers, save the size of the network."""
    return Scale(
        name=size,
        recipe="paper",
        settings=MappingProxyType({"schedule.steps": 47_000}),  # 10 epochs of 600,000, in batches of 128
        tasks=TRAINING_TASKS,
        new_tasks=L4_TASKS,
        demonstrations=50_000,
    )


SCALES: Mapping[str, Scale] = MappingProxyType(
    {NANO: _NANO, **{size: _published(size) for size in SIZE_NAMES if size != NANO}}
)


def scale_named(name: str) -> Scale:
    """Return a scale.

    Raises:
        ConfigError: There is none of that name.
    """
    if name not in SCALES:
        raise ConfigError(unknown_name("scale", name, SCALES))
    return SCALES[name]
