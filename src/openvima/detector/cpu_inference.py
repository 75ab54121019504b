"""Layers for inference on a CPU, which take less time than those for training; equal but for rounding."""

from collections.abc import Sequence

import numpy as np
import torch

from openvima.detector.kernels import align, look_up, relu_and_pool


def is_cpu_inference(tensor: torch.Tensor) -> bool:
    """Return whether these layers compute with a tensor: it is in main memory, and needs no gradients."""
    return tensor.device.type == "cpu" and not torch.is_grad_enabled()


def normalise(
    pixels: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, *, height: int, width: int
) -> torch.Tensor:
    """Normalise images (B, 3, H, W), uint8, and pad them with zeros to (B, 3, height, width)."""
    table = (torch.arange(256) - mean.view(3, 1)) / std.view(3, 1)
    normalised = torch.zeros(len(pixels), height, width, 3)
    look_up(pixels.numpy(), table.numpy(), normalised.numpy())
    return normalised.permute(0, 3, 1, 2)


def rectify_and_pool(x: torch.Tensor) -> torch.Tensor:
    """Apply ReLU and max pooling over 3 × 3 pixels with stride 2: (B, C, H, W) to (B, C, H / 2, W / 2)."""
    rows = _channels_last(x)
    count, height, width, channels = rows.shape
    pooled = torch.empty(count, (height + 1) // 2, (width + 1) // 2, channels, dtype=x.dtype)
    relu_and_pool(rows, pooled.numpy())
    return pooled.permute(0, 3, 1, 2)


def align_levels(
    levels: Sequence[torch.Tensor],
    boxes: torch.Tensor,
    images: torch.Tensor,
    indices: torch.Tensor,
    *,
    size: int,
    sampling_ratio: int,
    first_stride: int,
) -> torch.Tensor:
    """Apply RoIAlign as `pyramid_align` does; `indices` (R,) are the levels of the boxes."""
    pooled = torch.empty(len(boxes), levels[0].shape[1], size, size, dtype=levels[0].dtype)
    arrays = boxes.numpy(), images.numpy(), indices.numpy()
    for level, features in enumerate(levels):
        stride = first_stride * 2**level
        align(_channels_last(features), *arrays, level, stride, sampling_ratio, pooled.numpy())
    return pooled


def _channels_last(x: torch.Tensor) -> np.ndarray:
    """Map (B, C, H, W) to (B, H, W, C)."""
    return x.permute(0, 2, 3, 1).contiguous().numpy()
