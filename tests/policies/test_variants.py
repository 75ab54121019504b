"""Variants of networks: each switch forward, backward and acting, and what is refused."""

from dataclasses import asdict, replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.errors import ConfigError  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from openvima.policies.config import config_from_dict, config_to_dict  # noqa: E402
from openvima.policies.inference import NetworkPolicy  # noqa: E402
from openvima.policies.nn.policy_network import PolicyNetwork  # noqa: E402
from openvima.policies.processor import Processor  # noqa: E402
from openvima.policies.variants import SWITCHES, with_variant  # noqa: E402
from openvima.training.config import ModelConfig  # noqa: E402
from training_examples import collate_examples, examples_of  # noqa: E402

VARIANTS = [
    ("vima-nano", {"conditioning": "prefix"}),
    ("nano-bins", {"conditioning": "prefix"}),
    ("flamingo-nano", {"conditioning": "prefix"}),
    ("midas-nano", {"conditioning": "cross-attention"}),
]
UNUSED = ("images.appearance.weight", "images.appearance.bias")  # of pretraining


def network_of(config) -> PolicyNetwork:
    """In double precision, with outputs that depend visibly on everything; fresh heads start near zero."""
    network = build_network(config, seed=3).double()
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return network.eval()


def tiny(name: str, switches: dict):
    """The variant, with a smaller head, which has most of the parameters and is not under test."""
    config = preset(name)
    return with_variant(replace(config, head=replace(config.head, hidden_width=16)), switches)


def act_twice(policy: NetworkPolicy, starts) -> list[np.ndarray]:
    policy.reset([env.prompt for env, _ in starts])
    for _ in range(2):
        actions = policy.act([observation for _, observation in starts])
    return [np.concatenate(list(action.values())) for action in actions]


@pytest.mark.parametrize(("name", "switches"), VARIANTS)
def test_a_variant_learns_and_acts(name, switches, demonstrations, starts) -> None:
    config = tiny(name, switches)
    assert config != preset(name)
    assert config_from_dict(config_to_dict(config)) == config
    assert with_variant(config, switches) == config

    network = network_of(config)
    processor = Processor.of(config.inputs)
    examples, images = examples_of(demonstrations[-2:], processor)
    batch = collate_examples(processor, examples)
    features = network.encode_images(images)
    prompt = network.encode_prompt(batch.prompts, features)
    loss, _ = network.loss(prompt, batch.history, features, batch.targets)
    loss.backward()
    without = [
        key
        for key, p in network.named_parameters()
        if p.requires_grad and (p.grad is None or not p.grad.any())
    ]
    assert [key for key in without if key not in UNUSED] == []

    policy = NetworkPolicy(network)
    together = act_twice(policy, starts[:2])
    alone = [act_twice(policy, [start])[0] for start in starts[:2]]
    assert np.array_equal(together, alone)
    assert not np.array_equal(together[0], together[1])


def test_training_has_a_setting_for_every_switch() -> None:
    assert set(asdict(ModelConfig())) == set(SWITCHES)
    assert with_variant(preset("nano"), asdict(ModelConfig())) == preset("nano")


def test_conditioning_keeps_the_size_of_the_decoder() -> None:
    """Both directions of the switch are inverse, and the published sizes differ by less than 2 %."""
    config = preset("vima-2m")
    prefix = with_variant(config, {"conditioning": "prefix"})
    assert prefix.decoder == preset("gato-2m").decoder
    assert with_variant(prefix, {"conditioning": "cross-attention"}) == config


@pytest.mark.parametrize(
    ("name", "switches", "words"),
    [
        ("vima-nano", {"conditioning": "suffix"}, "conditioning.*suffix.*cross-attention"),
        ("vima-nano", {"colour": "red"}, "colour"),
        ("nano", {"conditioning": "prefix"}, "pointer models have cross-attention alone; take nano-bins"),
    ],
)
def test_what_is_not_allowed_says_why_in_one_line(name, switches, words) -> None:
    with pytest.raises(ConfigError, match=words) as error:
        with_variant(preset(name), switches)
    assert "\n" not in str(error.value)
