"""The vocabulary of a run: the words of its prompts, kept by its checkpoints, extended by fine-tuning."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from openvima.data import (
    Dataset,
    GenerateConfig,
    generate,
)
from openvima.env import EnvConfig, TabletopEnv
from openvima.errors import ConfigError, InputFileError, UnknownWordWarning
from openvima.evaluation import score
from openvima.evaluation.sources import policy_sources
from openvima.policies import load_policy, preset
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.naming import TOKENIZER_FOLDER
from openvima.policies.pointer.config import AttributeConfig
from openvima.policies.presets import PRESETS
from openvima.policies.sizes import VOCABULARY_SIZE
from openvima.policies.tokenizer import UNKNOWN, Vocabulary, WordTokenizer, benchmark_vocabulary
from openvima.training import TrainingConfig, train
from openvima.training.behaviour_cloning import freezes_crops
from openvima.training.building import (
    build_learner,
    resolve,
    training_texts,
)
from small_networks import narrow_small

WORDS = {
    *("rotate", "the", "degrees", ".", "put", "into", "sweep", "without", "exceeding"),
    *("any", "one", "two", "three", "all"),
}


@pytest.mark.parametrize("name", ["small", "nano-bins", "gato-nano"])
def test_every_preset_with_a_vocabulary_takes_new_words(name: str) -> None:
    env = TabletopEnv("visual_manipulation")
    observation, _ = env.reset(seed=0)
    sizes = preset(name)
    vocabulary = Vocabulary().extended([env.prompt.text, "between"])
    size = vocabulary.size_for(sizes.prompt.vocabulary_size)
    assert size == VOCABULARY_SIZE
    policy = NetworkPolicy(build_network(sizes, seed=0), tokenizer=WordTokenizer(vocabulary))
    between, quokka = (
        replace(env.prompt, text=f"{env.prompt.text} {word}") for word in ("Between", "Quokka")
    )
    policy.reset([between])
    with pytest.warns(UnknownWordWarning, match="'quokka'"):
        policy.reset([between, quokka])
    assert all(action is not None for action in policy.act([observation] * 2))


def test_the_vocabulary_is_that_of_the_prompts_and_is_compared_when_a_run_resumes(settings) -> None:
    excluded = {"loader.exclude_tasks": "sweep_without_exceeding"}
    config = TrainingConfig.of({**settings, **excluded, "pretraining.steps": 0, "schedule.steps": 2})
    run = train(config)
    (source,) = policy_sources([str(run)])
    assert source.record()["excluded_tasks"] == ["sweep_without_exceeding"]
    stored = next((run / "checkpoints").glob("2-*")) / TOKENIZER_FOLDER
    vocabulary = Vocabulary.read(stored)
    assert (
        UNKNOWN in vocabulary.words and {"rotate", "into", "."} <= set(vocabulary.words) - {UNKNOWN} <= WORDS
    )
    assert not {"sweep", "exceeding"} & set(vocabulary.words)
    assert load_policy(str(run)).processor.tokenizer.vocabulary == vocabulary  # type: ignore[attr-defined]
    assert vocabulary.digest() in (run / "config.yaml").read_text(encoding="utf-8")

    vocabulary.extended(["quokka"]).write(stored)
    with pytest.raises(InputFileError, match="another vocabulary, with"):
        train(config)


def test_crops_that_nothing_trains_are_refused(settings) -> None:
    frozen = {"pretraining.steps": 0, "pretraining.finetune_crop_encoder": False}
    with pytest.raises(ConfigError, match="finetune_crop_encoder is False, but nothing has trained"):
        resolve(TrainingConfig.of({**settings, **frozen}))


def test_fine_tuning_adds_new_words_to_those_of_the_checkpoint(settings, tmp_path: Path) -> None:
    config = resolve(TrainingConfig.of({**settings, "pretraining.steps": 0, "schedule.steps": 2}))
    first = build_learner(config, ["put the red bowl"])
    (tmp_path / "first").mkdir()
    first.write(tmp_path / "first")
    again = replace(config, init_from=str(tmp_path / "first"))
    second = build_learner(again, ["put it between"])
    before, after = (learner.processor.tokenizer.vocabulary for learner in (first, second))
    assert after.words == (*before.words, "between", "it") and after.texture_words == ("red",)
    weights = second.network.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in first.network.state_dict().items())

    many = [
        f"x-{'abcdefghij'[n % 10]}{'abcdefghij'[n // 10 % 10]}{'abcdefghij'[n // 100]}" for n in range(500)
    ]
    third = build_learner(again, many)  # more than the reserve
    words = third.network.prompt.words.weight
    assert len(words) > VOCABULARY_SIZE and third.network.config.prompt.vocabulary_size == len(words)
    assert torch.equal(words[:VOCABULARY_SIZE], first.network.prompt.words.weight)
    assert torch.equal(third.network.query, first.network.query)


def test_fine_tuning_compares_attributes_as_the_checkpoint_does(
    settings, tmp_path: Path, monkeypatch
) -> None:
    sizes = replace(narrow_small(), attributes=AttributeConfig(hidden_width=8, width=4))
    for name, exclusive in (("shared", False), ("exclusive", True)):
        own = replace(sizes, attributes=replace(sizes.attributes, exclusive=exclusive))
        monkeypatch.setitem(PRESETS, name, lambda own=own: own)
    steps = {"pretraining.steps": 0, "schedule.steps": 2}
    config = resolve(TrainingConfig.of({**settings, **steps, "preset": "shared"}))
    first = build_learner(config, ["put it there"])
    (tmp_path / "first").mkdir()
    first.write(tmp_path / "first")
    again = replace(config, preset="exclusive", init_from=str(tmp_path / "first"))
    assert build_learner(again, ["put it there"]).network.config == first.network.config
    fresh = build_learner(replace(again, init_from=None), ["put it there"])
    assert fresh.network.config.attributes.exclusive


def test_crops_come_from_weights_of_another_architecture_and_stay_frozen(settings) -> None:
    of_vima = {**settings, "pretraining.steps": None, "crops_from": "openvima-vima"}
    config = resolve(TrainingConfig.of({**of_vima, "preset": "midas-nano"}))
    network, theirs = build_learner(config, ["put it there"]).network, load_network("openvima-vima")[0]
    ours = network.object_encoder.crop_encoder.state_dict()
    for name, tensor in theirs.object_encoder.crop_encoder.state_dict().items():
        assert torch.equal(ours[name], tensor)
    assert config.pretraining.steps == 0 and freezes_crops(network, config)
    for name, message in (
        ("gato-nano", "the preset takes whole frames"),
        ("nano", "the preset matches objects by an embedding"),
    ):
        with pytest.raises(ConfigError, match=f"crops_from is 'openvima-vima', but {message}"):
            build_learner(resolve(TrainingConfig.of({**of_vima, "preset": name})), ["put it there"])
    wider = {**of_vima, "preset": "vima-2m", "model.text_encoder": "small"}
    with pytest.raises(ConfigError, match=r"whose crop encoder is .*width=96.* Leave it out"):
        build_learner(resolve(TrainingConfig.of(wider)), ["put it there"])


def test_weights_of_another_architecture_are_refused_without_a_list_of_all_sizes(settings) -> None:
    config = TrainingConfig.of({**settings, "preset": "vima-nano", "init_from": "openvima-small"})
    with pytest.raises(ConfigError, match=r"sizes: architecture is 'pointer' there and 'vima' here\. Give"):
        build_learner(resolve(config), ["put it there"])


def test_words_of_the_augmentation_are_in_the_vocabulary(data: Path, settings) -> None:
    config = TrainingConfig.of(settings)
    dataset = Dataset(data)
    plain = Vocabulary().extended(training_texts(dataset, config.augmentation))
    augmentation = replace(config.augmentation, rename_objects_prob=0.5, inverse_dynamics_prob=0.5)
    augmented = Vocabulary().extended(training_texts(dataset, augmentation))
    assert set(plain.words) - {UNKNOWN} <= WORDS
    added = {"this", "is", "a", "dax", "blicket", "wug", "zup", "follow", "motion", ":"}
    assert set(augmented.words) - set(plain.words) == added - set(plain.words)
    assert added <= set(benchmark_vocabulary().words)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::openvima.errors.UnknownWordWarning")  # textures beyond these few
def test_a_network_learns_from_text_and_is_scored_on_it(settings: dict, tmp_path) -> None:
    config = GenerateConfig(
        out=tmp_path / "demos", tasks=("rotate",), episodes=6, env_config=EnvConfig(prompts="mixed")
    )
    changes = {"data": generate(config), "pretraining.steps": 0, "schedule.steps": 2, "loader.batch_size": 2}
    run = train(TrainingConfig.of({**settings, **changes}))
    results = score(
        {"mine": load_policy(str(run))}, tasks=("rotate",), levels=("L1",), episodes=1, prompts="mixed"
    )
    assert results.config["prompts"] == "mixed"
