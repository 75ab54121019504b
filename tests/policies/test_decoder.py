"""The decoder, and the network around it."""

import pytest
import torch

from openvima.errors import PolicyError
from openvima.policies import preset
from openvima.policies.build import build_network
from openvima.policies.nn.actions import from_unit_range, to_unit_range
from openvima.policies.nn.decoder import (
    CausalDecoder,
    Decoder,
    DecoderConfig,
    PrefixDecoder,
    PrefixDecoderConfig,
)
from openvima.policies.nn.layers import (
    Linear,
    Unpadder,
    round_rows,
)
from openvima.policies.nn.prompt_encoder import relative_bucket
from openvima.policies.pointer.inputs import yaw_to_bin
from openvima.policies.processor import Processor
from small_networks import check_mixed_precision, collate_examples, examples_of


@pytest.fixture(params=["decoder", "prefix"])
def decoder(request) -> CausalDecoder:
    torch.manual_seed(0)
    if request.param == "decoder":
        return Decoder(DecoderConfig(width=16, num_layers=2, num_self_heads=2, num_cross_heads=2)).eval()
    return PrefixDecoder(PrefixDecoderConfig(width=16, num_layers=2, num_heads=2)).eval()


def test_decoding_in_pieces_equals_decoding_at_once(decoder) -> None:
    tokens, prompt = torch.randn(2, 9, 16), torch.randn(2, 3, 16)
    mask = torch.rand(2, 9) > 0.3
    mask[:, 0] = True  # an output that attends to nothing has no meaning
    cache = decoder.init_cache(prompt, torch.tensor([[True, True, True], [True, True, False]]))
    expected, _ = decoder(cache, tokens, mask)
    state, pieces = cache, []
    for start, stop in ((0, 1), (1, 5), (5, 9)):
        piece, state = decoder(state, tokens[:, start:stop], mask[:, start:stop])
        pieces.append(piece)
    torch.testing.assert_close(torch.cat(pieces, dim=1), expected)


def test_invalid_positions_are_zero_and_change_nothing(decoder) -> None:
    tokens, prompt = torch.randn(3, 6, 16), torch.randn(3, 2, 16)
    exist = torch.tensor([[True] * 6, [True] * 4 + [False] * 2, [True, False, True, True, False, False]])
    mask = exist.clone()
    mask[0, 5] = mask[1, 3] = False  # computed, but not attended to
    cache = decoder.init_cache(prompt, torch.ones(3, 2, dtype=torch.bool))
    expected, whole = decoder(cache, tokens, mask)
    actual, packed = decoder(cache, tokens, mask, exist)
    torch.testing.assert_close(actual[exist], expected[exist])
    assert not actual[~exist].any()
    later, mask = torch.randn(3, 2, 16), torch.ones(3, 2, dtype=torch.bool)
    torch.testing.assert_close(decoder(packed, later, mask)[0], decoder(whole, later, mask)[0])


def test_too_long_a_history_is_refused(decoder) -> None:
    tokens, prompt = torch.zeros(1, 513, 16), torch.zeros(1, 1, 16)
    mask = torch.ones(1, 513, dtype=torch.bool)
    length = 513 if isinstance(decoder, Decoder) else 515  # prompt and separator count there
    with pytest.raises(PolicyError, match=f"history has {length} tokens; this policy takes 512"):
        decoder(decoder.init_cache(prompt, mask[:, :1]), tokens, mask)
    tokens, mask = torch.zeros(1, 600, 16), torch.arange(600)[None] % 2 == 0  # masked ones do not count
    outputs, _ = decoder(decoder.init_cache(prompt, mask[:, :1]), tokens, mask)
    assert outputs.isfinite().all()


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


@pytest.mark.parametrize("name", ["nano", "vima-nano", "gato-nano"])
@pytest.mark.slow
def test_mixed_precision_gives_nearly_the_same_loss_and_finite_gradients(name, demonstrations):
    network = build_network(preset(name), seed=0).eval()
    processor = Processor(*network.config.inputs)
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
    torch.testing.assert_close(in_prompt_ND[:, 1:], objects_ND[:, 1:], atol=1e-5, rtol=0)
    scene_ND = network.add_end_effector(objects_ND[None, None], torch.zeros(1, 1, dtype=torch.long))[0, 0]
    decoder = network.decoder
    if name == "vima-nano":
        block = decoder.cross_blocks[0]
        query_ND, key_ND = block.query(block.norm_attention(scene_ND)), block.key_value(in_prompt_ND)[:, :128]
    else:  # half of the heads, which see the scene as well
        project = decoder.self_blocks[0].query_key_value
        query_ND, key_ND = project(scene_ND)[:, :64], project(torch.cat([in_prompt_ND, scene_ND]))[:, 128:192]
    assert (query_ND @ key_ND.T).argmax(dim=1).tolist() == [0, 1, 2, 3, 4, 5]


def test_fresh_attention_of_the_prompt_sees_neighbours_and_past_actions_are_heard():
    network = build_network(preset("vima-nano"), seed=0)
    numbers = torch.arange(60)
    offset_LL = numbers[None] - numbers[:, None]
    attention_LLH = network.prompt.text.position_bias(relative_bucket(offset_LL)).softmax(dim=1)
    for head, is_near_LL in enumerate(
        ((offset_LL >= -3) & (offset_LL < 0), (offset_LL > 0) & (offset_LL <= 3))
    ):
        assert (attention_LLH[..., head] * is_near_LL).sum(dim=1)[3:57].min() > 0.8
    generator = torch.Generator().manual_seed(0)
    tokens_ND = network.head.actions(torch.rand(200, 12, generator=generator))
    assert 0.3 < tokens_ND.std(dim=0).square().mean().sqrt() < 0.9  # image tokens: 0.4


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(300, 24), (90, 5, 24)])
def test_outputs_and_gradients_are_those_of_torch(shape, bias):
    torch.manual_seed(0)
    ours = Linear(24, 17, bias=bias)
    x, gradient = torch.randn(shape), torch.randn(*shape[:-1], 17)
    results = []
    for layer in (ours, torch.nn.functional.linear):
        inputs = x.clone().requires_grad_()
        ours.zero_grad()
        out = ours(inputs) if layer is ours else layer(inputs, ours.weight, ours.bias)
        out.backward(gradient)
        found = [out.detach(), inputs.grad, ours.weight.grad]
        results.append([tensor.clone() for tensor in found + ([ours.bias.grad] if bias else [])])
    for actual, expected in zip(*results, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


def test_rows_take_few_numbers_and_grow_little():
    counts = range(1, 20_000)
    rounded = [round_rows(count) for count in counts]
    assert all(0 <= new - old <= old / 16 for old, new in zip(counts, rounded, strict=True))
    assert len({new for new in rounded if new >= 256}) < 130


def test_rounded_rows_change_neither_outputs_nor_gradients():
    torch.manual_seed(0)
    valid = torch.rand(40, 20) < 0.5
    x = torch.randn(40, 20, 8, requires_grad=True)
    unpadder = Unpadder(valid)
    rows = unpadder.unpad(x)
    assert len(rows) == round_rows(int(valid.sum())) > int(valid.sum())
    unpadder.pad(3 * rows).square().sum().backward()
    torch.testing.assert_close(x.grad, 18 * x.detach() * valid[..., None])
    torch.testing.assert_close(unpadder.pad(rows), x.detach() * valid[..., None])
