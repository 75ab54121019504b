"""Load published checkpoint files without executing code from them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch

from openvima.errors import CheckpointError, ConfigError, InputFileError
from openvima.policies.build import PolicyConfig, outline_network
from openvima.policies.config_fields import MAX_WIDTH
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.published_names import (
    T5,
    PublishedAdapter,
    adapter_of,
    from_published,
    is_unused,
    to_published,
    without_prefix,
)
from openvima.policies.sizes import SIZES, TUNED_T5_LAYERS, Size
from openvima.policies.tensor_files import check_finite, described, listed, read_archive

_MAX_LISTED = 20  # names that a message lists per kind of problem


def load_published(file: str | Path) -> PolicyNetwork:
    """Load a network from a published file, such as `2M.ckpt`.

    Args:
        file: A torch archive that holds `state_dict` and `cfg`, of VIMA or one of its baselines. Unused
            entries are optional.

    Returns:
        The network, in float32 and in evaluation mode.

    Raises:
        CheckpointError: The file is missing, damaged or of another format, it would execute code, or its
            weights do not match its `cfg`. One message lists missing and unexpected names and wrong shapes,
            up to 20 of each.
    """
    file = Path(file)
    if not file.exists() or file.is_dir():
        raise CheckpointError(f"{file} is no file. A published checkpoint is a single file such as 2M.ckpt.")
    try:
        weights, cfg = _contents(file, read_archive(file))
    except InputFileError as error:
        raise CheckpointError(str(error)) from error
    try:
        network = outline_network(config_from_published(weights, cfg))
        _check_fit(network, weights)
        network.load_state_dict(from_published(weights), assign=True)
    except (CheckpointError, ConfigError) as error:
        raise CheckpointError(f"{file}: {error}") from error
    except (TypeError, ValueError, LookupError, ArithmeticError, RuntimeError) as error:
        # Sizes within their limits can contradict each other in many ways.
        raise CheckpointError(f"{file} describes no network: {error}") from error
    check_finite(network.state_dict(), file)
    return network.eval()


def _contents(file: Path, values: Any) -> tuple[Mapping[str, torch.Tensor], Mapping[str, object]]:
    # Any: whatever the file holds
    if not isinstance(values, Mapping) or any(
        not isinstance(values.get(name), Mapping) for name in ("state_dict", "cfg")
    ):
        keys = [short(key).strip("'") for key in values] if isinstance(values, Mapping) else []
        found = listed("the keys", keys, limit=_MAX_LISTED) or [f"a {type(values).__name__}"]
        raise CheckpointError(
            f"{file} holds {found[0]}; a published checkpoint holds the mappings state_dict and cfg. "
            "The number of heads cannot be inferred from weights alone."
        )
    weights = values["state_dict"]
    others = [
        short(name).strip("'")
        for name, value in weights.items()
        if not isinstance(value, torch.Tensor) or not isinstance(name, str)
    ]
    if others:
        raise CheckpointError(
            f"{file}: state_dict holds more than weights: {', '.join(others[:_MAX_LISTED])}."
        )
    return weights, values["cfg"]


def _check_fit(network: PolicyNetwork, weights: Mapping[str, torch.Tensor]) -> None:
    """Compare published names and shapes with what the network expects."""
    expected = to_published(network)
    given = {name: tensor for name, tensor in without_prefix(weights).items() if not is_unused(name)}
    wrong = [
        f"{name} is {described(given[name].dtype, given[name].shape)} instead of "
        f"{described(wanted.dtype, wanted.shape)}"
        for name, wanted in expected.items()
        if name in given and (given[name].shape != wanted.shape or not given[name].is_floating_point())
    ]
    problems = [
        *listed("missing", [name for name in expected if name not in given], limit=_MAX_LISTED),
        *listed("unexpected", [name for name in given if name not in expected], limit=_MAX_LISTED),
        *listed("wrong", wrong, limit=_MAX_LISTED),
    ]
    if problems:
        raise CheckpointError(f"the weights do not fit the network of their cfg: {'; '.join(problems)}.")


_DEFAULTS = SIZES["2m"]  # sizes to use where a weight is missing


@dataclass(frozen=True, slots=True)
class _Shapes:
    """Shapes of weights by published name; missing ones are reported on loading."""

    shapes: Mapping[str, tuple[int, ...]]

    def length(self, name: str, axis: int, *, default: int) -> int:
        """Length of one axis of a weight, or the default if it is missing."""
        shape = self.shapes.get(name, ())
        return shape[axis] if axis < len(shape) else default

    def count(self, stem: str, *, default: int) -> int:
        """Number of layers with this name stem, or the default if there are none."""
        pattern = re.compile(re.escape(stem) + r"\.(\d+)\.")
        found = {match[1] for name in self.shapes if (match := pattern.match(name))}
        return len(found) or default


def config_from_published(weights: Mapping[str, torch.Tensor], cfg: Mapping[str, object]) -> PolicyConfig:
    """Infer the config of a published network.

    Args:
        weights: Weights by published name, with or without the prefix `policy.`.
        cfg: The `cfg` entry of the file, the only source of the number of heads.

    Returns:
        The config; as in the paper, words are frozen and the last two layers of T5 are trained.

    Raises:
        CheckpointError: The weights belong to none of the four policies, or `cfg` lacks an entry or
            contradicts them.
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
            image_width=shapes.length(f"{vit}.conv1.weight", 0, default=_DEFAULTS.image_width),
            image_layers=shapes.count(f"{vit}.blocks", default=_DEFAULTS.image_layers),
            hidden_width=shapes.length(classifier, 0, default=_DEFAULTS.hidden_width),
            action_width=shapes.length(action, 0, default=_DEFAULTS.action_width),
        )
        return replace(adapter.build(size), decoder=decoder)
    except ConfigError as error:
        raise CheckpointError(f"the weights give no valid config: {error}") from error


def _decoder(
    adapter: PublishedAdapter, shapes: _Shapes, cfg: Mapping[str, object]
) -> DecoderConfig | PrefixDecoderConfig:
    given = _read_cfg(cfg, adapter.cfg_names)
    width, num_layers, *heads = given.values()
    name = adapter.decoder
    found = (
        shapes.length(f"{name}.positions_embed.weight", 1, default=width),
        shapes.count(f"{name}.h", default=num_layers),
    )
    wrong = [
        f"{entry} {given[entry]}, but the weights have {value}"
        for entry, value in zip(given, found, strict=False)
        if given[entry] != value
    ]
    if wrong:
        raise CheckpointError(f"cfg says {'; '.join(wrong)}. They do not match.")
    try:
        kind = PrefixDecoderConfig if adapter.architecture in ("gato", "gpt") else DecoderConfig
        return kind(width, num_layers, *heads)
    except ConfigError as error:
        raise CheckpointError(f"cfg is {given}: {error}") from error


def _read_cfg(cfg: Mapping[str, object], names: tuple[str, ...]) -> dict[str, int]:
    given = {name: cfg.get(name) for name in names}
    numbers = {name: value for name, value in given.items() if type(value) is int and 0 < value <= MAX_WIDTH}
    if numbers.keys() != given.keys():
        wrong = ", ".join(f"{name} {short(value)}" for name, value in given.items() if name not in numbers)
        raise CheckpointError(
            f"cfg has {wrong}; it must hold {', '.join(names)} as whole numbers from 1 to {MAX_WIDTH}."
        )
    return numbers


def _prompt(shapes: _Shapes) -> PromptEncoderConfig:
    defaults, words = _DEFAULTS.prompt, "prompt_embedding._embed_layer.weight"
    attention = f"{T5}.block.0.layer.0.SelfAttention"
    num_heads = shapes.length(
        f"{attention}.relative_attention_bias.weight", 1, default=defaults.text.num_heads
    )
    inner = defaults.text.num_heads * defaults.text.head_width
    text = TextEncoderConfig(
        width=shapes.length(words, 1, default=defaults.text.width),
        num_layers=shapes.count(f"{T5}.block", default=defaults.text.num_layers),
        num_heads=num_heads,
        head_width=shapes.length(f"{attention}.q.weight", 0, default=inner) // max(num_heads, 1),
        hidden_width=shapes.length(
            f"{T5}.block.0.layer.1.DenseReluDense.wi.weight", 0, default=defaults.text.hidden_width
        ),
    )
    return PromptEncoderConfig(
        text,
        image_width=shapes.length("prompt_obj_post_layer.0.weight", 0, default=defaults.image_width),
        vocabulary_size=shapes.length(words, 0, default=defaults.vocabulary_size),
        tokenizer="t5",
        train_words=False,
        trained_layers=min(TUNED_T5_LAYERS, text.num_layers),
    )
