"""Correspondence: what attends to what, which difference it rerotations, and what makes no difference."""

from dataclasses import fields, replace

import pytest
import torch

from openvima.env import TabletopEnv
from openvima.policies.batch import PromptBatch
from openvima.policies.build import build_network
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.object_encoder import ObjectEncoder, ObjectEncoderConfig
from openvima.policies.pointer.config import CorrespondenceConfig
from openvima.policies.pointer.correspondence import (
    Correspondence,
    ObjectFeatures,
    in_earlier_image,
)
from openvima.policies.pointer.words import coreference
from openvima.policies.processor import Processor
from small_networks import narrow_small

B, N, M, V, F, A, D = 2, 3, 4, 2, 6, 5, 8
IMAGES = ObjectEncoderConfig(
    ConvConfig(4, F), box_width=4, width=D, fuse_views=True, appearance_width=A, rotation_bins=8
)


def inputs(count: int, seed: int, **known) -> ObjectFeatures:
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    values = {
        "features_VNF": drawn(B, V, count, F),
        "boxes_VN4": torch.randint(10, 100, (B, V, count, 4), generator=generator),
        "masks_VN": torch.ones(B, V, count, dtype=torch.bool),
        "appearance_NA": torch.nn.functional.normalize(drawn(B, count, A), dim=-1),
        "positions_N2": drawn(B, count, 2) * 0.1,
        "in_scene_N": torch.ones(B, count, dtype=torch.bool),
        "image_index_N": torch.zeros(B, count, dtype=torch.int64),
    }
    return ObjectFeatures(**{**values, **known})


def placed(some: ObjectFeatures, order) -> ObjectFeatures:
    """The same objects in another order."""
    axes = {"features_VNF": -2, "boxes_VN4": -2, "positions_N2": -2, "appearance_NA": -2}
    values = {
        field.name: getattr(some, field.name).index_select(axes.get(field.name, -1), order)
        for field in fields(some)
    }
    return ObjectFeatures(**values)


@pytest.fixture
def encoder() -> ObjectEncoder:
    torch.manual_seed(0)
    return ObjectEncoder(IMAGES).double().eval()


@pytest.fixture
def correspondence() -> Correspondence:
    torch.manual_seed(0)
    return Correspondence(CorrespondenceConfig(hidden_width=16), IMAGES).double().eval()


ANY = torch.ones(N, M, dtype=torch.bool)


def weights(
    correspondence: Correspondence, own: ObjectFeatures, other: ObjectFeatures, allowed=ANY
) -> "torch.Tensor":
    """Attention weights, (B, H, N, M)."""
    kept = []
    original = correspondence._weights
    correspondence._weights = lambda *values: kept.append(original(*values)) or kept[-1]
    correspondence(own, other, allowed, lambda *_: torch.zeros(B, allowed.shape[-2], 8, dtype=torch.float64))
    del correspondence._weights
    return kept[0]


def test_each_object_attends_to_the_most_similar_one(correspondence):
    other = inputs(M, seed=1)
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, [2, 0, 3]])
    attention = weights(correspondence, own, other)
    assert (attention.argmax(-1) == torch.tensor([2, 0, 3])).all()
    assert (attention.amax(-1) > 0.9).all()


def test_an_object_without_a_similar_one_attends_to_nothing(correspondence):
    other = inputs(M, seed=1, appearance_NA=torch.eye(A, dtype=torch.float64)[:M].expand(B, M, A))
    lonely = torch.eye(A, dtype=torch.float64)[M:].expand(B, N, A)
    assert weights(correspondence, inputs(N, seed=2, appearance_NA=lonely), other).sum(-1).max() < 0.01


def test_of_similar_images_one_head_takes_the_latest_and_one_the_earliest(correspondence):
    same = torch.nn.functional.normalize(torch.ones(B, 4, A, dtype=torch.float64), dim=-1)
    frames = inputs(4, seed=1, appearance_NA=same, image_index_N=torch.arange(4).expand(B, 4))
    attention = weights(correspondence, frames, frames, in_earlier_image(frames, frames))
    assert (attention[:, 0, 3].argmax(-1) == 2).all()
    assert (attention[:, 1, 3].argmax(-1) == 0).all()
    assert (attention[:, :, 0] == 0).all()  # nothing is earlier than the first image
    assert (attention.diagonal(dim1=-2, dim2=-1) == 0).all()


def test_only_the_displacement_is_returned_if_all_else_is_equal(correspondence):
    before = inputs(N, seed=1)
    way = torch.tensor([0.05, -0.02], dtype=torch.float64)
    after = replace(before, positions_N2=before.positions_N2 + way)
    returned = []
    correspondence.difference.register_forward_pre_hook(lambda _, arguments: returned.append(arguments[0]))
    match = torch.eye(N, dtype=torch.bool)
    correspondence(after, before, match, lambda *_: torch.zeros(B, N, 8, dtype=torch.float64))
    per_head = returned[0][..., :-8].unflatten(-1, (2, -1))
    found, likeness, lying, near, along, across = per_head[..., :6].unbind(-1)
    assert (found > 0.999).all()
    torch.testing.assert_close(likeness, found)
    torch.testing.assert_close(lying, found)
    assert ((near > 0.01) & (near < 0.1)).all()
    torch.testing.assert_close(along, found * 0.5)
    torch.testing.assert_close(across, found * -0.2)
    torch.testing.assert_close(per_head[..., 6:], torch.zeros_like(per_head[..., 6:]), atol=1e-9, rtol=0)


def test_positions_of_objects_alone_have_no_effect(correspondence, encoder):
    other = inputs(M, seed=1, in_scene_N=torch.zeros(B, M, dtype=torch.bool))
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, :N])
    moved = replace(other, positions_N2=other.positions_N2 + 0.3)
    rotations = encoder.rotation_between
    assert torch.equal(
        correspondence(own, other, ANY, rotations)[0], correspondence(own, moved, ANY, rotations)[0]
    )


def test_neither_order_nor_what_does_not_exist_matters(correspondence, encoder):
    masks = torch.ones(B, V, M, dtype=torch.bool)
    masks[:, :, 3] = False
    other = inputs(M, seed=1, masks_VN=masks)
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, [3, 1, 0]])
    returned, rotations = correspondence(own, other, ANY, encoder.rotation_between)
    order, own_order = torch.tensor([1, 3, 0, 2]), torch.tensor([2, 0, 1])
    mixed, mixed_rotations = correspondence(
        placed(own, own_order), placed(other, order), ANY, encoder.rotation_between
    )
    torch.testing.assert_close(mixed, returned[:, own_order])
    torch.testing.assert_close(mixed_rotations, rotations[:, own_order])
    features = other.features_VNF.clone()
    features[:, :, 3] = 9.0
    changed = replace(other, features_VNF=features)
    assert torch.equal(correspondence(own, changed, ANY, encoder.rotation_between)[0], returned)
    fewer = placed(other, torch.arange(3))
    torch.testing.assert_close(correspondence(own, fewer, ANY[:, :3], encoder.rotation_between)[0], returned)


def test_rotations_are_those_from_the_attended_object(correspondence, encoder):
    """Attention to a single image returns its features unchanged."""
    before = inputs(N, seed=1)
    after = replace(inputs(N, seed=2), appearance_NA=before.appearance_NA)
    _, rotations = correspondence(after, before, torch.eye(N, dtype=torch.bool), encoder.rotation_between)
    asked = encoder.rotation_between(before.features_VNF, after.features_VNF, before.masks_VN, after.masks_VN)
    torch.testing.assert_close(rotations, asked, atol=1e-6, rtol=1e-4)


def test_crops_are_dropped_in_training(encoder):
    images = replace(IMAGES, crop_dropout=0.5)
    torch.manual_seed(0)
    module = Correspondence(CorrespondenceConfig(hidden_width=16), images).double()
    before = inputs(N, seed=1)
    own = inputs(N, seed=2, appearance_NA=before.appearance_NA)
    seen = []
    module.difference.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    match = torch.eye(N, dtype=torch.bool)
    for _ in range(20):
        module(own, before, match, encoder.rotation_between)
    front = torch.stack(seen)[..., 6 : 6 + F]
    left_out = (front == 0).all(-1).double().mean()
    assert 0.3 < left_out < 0.7


WORD = -1
# This is a wug I . put the wug into the J . the K L
WORDS = [1, 2, 3, 4, 0, 5, 6, 7, 4, 8, 7, 0, 5, 7, 0, 0]
IMAGES_COREFERENCE = [WORD] * 4 + [0] + [WORD] * 6 + [1] + [WORD] * 2 + [2, 3]


def weights_of_coreference(
    words: list[int], images: list[int], exist: torch.Tensor | None = None
) -> torch.Tensor:
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
    attention = weights_of_coreference(WORDS, IMAGES_COREFERENCE)[0]
    assert {tuple(pair) for pair in attention.nonzero().tolist()} == {(8, 4), (13, 11)}
    assert attention.sum() == 2


def test_attention_is_uniform_over_several_images():
    words, images = [4, 0, 4, 0, 4, 4], [WORD, 0, WORD, 1, WORD, WORD]
    attention = weights_of_coreference(words, images)[0]
    assert attention[2].tolist() == [0, 1, 0, 0, 0, 0]
    assert attention[4].tolist() == attention[5].tolist() == [0, 0.5, 0, 0.5, 0, 0]


def test_padding_refers_to_nothing_and_nothing_to_it():
    exist = torch.arange(len(WORDS))[None] < 8
    assert weights_of_coreference(WORDS, IMAGES_COREFERENCE, exist).sum() == 0
    assert weights_of_coreference(WORDS[:1], IMAGES_COREFERENCE[:1], exist[:, :1]).shape == (1, 1, 1)


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
    batch, stack = Processor(*network.config.inputs).encode_prompts([prompt])
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
