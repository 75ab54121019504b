"""Training: what a run leaves, going on after an interruption, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.data import Dataset
from openvima.detector import config as sizes
from openvima.detector import load_detector
from openvima.detector.checkpoint import load_network, save_network
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, DatasetError
from openvima.training.config import RuntimeConfig, ScheduleConfig
from openvima.training.detector import DetectorTrainingConfig, train_detector
from openvima.training.detector.config import FrameLoaderConfig
from openvima.training.detector.stage import split_episodes
from small_networks import metrics_of


@pytest.fixture
def settings(data: Path, tmp_path: Path, tiny, monkeypatch) -> DetectorTrainingConfig:
    """Two steps of a tiny network."""
    monkeypatch.setitem(sizes.DETECTORS, "small", tiny)
    return DetectorTrainingConfig(
        data,
        tmp_path / "run",
        proposals_per_frame=8,
        loader=FrameLoaderConfig(batch_size=4, validation_fraction=0.4, validation_frames=4),
        schedule=ScheduleConfig(steps=2, warmup_steps=100, checkpoint_every=1),
        runtime=RuntimeConfig(device="cpu"),
    )


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_network(run).state_dict()


def test_a_run_leaves_a_detector_and_its_metrics(settings):
    seen = []
    run = train_detector(settings, lambda *progress: seen.append(progress))
    assert seen[-1][:2] == (2, 2)
    names = {"loss", *(f"loss/{name}" for name in ("rpn_objectness", "rpn_box", "class", "box", "mask"))}
    trained = [line for line in metrics_of(run) if "loss" in line]
    held_out = [line for line in metrics_of(run) if "validation_loss" in line]
    assert names <= trained[-1].keys() and {f"validation_{name}" for name in names} <= held_out[-1].keys()
    assert [line["step"] for line in held_out] == [1, 2]
    found = load_detector(run).detect(np.zeros((3, 128, 256), np.uint8), "top")
    assert found.masks.shape[1:] == (128, 256)


def test_an_interrupted_run_ends_with_the_weights_of_one_that_was_not(settings, tmp_path, monkeypatch):
    whole = train_detector(replace(settings, out=tmp_path / "whole"))
    from openvima.training import loop

    def stops(trainer, stage, optimizer, step, num_steps, do=loop.Trainer._step):
        if step == 1:
            raise KeyboardInterrupt
        return do(trainer, stage, optimizer, step, num_steps)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(loop.Trainer, "_step", stops)
        train_detector(settings)
    run = train_detector(settings)
    last = "checkpoints/detector-000002"
    one, other = weights(whole / last), weights(run / last)
    assert all(torch.equal(one[name], other[name]) for name in one if "num_batches" not in name)
    assert [line["step"] for line in metrics_of(run) if "loss" in line] == [1, 2]


def test_other_settings_do_not_continue_a_run(settings):
    train_detector(settings)
    optimizer = replace(settings.optimizer, learning_rate=0.01)
    with pytest.raises(ConfigError, match=r"learning_rate is 0\.001 there and 0\.01 here"):
        train_detector(replace(settings, optimizer=optimizer))
    train_detector(replace(settings, optimizer=optimizer, force=True))


def test_training_begins_with_the_weights_of_another_detector(settings, tiny, tmp_path):
    torch.manual_seed(5)
    first = MaskRCNN(replace(tiny, rpn_post_nms_top_n=7))
    save_network(first, tmp_path / "first")
    optimizer = replace(settings.optimizer, learning_rate=0.0)
    run = train_detector(replace(settings, init_from=tmp_path / "first", optimizer=optimizer))
    assert load_network(run).config.rpn_post_nms_top_n == 7
    name = "box_head.class_logits.weight"
    assert torch.equal(weights(run)[name], first.state_dict()[name])


def test_every_demonstration_is_on_one_side_and_stays_there(data):
    dataset = Dataset(data)
    training, held_out = split_episodes(dataset, 0.4)
    assert sorted([*training, *held_out]) == list(range(len(dataset)))
    assert set(split_episodes(dataset, 0.2)[1]) <= set(held_out)


def test_too_few_demonstrations_are_told(settings):
    with pytest.raises(DatasetError, match="a batch of 400 frames needs 200"):
        train_detector(replace(settings, loader=replace(settings.loader, batch_size=400)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "smal"}, "Did you mean 'small'"),
        ({"loader.batch_size": 5}, "must be even"),
        ({"loader.batch_size": 4.0}, "loader.batch_size is 4.0; it must be a whole number"),
        (
            {"optimizer.learning_rate": "high", "loader.augment": 1},
            r"optimizer\.learning_rate is 'high'.*loader\.augment is 1; .* true or false",
        ),
        ({"optimizer.learning_rate": -1.0, "schedule.steps": 0}, r"learning_rate is -1.*steps is 0"),
    ],
)
def test_settings_that_cannot_be_are_told(data, tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        DetectorTrainingConfig.of({"data": data, "out": tmp_path, **changes})
