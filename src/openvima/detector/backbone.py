"""Residual network and feature pyramid: from an image to features at several resolutions.

Source: Deep Residual Learning (He et al. 2016); Feature Pyramid Networks (Lin et al. 2017).
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.config import BackboneConfig


class ConvNorm(nn.Module):
    """A convolution without bias, and batch normalisation.

    Args:
        inputs: Channels.
        outputs: Channels.
        kernel: Size in pixels.
        stride: Pixels between two outputs.
    """

    def __init__(self, inputs: int, outputs: int, *, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return self.norm(self.conv(x))


class Block(nn.Module):
    """Some convolutions, with a way around them.

    Args:
        inputs: Channels.
        outputs: Channels.
        stride: Of the whole block.
        config: Which kind of block.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int, config: BackboneConfig) -> None:
        super().__init__()
        if config.block == "basic":
            layers = [(inputs, outputs, 3, stride), (outputs, outputs, 3, 1)]
        else:
            inner = outputs // 4
            first, second = (stride, 1) if config.stride_first else (1, stride)
            layers = [(inputs, inner, 1, first), (inner, inner, 3, second), (inner, outputs, 1, 1)]
        self.layers = nn.ModuleList(ConvNorm(a, b, kernel=kernel, stride=s) for a, b, kernel, s in layers)
        self.shortcut = None
        if inputs != outputs or stride != 1:
            self.shortcut = ConvNorm(inputs, outputs, kernel=1, stride=stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        around = x if self.shortcut is None else self.shortcut(x)
        for number, layer in enumerate(self.layers):
            x = layer(x if number == 0 else F.relu(x))
        return F.relu(x + around)


class Backbone(nn.Module):
    """Features of an image at strides 4, 8, 16, …, all with the same number of channels.

        image ─ stem ─ stage ─ stage ─ stage ─ …          each at half the resolution of the one before
                         │       │       │
                       P2 ◄─── P3 ◄─── P4 ◄─ …  (─► one more)   what is coarse is enlarged and added

    Args:
        config: All sizes.
    """

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.frozen_norms = config.frozen_norms
        self.extra_level = config.extra_level
        self.stem = ConvNorm(3, config.stem_width, kernel=config.stem_kernel, stride=2)
        stages, inputs = [], config.stem_width
        for number, (depth, width) in enumerate(zip(config.depths, config.widths, strict=True)):
            blocks = []
            for place in range(depth):
                stride = 2 if number and not place else 1
                blocks.append(Block(inputs, width, stride=stride, config=config))
                inputs = width
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)
        out = config.pyramid_width
        self.lateral = nn.ModuleList(nn.Conv2d(width, out, 1) for width in config.widths)
        self.smooth = nn.ModuleList(nn.Conv2d(out, out, 3, padding=1) for _ in config.widths)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_uniform_(module.weight, a=1)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @property
    def divisor(self) -> int:
        """Height and width of images must be multiples of this."""
        return 4 * 2 ** (len(self.stages) - 1)

    def train(self, mode: bool = True) -> "Backbone":
        """Switch to training or evaluation; frozen norms stay in evaluation."""
        super().train(mode)
        if self.frozen_norms:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Map images (B, 3, H, W) to the levels of the pyramid, the finest first, each (B, C, h, w)."""
        x = F.max_pool2d(F.relu(self.stem(images)), kernel_size=3, stride=2, padding=1)
        laterals = []
        for stage, lateral in zip(self.stages, self.lateral, strict=True):
            x = stage(x)
            laterals.append(lateral(x))
        merged = laterals[-1]
        levels = [self.smooth[-1](merged)]
        for lateral, smooth in zip(reversed(laterals[:-1]), reversed(self.smooth[:-1]), strict=True):
            merged = lateral + F.interpolate(merged, scale_factor=2.0, mode="nearest")
            levels.insert(0, smooth(merged))
        if self.extra_level:
            levels.append(F.max_pool2d(levels[-1], kernel_size=1, stride=2))
        return levels
