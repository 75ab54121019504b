"""Settings: those out of range are named, all at once, with what would be allowed."""

import math
from pathlib import Path

import pytest

from openvima.errors import ConfigError
from openvima.training import TrainingConfig

FOLDERS = {"data": Path("demos"), "out": Path("run")}
BAD = {
    "steps": (0, -1),
    "batch": (0,),
    "learning_rate": (-1e-3, math.nan, math.inf),
    "warmup_steps": (-1,),
    "weight_decay": (-0.1,),
    "clip_norm": (-1.0, 0.0),
    "spurious_probability": (-0.1, 1.1, math.nan),
    "bystander_share": (-0.1, 1.1),
    "naming_share": (-0.1, 1.1, math.nan),
    "reordering_share": (-0.1, 1.1),
    "stranger_share": (-0.1, 1.1),
    "pretraining_steps": (-1,),
    "pretraining_scenes": (0,),
    "pretraining_batch": (1,),
    "pretraining_learning_rate": (-1.0,),
    "pretraining_random_looks": (-0.1, 1.1),
    "pretraining_twins": (-0.1, 1.1, math.nan),
    "pretraining_box_shift": (-1.0, 9.0),
    "pretraining_gaps": (-0.1, 1.1),
    "pretraining_grays": (-0.1, 1.1),
    "temperature": (0.0,),
    "seed": (-1,),
    "validation_share": (-0.1, 1.0),
    "checkpoint_every": (0,),
    "threads": (0, -2, 100_000),
    "epochs": (0.0,),
    "accumulate": (0,),
    "final_learning_rate": (-1.0, 2.0),
    "decay_steps": (0,),
    "bucket": (-1,),
    "validation_episodes": (0,),
    "keep_every": (0,),
    "rollout_every": (0,),
    "rollout_episodes": (0,),
    "loader_workers": (-1,),
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name in BAD for value in BAD[name]])
def test_a_value_out_of_range_is_named_with_what_is_allowed(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"^{name} is .+it must be"):
        TrainingConfig(**FOLDERS, **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("steps", "many", "steps is 'many'; it must be a whole number"),
        ("steps", None, "steps is None; it must be a whole number"),
        ("batch", 2.5, "batch is 2.5; it must be a whole number"),
        ("learning_rate", True, "learning_rate is True; it must be a number"),
        ("tensorboard", "no", "tensorboard is 'no'; it must be true or false"),
        ("preset", 3, "preset is 3; it must be text"),
    ],
)
def test_a_value_of_another_type_is_named(name: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TrainingConfig(**FOLDERS, **{name: value})


def test_an_unknown_preset_is_named_with_the_nearest_one() -> None:
    with pytest.raises(ConfigError, match=r"^there is no preset 'vima-nona'\. Did you mean 'vima-nano'\?"):
        TrainingConfig(**FOLDERS, preset="vima-nona")


def test_all_problems_are_in_one_message() -> None:
    with pytest.raises(ConfigError) as caught:
        TrainingConfig(**FOLDERS, steps=0, batch=0, preset="huge", validation_share=2.0)
    message = str(caught.value)
    assert all(f"{name} is" in message for name in ("steps", "batch", "validation_share"))
    assert "no preset 'huge'" in message
    assert "\n" not in message


def test_defaults_and_extreme_but_possible_values_are_taken() -> None:
    assert TrainingConfig(**FOLDERS).threads == 1
    TrainingConfig(**FOLDERS, steps=1, batch=1, pretraining_steps=0, validation_share=0.0, threads=1)


def test_settings_cannot_be_changed_afterwards() -> None:
    config = TrainingConfig(**FOLDERS)
    with pytest.raises(AttributeError):
        config.steps = 3  # type: ignore[misc]


@pytest.mark.parametrize(("name", "value"), [("precision", "float16"), ("sharding", "fdsp")])
def test_a_word_that_is_no_choice_is_named(name: str, value: str) -> None:
    with pytest.raises(ConfigError, match=rf"there is no {name} '{value}'"):
        TrainingConfig(**FOLDERS, **{name: value})
