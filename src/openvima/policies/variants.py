"""Variants of a network: the parts that the papers' ablations exchange, as functions on its config."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from openvima.errors import ConfigError, unknown_name
from openvima.policies.build import PolicyConfig
from openvima.policies.config_fields import check_limits
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.heads import HEADS, AutoregressiveConfig
from openvima.policies.nn.image_encoders import ConvConfig, VitConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.pointer.config import AttributeConfig, CandidateHeadConfig, PointerConfig
from openvima.policies.sizes import SIZES, T5_SIZES, t5_prompt_encoder

# Switches that take names.
CHOICES: Mapping[str, Collection[str]] = {
    "text_encoder": ("small", *T5_SIZES),
    "image_tokens": ("objects", "object-perceiver", "image-perceiver", "patches", "image"),
    "conditioning": ("cross-attention", "prefix"),
    "head": HEADS,
}


def with_variant(config: PolicyConfig, switches: Mapping[str, Any]) -> PolicyConfig:
    """Return the same network with other parts.

    Args:
        config: The network.
        switches: Values of `SWITCHES` by name; None keeps the part.

    Raises:
        ConfigError: There is no such switch or value, or the network cannot have it.
    """
    for name, value in switches.items():
        if name not in SWITCHES:
            raise ConfigError(unknown_name("switch", name, SWITCHES))
        if name in CHOICES and value not in (None, *CHOICES[name]):
            raise ConfigError(unknown_name(name, value, CHOICES[name]))
    for name, switch in SWITCHES.items():
        if switches.get(name) is not None:
            config = switch(config, switches[name])
    check_limits(config, "model")
    return config


def with_text_encoder(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return the same network with another text encoder and its tokenizer.

    Args:
        config: The network.
        name: "small", that of the preset if it is no T5, else that of nano; or one of `T5_SIZES`, of which
            the last two layers are trained.

    Raises:
        ConfigError: The network is a pointer model.
    """
    old = config.prompt
    if name == "small":
        new = SIZES["nano"].prompt if old.tokenizer == "t5" else old
    elif isinstance(config, PointerConfig):
        raise _not_of_pointers(f"text_encoder is {name!r}", "a vocabulary of words alone")
    else:
        new = old if old.text == T5_SIZES[name] else t5_prompt_encoder(name)
    return replace(config, prompt=replace(new, visual_residual=old.visual_residual))


def with_tuned_layers(config: PolicyConfig, count: int) -> PolicyConfig:
    """Return the same network with so many layers of its text encoder trained, the last ones.

    Raises:
        ConfigError: The text encoder has fewer layers.
    """
    num_layers = config.prompt.text.num_layers
    if not 0 <= count <= num_layers:
        raise ConfigError(
            f"tuned_layers is {count}, but the text encoder has {num_layers} layers; give 0 to {num_layers}."
        )
    return replace(config, prompt=replace(config.prompt, trained_layers=count))


def image_tokens(config: PolicyConfig) -> str:
    """Return which image tokens of `CHOICES` a network has."""
    resampler = None if isinstance(config, PointerConfig) else config.resampler
    if isinstance(config.images, ObjectEncoderConfig):
        return "object-perceiver" if resampler else "objects"
    return "image" if config.images.class_token else "image-perceiver" if resampler else "patches"


def with_image_tokens(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return VIMA or MIDAS with other image tokens, in an image encoder of the same width and depth.

    Args:
        config: The network.
        name: "objects" and "object-perceiver", four latents of the objects of both
            views, take crops; "image-perceiver", four latents, "patches" and "image", one token, are the
            tokens of VIMA-Flamingo, VIMA-Gato and VIMA-GPT of whole frames.

    Raises:
        ConfigError: The network cannot have them.

    Source: VIMA (Jiang et al. 2023), ablation of visual tokenizers.
    """
    own = image_tokens(config)
    if name == own:
        return config
    if isinstance(config, PointerConfig):
        raise _not_of_pointers(f"image_tokens is {name!r}", "objects alone")
    images = config.images
    if config.architecture not in ("vima", "midas") or not isinstance(images, ObjectEncoderConfig):
        raise ConfigError(
            f"image_tokens is {name!r}, but this network has {own!r} alone; take a preset vima-… or midas-…."
        )
    crop, decoder = images.crop, config.decoder
    of = replace(SIZES["nano"], width=decoder.width, dropout=decoder.dropout, initial_std=decoder.initial_std)
    if isinstance(crop, VitConfig):
        of = replace(
            of,
            image_width=crop.width,
            image_layers=crop.num_layers,
            image_heads=crop.num_heads,
            resampler_layers=crop.num_layers,
        )
    return replace(
        config,
        images=images if name.startswith("object") else of.frame_encoder(class_token=name == "image"),
        resampler=of.resampler() if name.endswith("perceiver") else None,
    )


def with_head(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return the same network with another action head of the same sizes.

    Args:
        config: The network.
        name: One of `openvima.policies.nn.heads.HEADS`.

    Raises:
        ConfigError: The network is a pointer model.
    """
    if isinstance(config, PointerConfig):
        raise _not_of_pointers(f"head is {name!r}", "pointers to candidates alone")
    kind, head = HEADS[name], config.head
    if isinstance(head, kind):
        return config
    if kind is AutoregressiveConfig:
        new = AutoregressiveConfig(head.hidden_width, config.decoder.initial_std, head.action_width)
    else:
        new = kind(head.hidden_width, action_width=head.action_width)
    return replace(config, head=new)


def with_visual_residual(config: PolicyConfig, wanted: bool) -> PolicyConfig:
    """Return the same network with or without the visual residual in its prompt encoder."""
    return replace(config, prompt=replace(config.prompt, visual_residual=wanted))


def with_conditioning(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return the same network with another prompt conditioning, in a decoder of about as many parameters.

    Args:
        config: The network.
        name: "cross-attention", or "prefix", the prompt before the history in one causal sequence. A layer
            of the former is a pair of blocks, so the latter has twice as many layers.

    Source: VIMA (Jiang et al. 2023), ablation "gpt-decoder".
    """
    is_prefix = isinstance(config.decoder, PrefixDecoderConfig)
    if is_prefix == (name == "prefix"):
        return config
    old = config.decoder
    rest = {"dropout": old.dropout, "initial_std": old.initial_std}
    if is_prefix:
        layers = max(1, old.num_layers // 2)
        new = DecoderConfig(old.width, layers, old.num_heads, old.num_heads, **rest)
    else:
        new = PrefixDecoderConfig(old.width, 2 * old.num_layers, old.num_heads, **rest)
    return replace(config, decoder=new)


def with_width(config: PolicyConfig, width: int) -> PolicyConfig:
    """Return the same network with a decoder, and image tokens, of another width.

    Raises:
        ConfigError: The width is no multiple of the heads of the decoder, or of the resampler.
    """
    images, decoder = config.images, replace(config.decoder, width=width)
    changed = {"output_width": width} if isinstance(images, VitConfig) else {"width": width}
    return replace(config, images=replace(images, **changed), decoder=decoder)


def with_num_layers(config: PolicyConfig, count: int) -> PolicyConfig:
    """Return the same network with a decoder of another depth, see `with_conditioning`."""
    return replace(config, decoder=replace(config.decoder, num_layers=count))


def _not_of_pointers(given: str, have: str) -> ConfigError:
    return ConfigError(f"{given}, but pointer models have {have}; take nano-bins or another preset.")


def with_attributes(config: PolicyConfig, wanted: bool) -> PolicyConfig:
    """Return the same network with or without comparison by attributes.

    Raises:
        ConfigError: They are wanted, but the network is no pointer model with place candidates.
    """
    if wanted == bool(getattr(config, "attributes", None)):
        return config
    if not isinstance(config, PointerConfig) or not isinstance(config.head, CandidateHeadConfig):
        raise ConfigError("attributes need a pointer model with place candidates; take the preset small.")
    return replace(config, attributes=AttributeConfig() if wanted else None)


def _with_convolutions(switch: str, field: str, config: PolicyConfig, value: int) -> PolicyConfig:
    """Return the same network with another value of a field of its convolutional crop encoder.

    Raises:
        ConfigError: The network encodes no crops by convolutions, or the encoder cannot have the value.
    """
    images = config.images
    if not isinstance(images, ObjectEncoderConfig) or not isinstance(images.crop, ConvConfig):
        raise ConfigError(f"{switch} is {value}, but the network has no convolutions; take nano or small.")
    return replace(config, images=replace(images, crop=replace(images.crop, **{field: value})))


def with_points(config: PolicyConfig, value: bool) -> PolicyConfig:
    """Return the same network, which reads positions from objects or not; see `TokenPolicyConfig.points`.

    Raises:
        ConfigError: It cannot.
    """
    if isinstance(config, PointerConfig):
        raise _not_of_pointers(f"points is {value}", "objects to point at in any case")
    return replace(config, points=value)


# In the order in which they are made: later ones see the parts of earlier ones.
SWITCHES: Mapping[str, Callable[[PolicyConfig, Any], PolicyConfig]] = {
    "text_encoder": with_text_encoder,
    "tuned_layers": with_tuned_layers,
    "image_tokens": with_image_tokens,
    "conditioning": with_conditioning,
    "width": with_width,
    "num_layers": with_num_layers,
    "head": with_head,
    "visual_residual": with_visual_residual,
    "points": with_points,
    "attributes": with_attributes,
    "crop_kernel": partial(_with_convolutions, "crop_kernel", "last_kernel"),
    "crop_width": partial(_with_convolutions, "crop_width", "width"),
}
