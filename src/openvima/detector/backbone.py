"""ResNet with a feature pyramid network (FPN).

Source: Deep Residual Learning (He et al. 2016); Feature Pyramid Networks (Lin et al. 2017).
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.config import BackboneConfig
from openvima.detector.cpu_inference import is_cpu_inference, rectify_and_pool


class ConvNorm(nn.Module):
    """A convolution without bias, followed by batch normalisation.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        kernel: Kernel size.
        stride: Stride.
    """

    def __init__(self, inputs: int, outputs: int, *, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return self.norm(self.conv(x))


class ResidualBlock(nn.Module):
    """Convolutions with a shortcut.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        stride: Stride of the block.
        config: Decides the kind of block.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int, config: BackboneConfig) -> None:
        super().__init__()
        if config.block == "basic":
            layers = [(inputs, outputs, 3, stride), (outputs, outputs, 3, 1)]
        else:
            inner = outputs // 4
            first, second = (stride, 1) if config.stride_in_1x1 else (1, stride)
            layers = [(inputs, inner, 1, first), (inner, inner, 3, second), (inner, outputs, 1, 1)]
        self.layers = nn.ModuleList(ConvNorm(a, b, kernel=kernel, stride=s) for a, b, kernel, s in layers)
        self.shortcut = None
        if inputs != outputs or stride != 1:
            self.shortcut = ConvNorm(inputs, outputs, kernel=1, stride=stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        residual = x if self.shortcut is None else self.shortcut(x)
        for index, layer in enumerate(self.layers):
            x = layer(x if index == 0 else F.relu_(x))
        return F.relu_(x.add_(residual))


class Backbone(nn.Module):
    """A ResNet whose stages feed an FPN: features at strides 4, 8, 16, …, with equally many channels.

        image ─ stem ─ stage ─ stage ─ stage ─ …     each halves the resolution
                         │       │       │           lateral 1 × 1 convolutions
                        P2 ◄─── P3 ◄─── P4 ◄─ …      upsampled and added; (─► extra level by max pooling)

    Args:
        config: Sizes of the backbone.
    """

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.frozen_batch_norm = config.frozen_batch_norm
        self.extra_level = config.extra_level
        self.stem = ConvNorm(3, config.stem_width, kernel=config.stem_kernel, stride=2)
        stages, inputs = [], config.stem_width
        for stage, (depth, width) in enumerate(zip(config.depths, config.widths, strict=True)):
            blocks = []
            for block in range(depth):
                stride = 2 if stage and not block else 1
                blocks.append(ResidualBlock(inputs, width, stride=stride, config=config))
                inputs = width
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)
        out = config.fpn_width
        self.lateral = nn.ModuleList(nn.Conv2d(width, out, 1) for width in config.widths)
        self.smooth = nn.ModuleList(nn.Conv2d(out, out, 3, padding=1) for _ in config.widths)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_uniform_(module.weight, a=1)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @property
    def size_divisor(self) -> int:
        """Height and width of the input must be multiples of this."""
        return 4 * 2 ** (len(self.stages) - 1)

    def train(self, mode: bool = True) -> "Backbone":
        """Set the mode; frozen batch normalisation stays in evaluation mode."""
        super().train(mode)
        if self.frozen_batch_norm:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Map images (B, 3, H, W) to the pyramid levels, finest first, each (B, C, h, w)."""
        x = self.stem(images)
        if is_cpu_inference(x):
            x = rectify_and_pool(x)
        else:
            x = F.max_pool2d(F.relu_(x), kernel_size=3, stride=2, padding=1)
        laterals = []
        for stage, lateral in zip(self.stages, self.lateral, strict=True):
            x = stage(x)
            laterals.append(lateral(x))
        merged = laterals[-1]
        levels = [self.smooth[-1](merged)]
        for lateral, smooth in zip(reversed(laterals[:-1]), reversed(self.smooth[:-1]), strict=True):
            merged = F.interpolate(merged, scale_factor=2.0, mode="nearest").add_(lateral)
            levels.insert(0, smooth(merged))
        if self.extra_level:
            levels.append(F.max_pool2d(levels[-1], kernel_size=1, stride=2))
        return levels
