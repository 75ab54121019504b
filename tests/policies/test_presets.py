"""Presets: their sizes, configs in files, and errors that name a wrong field."""

import pytest
import torch
import yaml

from openvima.errors import ConfigError, UnknownPolicyError
from openvima.policies import PRESETS, preset, register_policy
from openvima.policies.build import (
    build_network,
    config_from_dict,
    config_to_dict,
)
from openvima.policies.nn.action_head import NUM_BINS
from openvima.policies.presets import PUBLISHED, SIZE_NAMES
from openvima.policies.sizes import SIZES, VOCABULARY_SIZE


@pytest.mark.parametrize("name", ["nano", "nano-bins"])
def test_presets_have_the_size_that_they_promise(name: str) -> None:
    model = build_network(preset(name), seed=0)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert 2e6 < count < 4e6  # "about 3 M"
    assert model.prompt.words.num_embeddings == VOCABULARY_SIZE
    assert all(p.dtype == torch.float32 for p in model.parameters())


def test_the_bins_preset_classifies_over_the_published_bins() -> None:
    model = build_network(preset("nano-bins"), seed=0)
    assert tuple(layers[-1].out_features for layers in model.head.classifiers) == NUM_BINS


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_survives_its_file(name: str) -> None:
    text = yaml.safe_dump(config_to_dict(preset(name)))
    assert config_from_dict(yaml.safe_load(text)) == preset(name)


def test_every_size_of_every_published_architecture_is_a_preset() -> None:
    assert tuple(SIZES) == SIZE_NAMES
    published = {f"{name}-{size}" for name in PUBLISHED for size in SIZES}
    assert set(PRESETS) == {"nano", "nano-bins", "small"} | published


def test_an_unknown_preset_gets_a_suggestion() -> None:
    with pytest.raises(UnknownPolicyError, match=r"no preset 'nanno'. Did you mean 'nano'\?"):
        preset("nanno")


def test_a_file_with_a_field_too_many_names_it_and_those_allowed() -> None:
    with pytest.raises(ConfigError, match=r"policy has unknown fields depth; allowed: images, prompt"):
        config_from_dict({**config_to_dict(preset("nano")), "depth": 3})


def test_a_file_that_is_no_mapping_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be a mapping"):
        config_from_dict([])  # type: ignore[arg-type]


def test_a_learner_of_ones_own_has_a_name(tmp_path, monkeypatch) -> None:
    from openvima.policies import presets
    from openvima.training import TrainingConfig
    from openvima.training.building import resolve

    file = tmp_path / "named_learner.py"
    lines = ("from openvima.policies import register_policy", "@register_policy('mine')", "def make(): ...")
    file.write_text("\n".join(lines))
    monkeypatch.setattr(presets, "_own", {})
    monkeypatch.setenv(presets.POLICY_FILES_VARIABLE, str(file))
    presets._load_own_files.cache_clear()
    try:
        assert presets.own_policies() == {"mine": f"{file}:make"}
        config = TrainingConfig(data=tmp_path, out=tmp_path / "run", preset="mine")
        assert resolve(config).preset == f"{file}:make"
    finally:
        presets._load_own_files.cache_clear()


@pytest.mark.parametrize("name", ["nano", "a:b", ""])
def test_a_name_that_cannot_be_registered_is_refused(name) -> None:
    with pytest.raises(ConfigError, match="a policy is named"):
        register_policy(name)
