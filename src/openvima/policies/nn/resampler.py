"""The resampler: a few learned latents attend to many patches (VIMA-Flamingo), or to objects.

Source: Perceiver IO (Jaegle et al. 2021), in the shape that the published VIMA-Flamingo code has.

Shape suffixes: N pairs of frames, P patches or objects, M latents, H heads, D width, K width of a head.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError
from openvima.policies.nn.decoder import attention_bias
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

    def __post_init__(self) -> None:
        if self.num_latents < 1 or self.num_heads < 1 or not 0 <= self.dropout < 1:
            raise ConfigError(
                f"resampler: num_latents is {self.num_latents}, num_heads {self.num_heads} and dropout "
                f"{self.dropout}; they must be at least 1, at least 1 and in [0, 1)."
            )


class Resampler(nn.Module):
    """Cross-attention from latents to patches or objects, then self-attention among the latents."""

    def __init__(self, config: ResamplerConfig, width: int) -> None:
        super().__init__()
        self.num_blocks = config.num_blocks
        self.latents = nn.Parameter(torch.randn(config.num_latents, width) * config.initial_std)
        self.cross_layer = ResamplerLayer(width, config, cross_attention=True)
        self.self_layers = nn.ModuleList(ResamplerLayer(width, config) for _ in range(config.num_layers))
        normal_weights(self, config.initial_std)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Resample tokens.

        Args:
            tokens: Patches or objects, shape (..., P, D).
            mask: Which of them exist, bool, shape (..., P); None for all. The others have no influence,
                and neither has their number: they are removed where no row needs their place.

        Returns:
            Latents, shape (..., M, D).
        """
        tokens_NPD = tokens.flatten(0, -3)
        mask_NP = None
        if mask is not None:
            mask_NP = mask.flatten(0, -2)
            order_NP = mask_NP.to(torch.int8).argsort(dim=1, descending=True, stable=True)
            order_NP = order_NP[:, : max(1, int(mask_NP.sum(dim=1).max()))]
            mask_NP = mask_NP.gather(1, order_NP)
            tokens_NPD = tokens_NPD.gather(1, order_NP[..., None].expand(-1, -1, tokens.shape[-1]))
        x_NMD = self.cross_layer(self.latents.expand(len(tokens_NPD), -1, -1), tokens_NPD, mask_NP)
        for _ in range(self.num_blocks):
            for layer in self.self_layers:
                x_NMD = layer(x_NMD)
        return x_NMD.unflatten(0, tokens.shape[:-2])


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

    def forward(
        self,
        x_NMD: torch.Tensor,
        source_NPD: torch.Tensor | None = None,
        mask_NP: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Map latents to latents; keys and values come from the source, or from the latents themselves."""
        normed = self.norm_attention(x_NMD)
        source = normed if self.norm_source is None else self.norm_source(source_NPD)
        query, key, value = (
            linear(tokens).unflatten(-1, (self.num_heads, -1)).transpose(1, 2)  # (N, H, P, K)
            for linear, tokens in ((self.query, normed), (self.key, source), (self.value, source))
        )
        dropout = self.dropout if self.training else 0.0
        bias = None if mask_NP is None else attention_bias(mask_NP[:, None, None], query.dtype)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=bias, dropout_p=dropout)
        if mask_NP is not None:  # without any key the bias leaves a mean over all
            mixed = mixed * mask_NP.any(dim=1)[:, None, None, None]
        x_NMD = x_NMD + self.attention_out(mixed.transpose(1, 2).flatten(2))
        return x_NMD + self.out(F.gelu(self.hidden(self.norm_feed_forward(x_NMD))))
