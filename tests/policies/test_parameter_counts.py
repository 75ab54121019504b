"""Parameters by part: nothing is left out, and decoders have the sizes that presets are named after."""

from dataclasses import replace

import pytest

from openvima.policies import PRESETS, preset
from openvima.policies.build import (
    PARTS,
    Count,
    build_network,
    count_parameters,
    outline_network,
    policy_size,
)
from openvima.policies.presets import PUBLISHED

# Millions of parameters in the blocks of the published VIMA.
DECODERS = {"2m": 2.10, "4m": 4.20, "9m": 9.85, "20m": 18.90, "43m": 41.99, "92m": 91.83, "200m": 207.76}


@pytest.mark.parametrize(("size", "millions"), DECODERS.items())
def test_the_decoder_of_vima_has_the_published_size(size: str, millions: float) -> None:
    assert policy_size(preset(f"vima-{size}")).parts["decoder"].total / 1e6 == pytest.approx(
        millions, abs=5e-3
    )


@pytest.mark.parametrize("size", DECODERS)
@pytest.mark.slow
def test_the_decoders_of_all_architectures_are_of_equal_size(size: str) -> None:
    decoders = [policy_size(preset(f"{name}-{size}")).parts["decoder"].total for name in PUBLISHED]
    assert max(decoders) < 1.003 * min(decoders)  # self blocks have biases, cross blocks none


@pytest.mark.parametrize("name", ["small", *(name for name in PRESETS if "nano" in name or "2m" in name)])
def test_every_parameter_belongs_to_one_part(name: str) -> None:
    network = outline_network(preset(name))
    for parameter, _ in network.named_parameters():
        owners = [part for part, prefixes in PARTS.items() if parameter.startswith(prefixes)]
        expected = 2 if parameter.startswith("head.actions.") else 1  # of two the first counts, "actions"
        assert len(owners) == expected, (parameter, owners)
    total = policy_size(preset(name)).parameters
    assert total.total == sum(parameter.numel() for parameter in network.parameters())


def test_an_outline_counts_what_a_network_has() -> None:
    sizes = preset("flamingo-nano")
    sizes = replace(sizes, prompt=replace(sizes.prompt, train_words=False, trained_layers=1))
    network = build_network(sizes, seed=0)
    parts = policy_size(sizes).parts
    assert parts == count_parameters(network)
    frozen = sum(parameter.numel() for parameter in network.parameters() if not parameter.requires_grad)
    assert parts["prompt"].frozen == policy_size(sizes).parameters.frozen == frozen > 0


def test_of_t5_words_and_all_but_two_layers_are_frozen() -> None:
    layer = 4 * 768 * 768 + 2 * 768 * 3072 + 2 * 768
    words, position_biases = 32128 * 768, 32 * 12
    size = policy_size(preset("vima-2m"))
    assert size.parts["prompt"].frozen == words + position_biases + 10 * layer
    assert all(count.frozen == 0 for part, count in size.parts.items() if part != "prompt")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("nano", ("pointer", 128, 2, 4)),
        ("vima-200m", ("vima", 768, 11, 24)),
        ("gato-200m", ("gato", 768, 22, 24)),
        ("flamingo-2m", ("flamingo", 256, 1, 8)),
        ("gpt-9m", ("gpt", 320, 6, 10)),
        ("midas-92m", ("midas", 640, 14, 20)),
    ],
)
def test_architecture_width_layers_and_heads_are_reported(name: str, expected: tuple) -> None:
    size = policy_size(preset(name))
    assert (size.architecture, size.width, size.num_layers, size.num_heads) == expected


def test_a_count_adds_up() -> None:
    assert Count(trainable=3, frozen=4).total == 7
