"""Words that a picture explained before."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.policies.nn.referents import referents  # noqa: E402

from naive_inputs import Reader, batch_prompts  # noqa: E402
from openvima.env import TabletopEnv  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from small_networks import narrow_small  # noqa: E402

WORD = -1
# This is a wug I . put the wug into the J . the K L
WORDS = [1, 2, 3, 4, 0, 5, 6, 7, 4, 8, 7, 0, 5, 7, 0, 0]
IMAGES = [WORD] * 4 + [0] + [WORD] * 6 + [1] + [WORD] * 2 + [2, 3]


def _places(*rows: list[int]) -> torch.Tensor:
    return torch.tensor(rows)


def test_a_word_refers_to_the_picture_of_one_object_that_stood_behind_it_before():
    exist = torch.ones(1, len(WORDS), dtype=torch.bool)
    shares = referents(_places(WORDS), _places(IMAGES), exist)[0]
    assert {tuple(pair) for pair in shares.nonzero().tolist()} == {(8, 4), (13, 11)}
    assert shares.sum() == 2


def test_several_pictures_share_a_word_equally():
    words, images = [4, 0, 4, 0, 4, 4], [WORD, 0, WORD, 1, WORD, WORD]
    shares = referents(_places(words), _places(images), torch.ones(1, 6, dtype=torch.bool))[0]
    assert shares[2].tolist() == [0, 1, 0, 0, 0, 0]
    assert shares[4].tolist() == shares[5].tolist() == [0, 0.5, 0, 0.5, 0, 0]


def test_padding_refers_to_nothing_and_nothing_to_it():
    exist = torch.arange(len(WORDS))[None] < 8
    assert referents(_places(WORDS), _places(IMAGES), exist).sum() == 0
    assert referents(_places(WORDS[:1]), _places(IMAGES[:1]), exist[:, :1]).shape == (1, 1, 1)


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
    read = Reader.of(network.config.inputs).read_prompt(prompt)
    images = torch.from_numpy(read.objects.crops.reshape(-1, 3, 32, 32))
    batch = batch_prompts([read], [np.arange(len(images)).reshape(2, -1)])
    return network.encode_prompt(batch, network.encode_images(images)), batch


def test_a_noun_looks_as_the_picture_that_explained_it(network, prompt):
    memory, prompts = _encoded(network, prompt)
    shares = referents(prompts.word_ids_BL, prompts.object_index_BL, prompts.mask_BL)[0]
    nouns = shares.any(dim=1).nonzero()[:, 0]
    assert len(nouns) == 2  # the instruction names both, and "a" stands before no picture
    is_image = prompts.object_index_BL[0] >= 0
    assert torch.equal(memory.object_mask_BL[0], is_image | shares.any(dim=1))
    for noun in nouns:
        (picture,) = shares[noun].nonzero()[:, 0]
        assert torch.equal(memory.appearance_BLA[0, noun], memory.appearance_BLA[0, picture])
        assert memory.appearance_BLA[0, noun].norm() > 0.9


def test_how_much_a_word_stands_for_its_picture_is_learnt(network, prompt):
    outputs = []
    for weight in (-1e3, 0.0):
        with torch.no_grad():
            network.prompt.refers.bias.fill_(weight)
        outputs.append(_encoded(network, prompt)[0].tokens_BLD)
    plain = replace(network.config, prompt=replace(network.config.prompt, referents=False))
    without = build_network(plain, seed=3).double().eval()
    assert without.prompt.refers is None
    without.load_state_dict(network.state_dict(), strict=False)
    torch.testing.assert_close(_encoded(without, prompt)[0].tokens_BLD, outputs[0])
    assert (outputs[1] - outputs[0]).abs().max() > 1e-3
