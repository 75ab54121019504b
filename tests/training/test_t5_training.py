"""Training with T5: initial weights, and the tokenizer in every checkpoint."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("transformers")

from openvima.errors import ConfigError, InputFileError, PromptError
from openvima.policies import presets, sizes
from openvima.policies.checkpoint import load_checkpoint
from openvima.policies.nn.prompt_encoder import TextEncoderConfig
from openvima.policies.t5 import T5Tokenizer
from openvima.training import TrainingConfig, train
from openvima.training.building import build_learner
from published_policies import small_vima, write_t5, write_tokenizer
from small_networks import assert_it_acts


def small_t5_vima():
    """The small VIMA, with the last of its two T5 layers trained."""
    sizes = small_vima()
    return replace(sizes, prompt=replace(sizes.prompt, trained_layers=1))


@pytest.fixture
def t5(tmp_path: Path) -> Path:
    """A folder with a small T5: tokenizer and weights."""
    prompt = small_t5_vima().prompt
    return write_t5(write_tokenizer(tmp_path / "t5"), prompt.text, prompt.vocabulary_size)


@pytest.fixture
def t5_settings(settings, t5, monkeypatch) -> dict:
    monkeypatch.setitem(presets.PRESETS, "tiny-t5", small_t5_vima)
    changes = {"preset": "tiny-t5", "t5": str(t5), "pretraining.steps": 0, "schedule.steps": 4}
    return {**settings, **changes}


def checkpoints(run: Path) -> list[Path]:
    return sorted(path for path in (run / "checkpoints").iterdir() if path.is_dir())


def test_training_starts_from_t5_keeps_its_frozen_weights_and_stores_its_tokenizer(t5_settings, t5) -> None:
    from transformers import T5EncoderModel

    run = train(TrainingConfig.of(t5_settings))
    prompt = load_checkpoint(checkpoints(run)[-1]).prompt
    reference = T5EncoderModel.from_pretrained(t5)
    first, second = reference.encoder.block
    assert torch.equal(prompt.words.weight, reference.shared.weight)
    assert torch.equal(prompt.text.blocks[0].query.weight, first.layer[0].SelfAttention.q.weight)
    change = prompt.text.blocks[1].query.weight - second.layer[0].SelfAttention.q.weight
    assert change.any()
    assert change.abs().max() < 0.1  # trained, not drawn anew
    text = "Put the block into the bowl."
    expected = T5Tokenizer(t5).encode(text)
    t5.rename(t5.with_name("elsewhere"))
    for checkpoint in checkpoints(run):
        assert T5Tokenizer(checkpoint / "tokenizer").encode(text) == expected
    assert_it_acts(run)


def test_a_word_that_t5_lacks_is_named_before_the_first_step(t5_settings) -> None:
    with pytest.raises(PromptError, match="'дом'"):
        build_learner(TrainingConfig.of(t5_settings), ["put the block", "into the дом"])


@pytest.mark.slow
def test_a_preset_with_words_takes_a_t5_of_the_size_that_is_named(
    settings, t5, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(sizes, "T5_VOCABULARY_SIZE", small_t5_vima().prompt.vocabulary_size)
    monkeypatch.setitem(sizes.T5_SIZES, "t5-small", TextEncoderConfig(24, 3, 2, 4, 32))
    prompt = sizes.t5_prompt_encoder("t5-small")
    own = write_t5(write_tokenizer(tmp_path / "small"), prompt.text, prompt.vocabulary_size)
    changes = {
        "preset": "vima-nano",
        "t5": str(own),
        "model.text_encoder": "t5-small",
        "pretraining.steps": 0,
    }
    config = {**settings, **changes, "schedule.steps": 2}
    policy = assert_it_acts(train(TrainingConfig.of(config)))
    assert policy.network.config.prompt == prompt
    with pytest.raises(InputFileError, match=r"needs a T5 1\.0: t5-small \(24 wide, 3 layers, 2 heads of 4"):
        build_learner(TrainingConfig.of({**config, "t5": str(t5)}))
    with pytest.raises(ConfigError, match=r"has its own vocabulary and no T5; .* model\.text_encoder"):
        train(TrainingConfig.of({**config, "model.text_encoder": None}))


@pytest.mark.slow
def test_init_from_brings_its_tokenizer(t5_settings, t5, tmp_path) -> None:
    first = train(TrainingConfig.of(t5_settings))
    t5.rename(t5.with_name("elsewhere"))
    again = {**t5_settings, "t5": None, "init_from": str(first), "out": tmp_path / "again"}
    learner = build_learner(TrainingConfig.of(again))
    weights = load_checkpoint(checkpoints(first)[-1]).state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in learner.network.state_dict().items())
    assert checkpoints(train(TrainingConfig.of(again)))
