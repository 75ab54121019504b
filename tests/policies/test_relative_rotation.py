"""Relative rotation between two images of an object."""

import math

import pytest
import torch

from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.object_encoder import (
    ObjectEncoder,
    ObjectEncoderConfig,
    RelativeRotation,
)

BINS = 72
FRONT, TOP = 0, 1


@pytest.fixture
def encoder() -> ObjectEncoder:
    torch.manual_seed(0)
    crop = ConvConfig(8, 16, place_channels=2)
    sizes = ObjectEncoderConfig(
        crop, box_width=4, width=8, fuse_views=True, appearance_width=16, rotation_bins=BINS
    )
    return ObjectEncoder(sizes)


def _features(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, 2, 3, 16, generator=torch.Generator().manual_seed(len(shape)))


VISIBLE = torch.ones(2, 3, dtype=torch.bool)


def test_probabilities_of_rotations_sum_to_one(encoder):
    probabilities = encoder.rotation_between(_features(4, 5), _features(1, 5), VISIBLE, VISIBLE)
    assert probabilities.shape == (4, 5, 3, BINS)
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(4, 5, 3))


def test_exchanging_the_images_inverts_the_rotation(encoder):
    first, second = _features(), _features(1)[0]
    there = encoder.rotation_between(first, second, VISIBLE, VISIBLE)
    back = encoder.rotation_between(second, first, VISIBLE, VISIBLE)
    torch.testing.assert_close(there, back.flip(-1).roll(1, -1))


def test_equal_crops_are_not_rotated(encoder):
    probabilities = encoder.rotation_between(_features(), _features(), VISIBLE, VISIBLE)
    assert (probabilities.argmax(-1) == 0).all()


def test_the_top_view_decides_where_it_shows_both(encoder):
    first, second = _features(), _features(1)[0]
    probabilities = encoder.rotation_between(first, second, VISIBLE, VISIBLE)
    other_front = first.clone()
    other_front[FRONT] += 1.0
    assert torch.equal(probabilities, encoder.rotation_between(other_front, second, VISIBLE, VISIBLE))

    hidden = VISIBLE.clone()
    hidden[TOP, 1] = False
    of_front = encoder.rotation_between(first, second, hidden, VISIBLE)
    assert torch.equal(of_front[[0, 2]], probabilities[[0, 2]])
    assert not torch.equal(of_front[1], probabilities[1])


def test_without_a_common_view_the_distribution_is_uniform(encoder):
    only_top, only_front = VISIBLE.clone(), VISIBLE.clone()
    only_top[FRONT], only_front[TOP] = False, False
    probabilities = encoder.rotation_between(_features(), _features(1)[0], only_top, only_front)
    torch.testing.assert_close(probabilities, torch.full((3, BINS), 1 / BINS))


def test_shifted_phases_are_a_rotation():
    estimator = RelativeRotation(features=256, bins=BINS)
    with torch.no_grad():
        for view in estimator.views:  # features are the harmonics themselves
            view.weight.copy_(torch.eye(256))
            view.bias.zero_()
    angle = 2 * math.pi * 17 / BINS
    harmonics = torch.randn(16, 8, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    rotated = harmonics * torch.exp(1j * angle * torch.arange(1, 9))
    first, second = (
        torch.stack([w.real, w.imag]).flatten().expand(2, 1, 256).contiguous() for w in (harmonics, rotated)
    )
    visible = torch.ones(2, 1, dtype=torch.bool)
    assert int(estimator(first, second, visible, visible).argmax()) == 17
