"""Layers for inference on a CPU against those for training and naive implementations."""

import numpy as np
import pytest

import naive_detection as naive

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: E402

from openvima.detector.config import small  # noqa: E402
from openvima.detector.layers import MaskHead  # noqa: E402
from openvima.detector.roi_align import (  # noqa: E402
    align_levels,
    is_cpu_inference,
    normalise,
    pyramid_align,
    rectify_and_pool,
)

LEVELS = {"canonical_size": 48, "canonical_level": 1}


def test_they_take_the_place_of_those_for_training_only_without_gradients():
    assert not is_cpu_inference(torch.zeros(1))
    with torch.no_grad():
        assert is_cpu_inference(torch.zeros(1))
        assert not is_cpu_inference(torch.zeros(1, device="meta"))


def test_pixels_are_normalised_and_padded():
    pixels = torch.arange(2 * 3 * 5 * 7).view(2, 3, 5, 7).to(torch.uint8)
    mean, std = torch.tensor([10.0, 20, 30]), torch.tensor([2.0, 3, 7])
    expected = F.pad((pixels - mean.view(3, 1, 1)) / std.view(3, 1, 1), (0, 1, 0, 3))
    assert torch.equal(normalise(pixels, mean, std, height=8, width=8), expected)


@pytest.mark.parametrize(("height", "width"), [(6, 10), (5, 7), (1, 1), (2, 3)])
def test_pooling_equals_relu_and_max_pooling(height, width):
    x = torch.randn(2, 3, height, width, generator=torch.Generator().manual_seed(0))
    for given in (x, x.to(memory_format=torch.channels_last)):
        assert torch.equal(rectify_and_pool(given), F.max_pool2d(F.relu(x), 3, stride=2, padding=1))


@pytest.mark.parametrize("sampling_ratio", [0, 1, 2, 3])
def test_aligned_features_agree_with_the_naive_twin(sampling_ratio):
    rng = np.random.default_rng(sampling_ratio)
    levels = [torch.from_numpy(rng.normal(size=(2, 3, 16 // 2**k, 24 // 2**k))) for k in range(3)]
    low = rng.uniform(-20, 80, (20, 2))
    boxes = torch.from_numpy(np.concatenate([low, low + rng.uniform(0.1, 120, (20, 2))], axis=1))
    images, indices = torch.arange(20) % 2, torch.arange(20) % 3
    cells = align_levels(
        levels, boxes, images, indices, size=3, sampling_ratio=sampling_ratio, first_stride=4
    )
    for number, (box, image, level) in enumerate(zip(boxes, images, indices, strict=True)):
        for channel in range(3):
            expected = naive.roi_align(
                levels[level][image, channel].numpy(),
                tuple(box.tolist()),
                size=3,
                stride=4 * 2 ** int(level),
                sampling_ratio=sampling_ratio,
            )
            assert np.allclose(cells[number, channel], expected, atol=1e-12)


def test_aligned_features_are_those_of_training():
    generator = torch.Generator().manual_seed(0)
    levels = [torch.randn(2, 4, 32 // 2**k, 64 // 2**k, generator=generator) for k in range(3)]
    low = 100 * torch.rand(9, 2, generator=generator)
    boxes = torch.cat([low, low + 100 * torch.rand(9, 2, generator=generator)], dim=1)
    sizes = {"size": 7, "sampling_ratio": 2, "first_stride": 4}
    trained = pyramid_align(levels, boxes, torch.arange(9) % 2, **sizes, **LEVELS)
    with torch.no_grad():
        assert torch.allclose(
            pyramid_align(levels, boxes, torch.arange(9) % 2, **sizes, **LEVELS), trained, atol=1e-5
        )
        assert pyramid_align(levels, boxes[:0], torch.arange(0), **sizes, **LEVELS).shape == (0, 4, 7, 7)


def test_mask_logits_are_those_of_training():
    torch.manual_seed(0)
    head = MaskHead(small())
    torch.nn.init.normal_(head.deconv.bias)
    features = torch.randn(3, 32, 14, 14)
    with torch.no_grad():
        inference = head(features)
    assert torch.allclose(inference, head(features), atol=1e-6)
