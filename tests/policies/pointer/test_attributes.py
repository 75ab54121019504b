"""Comparison by the attributes that a prompt names: which are selected, and what they may change."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.action_head import shift_actions
from openvima.policies.nn.policy_network import StepInputs
from openvima.policies.pointer.config import ATTRIBUTES, AttributeConfig
from openvima.policies.pointer.inputs import HeadInputs
from openvima.policies.pointer.model import Pointer
from openvima.policies.pointer.words import Attributes
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from small_networks import (
    collate_examples,
    examples_of,
    narrow_small,
)

SAME = "Put all objects with the same profile as {base_obj} into it."
TOKENIZER = WordTokenizer(
    Vocabulary().extended([SAME, "texture colour and put the into rotate degrees object"])
)


@pytest.fixture(scope="module")
def demo() -> Demonstration:
    """`same_shape`, whose prompt names one attribute."""
    return rollout_oracle(TabletopEnv("same_shape", level="train", domain="user"), 1)


@pytest.fixture(scope="module")
def network() -> Pointer:
    """It knows the words "texture", "colour" and "profile", and "same" as a comparison."""
    network = build_network(replace(narrow_small(), attributes=AttributeConfig(16, 8)), seed=3).eval()
    assert isinstance(network, Pointer) and network.attributes is not None
    with torch.no_grad():
        for word in ("texture", "colour", "profile"):
            network.attributes.words.weight[TOKENIZER.encode(word), ATTRIBUTES.index(word)] = 0.1
        network.attributes.words.weight[TOKENIZER.encode("same"), -1] = 0.1
    return network.double()


@torch.no_grad()
def read(network: Pointer, demo: Demonstration, text: str = SAME, *, shift: float = 0.0) -> HeadInputs:
    """Inputs of the head; `shift` is added to all crop features."""
    demo = replace(demo, prompt=replace(demo.prompt, text=text))
    processor = Processor(*network.config.inputs, TOKENIZER)
    examples, images = examples_of([demo], processor)
    batch = collate_examples(processor, examples)
    features = network.encode_images(images) + shift * torch.linspace(-1, 1, 16).double()
    prompt = network.encode_prompt(batch.prompts, features)
    previous = shift_actions(batch.targets)
    step = StepInputs(prompt, network.init_cache(prompt), batch.history, features, *previous)
    return network._head_inputs(step)[0]


def selected(inputs: HeadInputs) -> list[str]:
    assert inputs.prompt.selected_BP is not None
    return [name for name, flag in zip(ATTRIBUTES, inputs.prompt.selected_BP[0], strict=True) if flag]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (SAME, ["profile"]),
        (SAME.replace("profile", "texture"), ["texture"]),
        (SAME.replace("profile", "colour and profile"), ["colour", "profile"]),
        (SAME.replace("same ", ""), []),
        (SAME.replace("profile", "object"), []),
    ],
)
def test_words_select_attributes_beside_a_comparison(network, demo, text, names):
    assert selected(read(network, demo, text)) == names


def test_the_word_decides_by_similarity_alone(network, demo):
    profile, texture = read(network, demo), read(network, demo, SAME.replace("profile", "texture"))
    assert torch.equal(profile.prompt.tokens_BLD, texture.prompt.tokens_BLD)
    assert torch.equal(profile.objects_BTND, texture.objects_BTND)
    pick = network.head.pick
    assert not torch.allclose(pick(profile), pick(texture))


def test_crops_reach_the_decoder_only_without_attributes(network, demo):
    same, other = read(network, demo), read(network, demo, shift=0.5)
    assert not torch.allclose(same.attributes_BTNX, other.attributes_BTNX)
    # What similar appearance finds may change; here nothing is found.
    assert torch.allclose(same.prompt.masked_BLD, other.prompt.masked_BLD)
    assert torch.equal(same.prompt.features.features_VNF, torch.zeros_like(same.prompt.features.features_VNF))
    plain = SAME.replace("same ", "")
    shown, shifted = read(network, demo, plain), read(network, demo, plain, shift=0.5)
    assert not torch.allclose(shown.prompt.tokens_BLD, shifted.prompt.tokens_BLD)
    assert shown.attributes_BTNX is None


def exclusive(network: Pointer) -> Pointer:
    """The same network, with exclusive attributes."""
    attributes = replace(network.config.attributes, exclusive=True)
    other = build_network(replace(network.config, attributes=attributes), seed=3).double().eval()
    other.load_state_dict(network.state_dict())
    return other


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_appearance_reaches_the_decoder_only_where_attributes_are_not_exclusive(network, demo, is_exclusive):
    first = exclusive(network) if is_exclusive else deepcopy(network)
    with torch.no_grad():
        for each in (first.correspondence, first.prompt_correspondence):
            each.threshold.fill_(-1)  # anything is found
    second = deepcopy(first)
    torch.nn.init.normal_(second.images.appearance.weight, generator=torch.Generator().manual_seed(1))
    same = torch.equal(read(first, demo).objects_BTND, read(second, demo).objects_BTND)
    assert same == is_exclusive
    plain = SAME.replace("same ", "")
    assert not torch.allclose(read(first, demo, plain).objects_BTND, read(second, demo, plain).objects_BTND)
    profile, texture = read(first, demo), read(first, demo, SAME.replace("profile", "texture"))
    assert torch.equal(profile.objects_BTND, texture.objects_BTND) != is_exclusive


def test_sizes_of_boxes_are_hidden_beside_exclusive_attributes(network, demo):
    objects = read(network, demo, SAME.replace("same ", "")).prompt.features
    larger = replace(objects, boxes_VN4=objects.boxes_VN4 + torch.tensor([0, 0, 3, 5]))
    attributes = exclusive(network).attributes
    none_BP = torch.zeros(1, len(ATTRIBUTES), dtype=torch.bool)
    for selected_BP, are_hidden in ((none_BP, False), (~none_BP, True)):
        embedded = attributes.embed(objects, selected_BP)
        shown, other = (attributes.hide_others(each, selected_BP, embedded) for each in (objects, larger))
        assert torch.equal(shown.boxes_VN4, other.boxes_VN4) == are_hidden
        assert torch.equal(shown.boxes_VN4[..., :2], objects.boxes_VN4[..., :2])


def test_a_prompt_that_selects_none_reads_the_same_beside_one_that_does(network, demo):
    policy = NetworkPolicy(network, tokenizer=TOKENIZER)
    plain = replace(demo.prompt, text=SAME.replace("same ", ""))
    policy.reset([plain])
    (alone,) = policy.act([demo.observation(0)])
    policy.reset([plain, replace(demo.prompt, text=SAME)])
    together, _ = policy.act([demo.observation(0)] * 2)
    for name, value in alone.items():
        assert value.tolist() == together[name].tolist()


def test_appearance_is_compared_with_texture_and_shape(network, demo):
    objects = read(network, demo, SAME.replace("same ", "")).prompt.features
    images = objects.features_VNF, objects.boxes_VN4, objects.masks_VN
    own, parts = network.object_encoder.embed_appearance(images[0], images[2]), network.attributes(*images)
    vectors = [own, *(parts[..., ATTRIBUTES.index(name), :] for name in ("texture", "shape"))]
    expected = sum(vector @ vector.mT for vector in vectors) / 3
    torch.testing.assert_close(objects.appearance_NA @ objects.appearance_NA.mT, expected)


def test_similarity_is_the_mean_cosine_of_the_selected_attributes(network, demo):
    inputs = read(network, demo, SAME.replace("profile", "colour and profile"))
    parts = inputs.attributes_BTNX.unflatten(-1, (len(ATTRIBUTES), -1))
    norms = parts.norm(dim=-1).square()[inputs.masks_BTN]
    expected = torch.tensor([0.0, 0.5, 0.0, 0.5, 0.0, 0.0]).double()
    torch.testing.assert_close(norms, expected.expand_as(norms))


def test_hidden_views_do_not_matter():
    attributes = Attributes(AttributeConfig(16, 8), narrow_small().images, 4).double()
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 3, 16, generator=generator).double()
    boxes = torch.randint(1, 60, (2, 3, 4), generator=generator)
    masks = torch.tensor([[True, True, False], [False, True, True]])
    other = torch.where(masks[..., None], features, -features)
    assert torch.equal(attributes(features, boxes, masks), attributes(other, boxes, masks))
    torch.testing.assert_close(attributes(features, boxes, masks).norm(dim=-1), torch.ones(3, 6).double())


def test_the_object_of_the_prompt_itself_is_not_meant_beside_exclusive_attributes(network, demo):
    inputs, pick = read(exclusive(network), demo), exclusive(network).head.pick
    cosines = torch.linspace(-0.5, 1.0, inputs.masks_BTN.shape[-1]).double()
    with torch.no_grad():
        attention = torch.softmax(pick._attention_scores(inputs), dim=-1)
        attended_BTA = (attention @ inputs.prompt.appearance_BLA[:, None]).mean(dim=2)
        attended_BTA = attended_BTA / attended_BTA.norm(dim=-1, keepdim=True) ** 2
        inputs = replace(inputs, appearance_BTNA=attended_BTA[:, :, None] * cosines[:, None])
        scale_BTH = pick._scale(inputs)
        pick.appearance_weight.fill_(-1.0)
        with_weight = pick.similarity(inputs, scale_BTH)
        pick.appearance_weight.fill_(0.0)
        lost_BTN = pick.similarity(inputs, scale_BTH) - with_weight
    expected = scale_BTH.sum(dim=-1, keepdim=True) * torch.relu(cosines - 0.7) / 0.3
    torch.testing.assert_close(lost_BTN, expected)
