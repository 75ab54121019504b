"""Coreference: words and the images that followed the same word before."""

import pytest
import torch

from openvima.env import TabletopEnv
from openvima.policies.batch import PromptBatch
from openvima.policies.build import build_network
from openvima.policies.pointer.words import coreference
from openvima.policies.processor import Processor
from small_networks import narrow_small

WORD = -1
# This is a wug I . put the wug into the J . the K L
WORDS = [1, 2, 3, 4, 0, 5, 6, 7, 4, 8, 7, 0, 5, 7, 0, 0]
IMAGES = [WORD] * 4 + [0] + [WORD] * 6 + [1] + [WORD] * 2 + [2, 3]


def weights(words: list[int], images: list[int], exist: torch.Tensor | None = None) -> torch.Tensor:
    """Attention weights of one prompt."""
    mask = torch.ones(1, len(words), dtype=torch.bool) if exist is None else exist
    objects = torch.zeros(2, 0, dtype=torch.int64)
    prompt = PromptBatch(
        torch.tensor([words]),
        torch.tensor([images]),
        mask,
        torch.zeros_like(mask),
        objects,
        objects[..., None].expand(2, 0, 4),
        objects.bool(),
        torch.zeros(0, 2),
        objects[0],
        objects[0].bool(),
    )
    return coreference(prompt)


def test_a_word_refers_to_the_image_of_one_object_that_followed_it_before():
    attention = weights(WORDS, IMAGES)[0]
    assert {tuple(pair) for pair in attention.nonzero().tolist()} == {(8, 4), (13, 11)}
    assert attention.sum() == 2


def test_attention_is_uniform_over_several_images():
    words, images = [4, 0, 4, 0, 4, 4], [WORD, 0, WORD, 1, WORD, WORD]
    attention = weights(words, images)[0]
    assert attention[2].tolist() == [0, 1, 0, 0, 0, 0]
    assert attention[4].tolist() == attention[5].tolist() == [0, 0.5, 0, 0.5, 0, 0]


def test_padding_refers_to_nothing_and_nothing_to_it():
    exist = torch.arange(len(WORDS))[None] < 8
    assert weights(WORDS, IMAGES, exist).sum() == 0
    assert weights(WORDS[:1], IMAGES[:1], exist[:, :1]).shape == (1, 1, 1)


@pytest.fixture(scope="module")
def network():
    return build_network(narrow_small(), seed=3).double().eval()


@pytest.fixture(scope="module")
def prompt():
    env = TabletopEnv("novel_noun", level="train", domain="user")
    env.reset(seed=3)
    return env.prompt


@torch.no_grad()
def _encoded(network, prompt):
    batch, stack = Processor.of(network.config.inputs).encode_prompts([prompt])
    features = network.encode_images(torch.from_numpy(stack.images()))
    return network.encode_prompt(batch, features), batch


def test_a_noun_has_the_appearance_of_the_image_that_defined_it(network, prompt):
    encoded, prompts = _encoded(network, prompt)
    attention = coreference(prompts)[0]
    nouns = attention.any(dim=1).nonzero()[:, 0]
    assert len(nouns) == 2  # the instruction names both, and "a" is followed by no image
    is_image = prompts.object_index_BL[0] >= 0
    assert torch.equal(encoded.object_mask_BL[0], is_image | attention.any(dim=1))
    for noun in nouns:
        (image,) = attention[noun].nonzero()[:, 0]
        assert torch.equal(encoded.appearance_BLA[0, noun], encoded.appearance_BLA[0, image])
        assert encoded.appearance_BLA[0, noun].norm() > 0.9
