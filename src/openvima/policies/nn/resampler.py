"""The resampler of VIMA-Flamingo: a few learned latents attend to many patches.

Source: Perceiver IO (Jaegle et al. 2021), in the shape that the published VIMA-Flamingo code has.

Shape suffixes: N pairs of frames, P patches, M latents, H heads, D width, K width of a head.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.mlp import normal_weights


@dataclass(frozen=True, slots=True)
class ResamplerConfig:
    """Sizes of the resampler.

    Args:
        num_latents: Number of output tokens.
        num_blocks: Passes through the self-attention layers, with shared weights.
        num_layers: Self-attention layers.
        num_heads: Heads of each layer.
        dropout: Dropout probability of attention weights.
        initial_std: Standard deviation of fresh weights.
    """

    num_latents: int = 4
    num_blocks: int = 4
    num_layers: int = 4
    num_heads: int = 8
    dropout: float = 0.1
    initial_std: float = 0.02


class Resampler(nn.Module):
    """Cross-attention from latents to patches, then self-attention among the latents."""

    def __init__(self, config: ResamplerConfig, width: int) -> None:
        super().__init__()
        self.num_blocks = config.num_blocks
        self.latents = nn.Parameter(torch.randn(config.num_latents, width) * config.initial_std)
        self.cross_layer = ResamplerLayer(width, config, cross_attention=True)
        self.self_layers = nn.ModuleList(ResamplerLayer(width, config) for _ in range(config.num_layers))
        normal_weights(self, config.initial_std)

    def forward(self, patches: torch.Tensor) -> torch.Tensor:
        """Resample patches, shape (..., P, D), to latents, shape (..., M, D)."""
        patches_NPD = patches.flatten(0, -3)
        x_NMD = self.cross_layer(self.latents.expand(len(patches_NPD), -1, -1), patches_NPD)
        for _ in range(self.num_blocks):
            for layer in self.self_layers:
                x_NMD = layer(x_NMD)
        return x_NMD.unflatten(0, patches.shape[:-2])


class ResamplerLayer(nn.Module):
    """Pre-norm attention and feed-forward of equal width, both residual."""

    def __init__(self, width: int, config: ResamplerConfig, *, cross_attention: bool = False) -> None:
        super().__init__()
        self.num_heads, self.dropout = config.num_heads, config.dropout
        self.norm_attention = nn.LayerNorm(width)
        self.norm_source = nn.LayerNorm(width) if cross_attention else None
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        self.attention_out = nn.Linear(width, width)
        self.norm_feed_forward = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(self, x_NMD: torch.Tensor, source_NPD: torch.Tensor | None = None) -> torch.Tensor:
        """Map latents to latents; keys and values come from the source, or from the latents themselves."""
        normed = self.norm_attention(x_NMD)
        source = normed if self.norm_source is None else self.norm_source(source_NPD)
        query, key, value = (
            linear(tokens).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)  # (N, H, P, K)
            for linear, tokens in ((self.query, normed), (self.key, source), (self.value, source))
        )
        dropout = self.dropout if self.training else 0.0
        mixed = F.scaled_dot_product_attention(query, key, value, dropout_p=dropout)
        x_NMD = x_NMD + self.attention_out(mixed.transpose(1, 2).flatten(2))
        return x_NMD + self.out(F.gelu(self.hidden(self.norm_feed_forward(x_NMD))))
