"""Vision transformer over a crop or a whole frame.

Shape suffixes: N images, C channels, P patches (after the class token, if there is one), H heads, W width, K
width of one head.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError
from openvima.policies.nn.linear import Linear

# Mean and standard deviation of R, G, B over training frames, as the published policies use them.
PIXEL_MEAN = (0.3471, 0.3429, 0.3383)
PIXEL_STD = (0.3011, 0.2961, 0.2956)


@dataclass(frozen=True, slots=True)
class VitConfig:
    """Sizes of the transformer.

    Args:
        width: Width of its tokens.
        num_layers: Residual blocks.
        num_heads: Attention heads in each.
        output_width: Length of a feature vector.
        patch_size: Side of a patch in pixels.
        image_height: Height of an image in pixels.
        image_width: Width of an image in pixels.
        class_token: Whether to return the class token, one vector per image, instead of one per patch.
    """

    width: int
    num_layers: int
    num_heads: int
    output_width: int
    patch_size: int = 16
    image_height: int = 32
    image_width: int = 32
    class_token: bool = True

    def __post_init__(self) -> None:
        if self.width % self.num_heads:
            raise ConfigError(
                f"image encoder: width {self.width} must be a multiple of {self.num_heads} heads."
            )
        height, width = self.image_height, self.image_width
        if height % self.patch_size or width % self.patch_size:
            raise ConfigError(
                f"image encoder: {self.patch_size} px patches do not tile {height} × {width} px."
            )

    @property
    def num_patches(self) -> int:
        """Number of patches of an image."""
        return (self.image_height // self.patch_size) * (self.image_width // self.patch_size)


class VisionTransformer(nn.Module):
    """Class token, if any, and patches of one image -> pre-norm blocks -> features.

    For a 32 × 32 crop in patches of 16: [class, upper left, upper right, lower left, lower right].
    """

    pixel_mean: torch.Tensor
    pixel_std: torch.Tensor

    def __init__(self, config: VitConfig) -> None:
        super().__init__()
        width, scale = config.width, config.width**-0.5
        # Constants are created on the CPU, so that they exist under `MetaInit`, too.
        mean, std = torch.tensor(PIXEL_MEAN, device="cpu"), torch.tensor(PIXEL_STD, device="cpu")
        self.register_buffer("pixel_mean", mean.view(3, 1, 1), persistent=False)
        self.register_buffer("pixel_std", std.view(3, 1, 1), persistent=False)
        self.patches = nn.Conv2d(3, width, config.patch_size, stride=config.patch_size, bias=False)
        self.class_token = nn.Parameter(torch.randn(width) * scale) if config.class_token else None
        self.positions = nn.Parameter(torch.randn(config.num_patches + config.class_token, width) * scale)
        self.norm_before = nn.LayerNorm(width)
        self.blocks = nn.ModuleList(VitBlock(width, config.num_heads) for _ in range(config.num_layers))
        self.norm_after = nn.LayerNorm(width)
        self.projection = nn.Linear(width, config.output_width, bias=False)
        nn.init.normal_(self.projection.weight, std=scale)

    def forward(self, images_NCYX: torch.Tensor) -> torch.Tensor:
        """Encode images.

        Args:
            images_NCYX: Shape (N, 3, height, width), uint8, or floating-point in the same range of 0 to 255.

        Returns:
            Shape (N, output_width), or (N, P, output_width) without a class token, in the precision of the
            weights.
        """
        pixels = images_NCYX.to(self.positions.dtype) / 255  # a copy, so the next operations can be in place
        x_NPW = self.patches(pixels.sub_(self.pixel_mean).div_(self.pixel_std)).flatten(2).transpose(1, 2)
        if self.class_token is not None:
            x_NPW = torch.cat([self.class_token.expand(len(x_NPW), 1, -1), x_NPW], dim=1)
        x_NPW = self.norm_before(x_NPW + self.positions)
        *blocks, last_block = self.blocks
        for block in blocks:
            x_NPW = block(x_NPW)
        if self.class_token is None:
            return self.projection(self.norm_after(last_block(x_NPW)))
        return self.projection(self.norm_after(last_block(x_NPW, num_queries=1)[:, 0]))


class VitBlock(nn.Module):
    """Pre-norm self-attention and MLP, both added to their input."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.norm_attention = nn.LayerNorm(width)
        self.query_key_value = Linear(width, 3 * width)
        self.attention_out = Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.widen = Linear(width, 4 * width)
        self.narrow = Linear(4 * width, width)

    def forward(self, x_NPW: torch.Tensor, *, num_queries: int | None = None) -> torch.Tensor:
        """Map tokens to tokens, shape (N, P, W); only the first `num_queries` if given."""
        packed = self.query_key_value(self.norm_attention(x_NPW))
        # (N, P, 3·W) -> (3, N, H, P, K)
        query, key, value = packed.unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(query[:, :, :num_queries], key, value)
        x_NPW = x_NPW[:, :num_queries] + self.attention_out(mixed.transpose(1, 2).flatten(2))
        hidden = self.widen(self.norm_mlp(x_NPW))
        return x_NPW + self.narrow(hidden * torch.sigmoid(1.702 * hidden))  # QuickGELU


def encode_frames(encoder: VisionTransformer, frames: torch.Tensor) -> torch.Tensor:
    """Encode frames (..., 3, height, width), uint8, to (..., F), or (..., P, F) without class token."""
    return encoder(frames.flatten(0, -4)).unflatten(0, frames.shape[:-3])
