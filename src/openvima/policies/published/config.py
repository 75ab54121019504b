"""Sizes of a published network, as far as its weights and its `cfg` tell them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from openvima.errors import CheckpointError, ConfigError
from openvima.policies.config import PolicyConfig
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.text_encoder import TextEncoderConfig
from openvima.policies.published.names import adapter_of, without_prefix
from openvima.policies.published.rules import T5, PublishedAdapter
from openvima.policies.sizes import SIZES, TUNED_T5_LAYERS, Size

_USUAL = SIZES["2m"]  # what a size is taken from where its weight is missing


@dataclass(frozen=True, slots=True)
class _Shapes:
    """Shapes of weights by published name; some may be missing, which is given when they are loaded."""

    shapes: Mapping[str, tuple[int, ...]]

    def length(self, name: str, axis: int, *, otherwise: int) -> int:
        """Length of one axis of a weight, or what to take if there is no such weight."""
        shape = self.shapes.get(name, ())
        return shape[axis] if axis < len(shape) else otherwise

    def count(self, stem: str, *, otherwise: int) -> int:
        """How many numbers follow the stem of a name, or what to take if there are none."""
        pattern = re.compile(re.escape(stem) + r"\.(\d+)\.")
        found = {match[1] for name in self.shapes if (match := pattern.match(name))}
        return len(found) or otherwise


def config_from_published(weights: Mapping[str, torch.Tensor], cfg: Mapping[str, object]) -> PolicyConfig:
    """Find out the sizes of a published network.

    Args:
        weights: Its weights by published name, with or without `policy.` before it.
        cfg: What lies beside them in the file. Heads are known from here only.

    Returns:
        The config; as in the paper, words are frozen and the last two layers of T5 are trained.

    Raises:
        CheckpointError: The weights are of none of the four policies, or `cfg` lacks an entry or contradicts
            the weights.
    """
    adapter = adapter_of(weights)
    shapes = _Shapes({name: tuple(tensor.shape) for name, tensor in without_prefix(weights).items()})
    decoder = _decoder(adapter, shapes, cfg)
    vit = "obj_encoder.cropped_img_encoder.vit"
    action = "action_encoder._embed_dict.pose0_position._layer.0.weight"
    classifier = "action_decoder._decoders.pose0_position.mlps.0.0.weight"
    try:
        size = Size(
            width=decoder.width,
            num_layers=decoder.num_layers,
            num_heads=decoder.num_heads,
            prompt=_prompt(shapes),
            image_width=shapes.length(f"{vit}.conv1.weight", 0, otherwise=_USUAL.image_width),
            image_layers=shapes.count(f"{vit}.blocks", otherwise=_USUAL.image_layers),
            hidden_width=shapes.length(classifier, 0, otherwise=_USUAL.hidden_width),
            action_width=shapes.length(action, 0, otherwise=_USUAL.action_width),
        )
        return replace(adapter.build(size), decoder=decoder)
    except ConfigError as error:
        raise CheckpointError(f"these weights make no network: {error}") from error


def _decoder(
    adapter: PublishedAdapter, shapes: _Shapes, cfg: Mapping[str, object]
) -> DecoderConfig | PrefixDecoderConfig:
    given = _read_cfg(cfg, adapter.cfg_names)
    width, num_layers, *heads = given.values()
    name = adapter.decoder
    found = (
        shapes.length(f"{name}.positions_embed.weight", 1, otherwise=width),
        shapes.count(f"{name}.h", otherwise=num_layers),
    )
    wrong = [
        f"{entry} {given[entry]}, but the weights have {value}"
        for entry, value in zip(given, found, strict=False)
        if given[entry] != value
    ]
    if wrong:
        raise CheckpointError(f"cfg says {'; '.join(wrong)}. They do not belong together.")
    try:
        kind = PrefixDecoderConfig if adapter.architecture in ("gato", "gpt") else DecoderConfig
        return kind(width, num_layers, *heads)
    except ConfigError as error:
        raise CheckpointError(f"cfg is {given}: {error}") from error


def _read_cfg(cfg: Mapping[str, object], names: tuple[str, ...]) -> dict[str, int]:
    given = {name: cfg.get(name) for name in names}
    numbers = {name: value for name, value in given.items() if type(value) is int and value > 0}
    if numbers.keys() != given.keys():
        wrong = ", ".join(f"{name} {value!r}" for name, value in given.items() if name not in numbers)
        raise CheckpointError(f"cfg has {wrong}; it must hold {', '.join(names)} as whole numbers above 0.")
    return numbers


def _prompt(shapes: _Shapes) -> PromptEncoderConfig:
    usual, words = _USUAL.prompt, "prompt_embedding._embed_layer.weight"
    attention = f"{T5}.block.0.layer.0.SelfAttention"
    num_heads = shapes.length(
        f"{attention}.relative_attention_bias.weight", 1, otherwise=usual.text.num_heads
    )
    inner = usual.text.num_heads * usual.text.head_width
    text = TextEncoderConfig(
        width=shapes.length(words, 1, otherwise=usual.text.width),
        num_layers=shapes.count(f"{T5}.block", otherwise=usual.text.num_layers),
        num_heads=num_heads,
        head_width=shapes.length(f"{attention}.q.weight", 0, otherwise=inner) // max(num_heads, 1),
        hidden_width=shapes.length(
            f"{T5}.block.0.layer.1.DenseReluDense.wi.weight", 0, otherwise=usual.text.hidden_width
        ),
    )
    return PromptEncoderConfig(
        text,
        image_width=shapes.length("prompt_obj_post_layer.0.weight", 0, otherwise=usual.image_width),
        vocabulary_size=shapes.length(words, 0, otherwise=usual.vocabulary_size),
        tokenizer="t5",
        train_words=False,
        trained_layers=min(TUNED_T5_LAYERS, text.num_layers),
    )
