"""Settings: invalid ones are named all at once, with the allowed values."""

import math
import re
from pathlib import Path

import pytest

from openvima.errors import ConfigError
from openvima.training import TrainingConfig

FOLDERS = {"data": Path("demos"), "out": Path("run")}
BAD = {
    "schedule.steps": (0, -1),
    "loader.batch_size": (0,),
    "optimizer.learning_rate": (-1e-3, math.nan, math.inf),
    "schedule.warmup_steps": (-1,),
    "optimizer.weight_decay": (-0.1,),
    "optimizer.max_grad_norm": (-1.0, 0.0),
    "augmentation.false_positive_prob": (-0.1, 1.1, math.nan),
    "augmentation.drop_unused_objects_prob": (1.1,),
    "augmentation.rename_objects_prob": (-0.1,),
    "augmentation.shuffle_sentences_prob": (1.1,),
    "augmentation.distractor_prob": (-0.1,),
    "loader.detected_prob": (1.5,),
    "pretraining.steps": (-1,),
    "pretraining.num_scenes": (0, 1),
    "pretraining.batch_size": (1,),
    "pretraining.appearance_randomization_prob": (1.1,),
    "pretraining.hard_negative_prob": (-0.1,),
    "pretraining.box_jitter_px": (-1.0, 9.0),
    "pretraining.occlusion_prob": (1.1,),
    "pretraining.grayscale_prob": (-0.1,),
    "seed": (-1,),
    "loader.validation_fraction": (-0.1, 1.0),
    "schedule.checkpoint_every": (0,),
    "runtime.threads": (0, -2, 100_000),
    "schedule.epochs": (0.0,),
    "optimizer.grad_accum_steps": (0,),
    "schedule.final_learning_rate": (-1.0, 2.0),
    "schedule.decay_steps": (0,),
    "loader.bucket_batches": (-1,),
    "loader.validation_episodes": (0,),
    "schedule.keep_every": (0,),
    "rollout.every": (0,),
    "rollout.episodes": (0,),
    "loader.num_workers": (-1,),
}


def test_values_out_of_range_are_all_named_in_one_message_with_what_is_allowed() -> None:
    for number in range(3):
        bad = {name: values[number] for name, values in BAD.items() if number < len(values)}
        with pytest.raises(ConfigError) as caught:
            TrainingConfig.of({**FOLDERS, "preset": "vima-nona", **bad})
        message = str(caught.value)
        for name in bad:
            assert re.search(rf"(^|[;. ]){re.escape(name)} is [^;]+; it must be", message), name
        assert "there is no preset 'vima-nona'. Did you mean 'vima-nano'?" in message
        assert "\n" not in message


def test_bundled_weights_given_as_a_preset_are_pointed_to_init_from() -> None:
    with pytest.raises(ConfigError, match=r"preset is 'openvima-vima', which are weights; init_from takes"):
        TrainingConfig.of({**FOLDERS, "preset": "openvima-vima"})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("schedule.steps", "many", "schedule.steps is 'many'; it must be a whole number"),
        ("optimizer.learning_rate", True, "optimizer.learning_rate is True; it must be a number"),
        ("runtime.tensorboard", "no", "runtime.tensorboard is 'no'; it must be true or false"),
        ("preset", 3, "preset is 3; it must be text"),
        ("data", None, "data is None; it must be a path"),
    ],
)
def test_a_value_of_another_type_is_named(name: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TrainingConfig.of({**FOLDERS, name: value})


def test_defaults_and_extreme_values_are_valid() -> None:
    assert TrainingConfig.of(FOLDERS).runtime.threads == 1
    least = {"schedule.steps": 1, "loader.batch_size": 1, "pretraining.steps": 0, "runtime.threads": 1}
    TrainingConfig.of({**FOLDERS, **least, "loader.validation_fraction": 0.0})


def test_an_invalid_choice_is_named() -> None:
    with pytest.raises(ConfigError, match=r"there is no runtime.precision 'float16'"):
        TrainingConfig.of({**FOLDERS, "runtime.precision": "float16"})
    with pytest.raises(ConfigError, match=r"there is no model.crop_kernel 2\. Allowed: 1, 3\."):
        TrainingConfig.of({**FOLDERS, "model.crop_kernel": 2})


def test_an_unknown_setting_is_named_with_the_nearest_one() -> None:
    with pytest.raises(
        ConfigError, match=r"no setting 'schedule\.stepps'\. Did you mean 'schedule\.steps'\?"
    ):
        TrainingConfig.of({**FOLDERS, "schedule.stepps": 3})


def test_execution_settings_are_not_part_of_the_identity() -> None:
    first = TrainingConfig.of(
        {**FOLDERS, "runtime.threads": 2, "schedule.keep_every": 3, "loader.num_workers": 1}
    )
    assert first.identity() == TrainingConfig.of(FOLDERS).identity()
    assert first.identity() != TrainingConfig.of({**FOLDERS, "optimizer.weight_decay": 0.5}).identity()
