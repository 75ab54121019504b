"""Base class of policies and parameter counts of networks."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml

from openvima.errors import ConfigError, MissingExtraError, PolicyError
from openvima.policies import PRESETS, RandomPolicy, load_policy, preset, register_policy
from openvima.policies.build import (
    PARTS,
    build_network,
    config_from_dict,
    config_to_dict,
    count_parameters,
    outline_network,
)
from openvima.policies.presets import PUBLISHED, SIZE_NAMES
from openvima.policies.sizes import SIZES
from openvima.scene import Action


def test_without_torch_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'openvima\[train\]'"):
        load_policy("untrained")


def test_random_actions_are_valid_and_follow_from_seed_and_prompt_alone(demonstrations):
    prompts = [demo.prompt for demo in demonstrations]
    policy, state = RandomPolicy(seed=3), np.random.get_state()[1].copy()
    policy.reset(prompts)
    together = policy.act([{}] * len(prompts))
    for prompt, action in zip(prompts, together, strict=True):
        Action.from_arrays(action)
        assert {value.dtype for value in action.values()} == {np.dtype(np.float32)}
        for seed in (3, 4):
            alone = load_policy("random", seed=seed)
            alone.reset([prompt])
            (other,) = alone.act([{}])
            assert all((other[key] == action[key]).all() for key in action) == (seed == 3)
    assert len({action["pose0_position"].tobytes() for action in together}) == len(prompts)
    assert (np.random.get_state()[1] == state).all()
    first, second = policy.act([None, {}, *[None] * (len(prompts) - 2)])[:2]
    assert first is None and second is not None
    with pytest.raises(PolicyError, match=f"1 observations for {len(prompts)} prompts"):
        policy.act([{}])


# Millions of parameters in the blocks of the published VIMA.
DECODERS = {"2m": 2.10, "4m": 4.20, "9m": 9.85, "20m": 18.90, "43m": 41.99, "92m": 91.83, "200m": 207.76}


@pytest.mark.parametrize(("size", "millions"), DECODERS.items())
def test_the_decoder_of_vima_has_the_published_size(size: str, millions: float) -> None:
    counts = count_parameters(outline_network(preset(f"vima-{size}")))
    assert counts["decoder"].total / 1e6 == pytest.approx(millions, abs=5e-3)


@pytest.mark.parametrize("size", ["2m", "200m"])
@pytest.mark.slow
def test_the_decoders_of_all_architectures_are_of_equal_size(size: str) -> None:
    networks = [outline_network(preset(f"{name}-{size}")) for name in PUBLISHED]
    decoders = [count_parameters(network)["decoder"].total for network in networks]
    assert max(decoders) < 1.003 * min(decoders)  # self blocks have biases, cross blocks none


@pytest.mark.parametrize("name", ["small", *(name for name in PRESETS if "nano" in name or "2m" in name)])
def test_every_parameter_belongs_to_one_part(name: str) -> None:
    sizes = preset(name)
    if getattr(sizes, "has_object_tokens", False):
        sizes = replace(sizes, points=True)
    network = outline_network(sizes)
    for parameter, _ in network.named_parameters():
        owners = [part for part, prefixes in PARTS.items() if parameter.startswith(prefixes)]
        expected = 2 if parameter.startswith("head.actions.") else 1  # of two the first counts, "actions"
        assert len(owners) == expected, (parameter, owners)
    assert count_parameters(network)["total"].total == sum(
        parameter.numel() for parameter in network.parameters()
    )


def test_an_outline_counts_what_a_network_has() -> None:
    sizes = preset("flamingo-nano")
    sizes = replace(sizes, prompt=replace(sizes.prompt, train_words=False, trained_layers=1))
    network = build_network(sizes, seed=0)
    counts = count_parameters(outline_network(sizes))
    assert counts == count_parameters(network)
    frozen = sum(parameter.numel() for parameter in network.parameters() if not parameter.requires_grad)
    assert counts["prompt"].frozen == counts["total"].frozen == frozen > 0


def test_of_t5_words_and_all_but_two_layers_are_frozen() -> None:
    layer = 4 * 768 * 768 + 2 * 768 * 3072 + 2 * 768
    words, position_biases = 32128 * 768, 32 * 12
    counts = count_parameters(outline_network(preset("vima-2m")))
    assert counts["prompt"].frozen == counts["total"].frozen == words + position_biases + 10 * layer


def test_every_size_of_every_published_architecture_is_a_preset_that_survives_its_file() -> None:
    assert tuple(SIZES) == SIZE_NAMES
    published = {f"{name}-{size}" for name in PUBLISHED for size in SIZES}
    assert set(PRESETS) == {"nano", "nano-bins", "small"} | published
    for name in PRESETS:
        text = yaml.safe_dump(config_to_dict(preset(name)))
        assert config_from_dict(yaml.safe_load(text)) == preset(name)


def test_a_file_with_a_field_too_many_names_it_and_those_allowed() -> None:
    with pytest.raises(ConfigError, match=r"policy has unknown fields depth; allowed: images, prompt"):
        config_from_dict({**config_to_dict(preset("nano")), "depth": 3})
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
    presets.own_policies.cache_clear()
    try:
        assert presets.own_policies() == {"mine": f"{file}:make"}
        config = TrainingConfig(data=tmp_path, out=tmp_path / "run", preset="mine")
        assert resolve(config).preset == f"{file}:make"
    finally:
        presets.own_policies.cache_clear()


@pytest.mark.parametrize("name", ["nano", "a:b", ""])
def test_a_name_that_cannot_be_registered_is_refused(name) -> None:
    with pytest.raises(ConfigError, match="a policy is named"):
        register_policy(name)
