"""Published checkpoints of VIMA and its baselines, such as 2M.ckpt. No code in a file is executed.

Names of weights there and here are rules, which the architectures combine. `*` stands for a number; a name
stands for itself and for its `.weight` and `.bias`.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch

from openvima.errors import ConfigError, InputFileError
from openvima.policies.architectures import flamingo, gato, gpt, vima
from openvima.policies.build import PolicyConfig, outline_network
from openvima.policies.config_fields import MAX_WIDTH
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.sizes import SIZES, TUNED_T5_LAYERS, Size
from openvima.policies.tensor_files import check_finite, listed, mismatches, read_archive

_MAX_LISTED = 20  # names that a message lists per kind of problem
_DEFAULTS = SIZES["2m"]  # sizes to use where a weight is missing


@dataclass(frozen=True, slots=True)
class Rule:
    """One line of the table.

    Args:
        published: Name in a published file.
        ours: Name in this package.
        transposed: Whether the file holds the matrix as (in, out).
    """

    published: str
    ours: str
    transposed: bool = False


def _table(text: str, published: str = "", ours: str = "") -> tuple[Rule, ...]:
    """Read rules, one a line: name in files, name here, and "transposed"; both with something before it."""
    rows = [line.split() for line in text.strip().splitlines()]
    return tuple(Rule(published + row[0], ours + row[1], row[2:] == ["transposed"]) for row in rows)


def _mlp_rules(published: str, ours: str, num_layers: int) -> tuple[Rule, ...]:
    """An MLP: two layers without weights between linear ones there, one here."""
    return tuple(Rule(f"{published}.{3 * i}", f"{ours}.{2 * i}") for i in range(num_layers))


def _vit_rules(ours: str) -> tuple[Rule, ...]:
    table = """
        cls_token                       class_token
        pos_embed                       positions
        projection                      projection.weight    transposed
        conv1                           patches
        ln_pre                          norm_before
        ln_post                         norm_after
        blocks.*.attn.in_proj_weight    blocks.*.query_key_value.weight
        blocks.*.attn.in_proj_bias      blocks.*.query_key_value.bias
        blocks.*.attn.out_proj          blocks.*.attention_out
        blocks.*.ln_1                   blocks.*.norm_attention
        blocks.*.ln_2                   blocks.*.norm_mlp
        blocks.*.mlp.c_fc               blocks.*.widen
        blocks.*.mlp.c_proj             blocks.*.narrow
    """
    return _table(table, "obj_encoder.cropped_img_encoder.vit.", f"{ours}.")


def _self_block_rules(published: str) -> tuple[Rule, ...]:
    table = """
        positions_embed         positions
        h.*.attn.c_attn         self_blocks.*.query_key_value    transposed
        h.*.attn.c_proj         self_blocks.*.attention_out      transposed
        h.*.ln_1                self_blocks.*.norm_attention
        h.*.mlp.c_fc            self_blocks.*.widen              transposed
        h.*.mlp.c_proj          self_blocks.*.narrow             transposed
        h.*.mlp.gated_layer     self_blocks.*.gate
        h.*.ln_2                self_blocks.*.norm_feed_forward
    """
    return _table(table, f"{published}.", "decoder.")


T5 = "t5_prompt_encoder.t5.encoder"
T5_RULES = _table(
    """
        block.0.layer.0.SelfAttention.relative_attention_bias    position_bias
        block.*.layer.0.layer_norm                               blocks.*.norm_attention
        block.*.layer.0.SelfAttention.q                          blocks.*.query
        block.*.layer.0.SelfAttention.k                          blocks.*.key
        block.*.layer.0.SelfAttention.v                          blocks.*.value
        block.*.layer.0.SelfAttention.o                          blocks.*.attention_out
        block.*.layer.1.layer_norm                               blocks.*.norm_feed_forward
        block.*.layer.1.DenseReluDense.wi                        blocks.*.widen
        block.*.layer.1.DenseReluDense.wo                        blocks.*.narrow
        final_layer_norm                                         norm_after
    """,
    f"{T5}.",
    "prompt.text.",
)
_SHARED_RULES = (
    *T5_RULES,
    *_table(
        """
        prompt_embedding._embed_layer    prompt.words
        t5_prompt_encoder_post_layer     prompt.out
        action_encoder._post_layer       head.actions.out
        end_effector_encoder             end_effectors
        obs_fusion_layer                 observation_out
    """
    ),
    *_mlp_rules("prompt_obj_post_layer", "prompt.images", 3),
    *(
        rule
        for part, (name, components) in enumerate(ACTION_PARTS.items())
        for rule in (
            *_mlp_rules(f"action_encoder._embed_dict.{name}._layer", f"head.actions.parts.{part}", 2),
            *(
                rule
                for i, component in enumerate(range(components.start, components.stop))
                for rule in _mlp_rules(
                    f"action_decoder._decoders.{name}.mlps.{i}", f"head.classifiers.{component}", 3
                )
            ),
        )
    ),
)
_CROSS_ATTENTION_RULES = (
    *_self_block_rules("xattn_gpt"),
    Rule("xattn_gpt.xattn_positions_embed", "decoder.prompt_positions"),
    *_table(
        """
        layernorm        norm_attention
        query            query
        key_value        key_value
        attention_out    attention_out
        ln               norm_feed_forward
        linear1          widen
        linear2          narrow
        gated_layer      gate
    """,
        "xattn_gpt.xattns.*.",
        "decoder.cross_blocks.*.",
    ),
)
_PREFIX_RULES = (*_self_block_rules("transformer.lm"), Rule("prompt_sep_token", "decoder.separator"))
_OBJECT_RULES = (
    *_mlp_rules("obj_encoder.bbox_mlp.front", "images.box_encoders.0", 3),
    *_mlp_rules("obj_encoder.bbox_mlp.top", "images.box_encoders.1", 3),
    Rule("obj_encoder.pre_transformer_layer.front", "images.fusion.0"),
    Rule("obj_encoder.pre_transformer_layer.top", "images.fusion.1"),
)
PERCEIVER = "obj_encoder.peceiver.model"  # spelled like this in the files
_RESAMPLER_LAYER = """
        attention.self.layernorm1    norm_attention
        attention.self.layernorm2    norm_source
        attention.self.query         query
        attention.self.key           key
        attention.self.value         value
        attention.output.dense       attention_out
        layernorm                    norm_feed_forward
        mlp.dense1                   hidden
        mlp.dense2                   out
"""
_RESAMPLER_RULES = (
    Rule(f"{PERCEIVER}.embeddings.latents", "resampler.latents"),
    *_table(_RESAMPLER_LAYER, f"{PERCEIVER}.encoder.cross_attention.", "resampler.cross_layer."),
    *_table(_RESAMPLER_LAYER, f"{PERCEIVER}.encoder.self_attends.*.", "resampler.self_layers.*."),
)


@dataclass(frozen=True, slots=True)
class PublishedAdapter:
    """How to load published files of one architecture.

    Args:
        rules: Names of all weights.
        cfg_names: What `cfg` calls the width, the number of layers and the numbers of heads.
        decoder: Prefix of the decoder's weights.
        build: Its config in a size.
    """

    rules: tuple[Rule, ...]
    cfg_names: tuple[str, ...]
    decoder: str
    build: Callable[[Size], Any]


def to_ours(rules: Iterable[Rule], name: str) -> tuple[str, bool] | None:
    """Return our name of a published weight and whether to transpose it; None if there is no such weight."""
    for rule in rules:
        if match := _pattern(rule.published).fullmatch(name):
            ours, (*numbers, ending) = rule.ours, match.groups(default="")
            for number in numbers:
                ours = ours.replace("*", number, 1)
            return ours + ending, rule.transposed
    return None


@cache
def _pattern(template: str) -> re.Pattern[str]:
    return re.compile(re.escape(template).replace(r"\*", r"(\d+)") + r"(\.weight|\.bias)?")


VIMA = PublishedAdapter(
    (*_SHARED_RULES, *_vit_rules("images.crop_encoder"), *_OBJECT_RULES, *_CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "xf_n_layers", "sattn_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=vima,
)
GATO = PublishedAdapter(
    (*_SHARED_RULES, *_vit_rules("images"), *_PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    decoder="transformer.lm",
    build=gato,
)
FLAMINGO = PublishedAdapter(
    (*_SHARED_RULES, *_vit_rules("images"), *_RESAMPLER_RULES, *_CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "dt_n_layers", "dt_n_heads", "xattn_n_heads"),
    decoder="xattn_gpt",
    build=flamingo,
)
GPT = replace(GATO, build=gpt)  # with a class token


PREFIX = "policy."  # before every name in a file
# Unused position counters, masks and embeddings of the files.
_UNUSED = re.compile(
    r"(xattn_gpt|transformer\.lm)\.(position_ids|xattn_position_ids|h\.\d+\.attn\.bias)"
    r"|xattn_gpt\.xattns\.\d+\.kv_position_ids"
    r"|transformer\.lm\.tokens_embed\.weight"
    r"|t5_prompt_encoder\.t5\.(shared|encoder\.embed_tokens)\.weight"
)


def is_unused(name: str) -> bool:
    """Whether a published name, without prefix, is an unused entry."""
    return _UNUSED.fullmatch(name) is not None


def without_prefix(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Remove the prefix `policy.` from the names of published weights."""
    return {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}


def adapter_of(weights: Iterable[str]) -> PublishedAdapter:
    """Recognise the architecture of weights by their published names.

    Raises:
        InputFileError: It is none of the four.
    """
    names = {name.removeprefix(PREFIX) for name in weights}
    if any(name.startswith("obj_encoder.bbox_mlp.") for name in names):
        return VIMA
    if any(name.startswith(f"{PERCEIVER}.") for name in names):
        return FLAMINGO
    if any(name.startswith("transformer.lm.") for name in names):
        return GPT if "obj_encoder.cropped_img_encoder.vit.cls_token" in names else GATO
    raise InputFileError(
        "these are no weights of VIMA, VIMA-Gato, VIMA-Flamingo or VIMA-GPT: no name begins with "
        f"obj_encoder.bbox_mlp, {PERCEIVER} or transformer.lm."
    )


def from_published(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename published weights to their names in this package.

    Args:
        weights: Weights by published name, with or without the prefix `policy.`.

    Returns:
        Weights in float32, matrices as (out, in). Unused entries are dropped; unknown names are unchanged.

    Raises:
        InputFileError: The names are not those of VIMA or one of its baselines.
    """
    adapter = adapter_of(weights)
    result = {}
    for name, tensor in without_prefix(weights).items():
        if not is_unused(name):
            ours, transposed = to_ours(adapter.rules, name) or (name, False)
            result[ours] = _convert(tensor, transposed)
    return result


def _convert(tensor: torch.Tensor, transposed: bool) -> torch.Tensor:
    tensor = tensor.detach()
    tensor = tensor.float() if tensor.is_floating_point() else tensor
    return (tensor.T if transposed and tensor.ndim == 2 else tensor).contiguous()


def load_published(file: str | Path) -> PolicyNetwork:
    """Load a network from a published file, such as `2M.ckpt`.

    Args:
        file: A torch archive that holds `state_dict` and `cfg`, of VIMA or one of its baselines. Unused
            entries are optional.

    Returns:
        The network, in float32 and in evaluation mode.

    Raises:
        InputFileError: The file is missing, damaged or of another format, it would execute code, or its
            weights do not match its `cfg`. One message lists missing and unexpected names and wrong shapes,
            up to 20 of each.
    """
    file = Path(file)
    if not file.exists() or file.is_dir():
        raise InputFileError(f"{file} is no file. A published checkpoint is a single file such as 2M.ckpt.")
    weights, cfg = _contents(file, read_archive(file))
    try:
        network, tensors = outline_network(config_from_published(weights, cfg)), from_published(weights)
        if problems := mismatches(tensors, network.state_dict(), limit=_MAX_LISTED):
            raise InputFileError(f"the weights do not fit the network of their cfg: {'; '.join(problems)}.")
        network.load_state_dict(tensors, assign=True)
    except (InputFileError, ConfigError) as error:
        raise InputFileError(f"{file}: {error}") from error
    except (TypeError, ValueError, LookupError, ArithmeticError, RuntimeError) as error:
        # Sizes within their limits can contradict each other in many ways.
        raise InputFileError(f"{file} describes no network: {error}") from error
    check_finite(network.state_dict(), file)
    return network.eval()


def _contents(file: Path, values: Any) -> tuple[Mapping[str, torch.Tensor], Mapping[str, object]]:

    if not isinstance(values, Mapping) or any(
        not isinstance(values.get(name), Mapping) for name in ("state_dict", "cfg")
    ):
        keys = [short(key).strip("'") for key in values] if isinstance(values, Mapping) else []
        found = listed("the keys", keys, limit=_MAX_LISTED) or [f"a {type(values).__name__}"]
        raise InputFileError(
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
        raise InputFileError(
            f"{file}: state_dict holds more than weights: {', '.join(others[:_MAX_LISTED])}."
        )
    return weights, values["cfg"]


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
        InputFileError: The weights belong to none of the four policies, or `cfg` lacks an entry or
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
        raise InputFileError(f"the weights give no valid config: {error}") from error


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
        raise InputFileError(f"cfg says {'; '.join(wrong)}. They do not match.")
    try:
        kind = PrefixDecoderConfig if name == "transformer.lm" else DecoderConfig
        return kind(width, num_layers, *heads)
    except ConfigError as error:
        raise InputFileError(f"cfg is {given}: {error}") from error


def _read_cfg(cfg: Mapping[str, object], names: tuple[str, ...]) -> dict[str, int]:
    given = {name: cfg.get(name) for name in names}
    numbers = {name: value for name, value in given.items() if type(value) is int and 0 < value <= MAX_WIDTH}
    if numbers.keys() != given.keys():
        wrong = ", ".join(f"{name} {short(value)}" for name, value in given.items() if name not in numbers)
        raise InputFileError(
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
