"""Building networks, and the ranges of actions."""

from dataclasses import replace

import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies import preset
from openvima.policies.build import build_network
from openvima.policies.nn.actions import from_unit_range, to_unit_range
from openvima.policies.pointer.inputs import yaw_to_bin
from openvima.policies.processor import Processor
from small_networks import check_mixed_precision, collate_examples, examples_of


def test_fresh_weights_follow_from_the_seed_and_leave_global_state_alone(small_sizes):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (build_network(small_sizes, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(torch.rand(3), expected)
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name])
    assert not torch.equal(first.prompt.words.weight, other.prompt.words.weight)


def test_unit_range_undoes_itself_and_clips():
    actions = torch.tensor([[0.3, -0.4, 0.0, 0.0, 0.6, 0.8, 0.7, 0.5, 0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(from_unit_range(to_unit_range(actions)), actions)
    outside = from_unit_range(torch.full((1, 12), 2.0))
    assert outside[0, :2].tolist() == [0.75, 0.5]


def test_yaw_bins_are_centred_on_whole_steps():
    yaws = torch.deg2rad(torch.tensor([0.0, 2.4, 2.6, -2.6, 180.0, -180.0, 357.6]))
    assert yaw_to_bin(yaws, 72).tolist() == [0, 0, 1, 71, 36, 36, 0]


def test_images_and_decoder_of_different_widths_are_refused():
    sizes = preset("nano")
    with pytest.raises(ConfigError, match="make them equal"):
        replace(sizes, decoder=replace(sizes.decoder, width=64))


@pytest.mark.parametrize(
    "name", ["nano", "nano-bins", "vima-nano", "gato-nano", "flamingo-nano", "gpt-nano", "midas-nano"]
)
@pytest.mark.slow
def test_mixed_precision_gives_nearly_the_same_loss_and_finite_gradients(name, demonstrations):
    network = build_network(preset(name), seed=0).eval()
    processor = Processor.of(network.config.inputs)
    examples, images = examples_of(demonstrations, processor)
    batch = collate_examples(processor, examples)

    def loss() -> torch.Tensor:
        features = network.encode_images(images)
        prompt = network.encode_prompt(batch.prompts, features)
        return network.loss(prompt, batch.history, features, batch.targets)[0]

    check_mixed_precision(network, loss)


@pytest.mark.parametrize("name", ["vima-nano", "midas-nano"])
def test_fresh_attention_finds_the_object_that_the_prompt_shows(name):
    network = build_network(preset(name), seed=0).eval()
    generator = torch.Generator().manual_seed(0)
    objects_ND = torch.randn(6, 128, generator=generator)
    in_prompt_ND = network.prompt.images(objects_ND)
    torch.testing.assert_close(in_prompt_ND, objects_ND, atol=1e-5, rtol=0)
    scene_ND = network.add_end_effector(objects_ND[None, None], torch.zeros(1, 1, dtype=torch.long))[0, 0]
    decoder = network.decoder
    if name == "vima-nano":
        block = decoder.cross_blocks[0]
        query_ND, key_ND = block.query(block.norm_attention(scene_ND)), block.key_value(in_prompt_ND)[:, :128]
    else:
        query_ND = decoder.self_blocks[0].query_key_value(scene_ND)[:, :128]
        key_ND = decoder.self_blocks[0].query_key_value(in_prompt_ND)[:, 128:256]
    assert (query_ND @ key_ND.T).argmax(dim=1).tolist() == [0, 1, 2, 3, 4, 5]
