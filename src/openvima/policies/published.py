"""Published checkpoints of VIMA and its baselines, such as 2M.ckpt. No code in a file is executed.

Names of weights there and here are rules, which the architectures combine. `*` stands for a number; a name
stands for itself and for its `.weight` and `.bias`.
"""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch

from openvima.errors import ConfigError, InputFileError
from openvima.policies.architectures import flamingo, gato, gpt, vima
from openvima.policies.build import PolicyConfig, outline_network
from openvima.policies.nn.actions import ACTION_PARTS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.sizes import TUNED_T5_LAYERS, Size
from openvima.policies.tensor_files import check_finite, listed, mismatches, read_archive


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


VIT = "obj_encoder.cropped_img_encoder.vit"
_VIT_NAMES = """
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
_DECODER_NAMES = """
    positions_embed         positions
    h.*.attn.c_attn         self_blocks.*.query_key_value    transposed
    h.*.attn.c_proj         self_blocks.*.attention_out      transposed
    h.*.ln_1                self_blocks.*.norm_attention
    h.*.mlp.c_fc            self_blocks.*.widen              transposed
    h.*.mlp.c_proj          self_blocks.*.narrow             transposed
    h.*.mlp.gated_layer     self_blocks.*.gate
    h.*.ln_2                self_blocks.*.norm_feed_forward
"""
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
# Between the linear layers of an MLP there are two layers without weights there, one here.
_CLASSIFIER_NAMES = "\n".join(
    f"{name}.mlps.{i}.{3 * layer}    {part.start + i}.{2 * layer}"
    for name, part in ACTION_PARTS.items()
    for i in range(part.stop - part.start)
    for layer in range(3)
)
_SHARED_RULES = (
    *T5_RULES,
    *_table(
        """
    prompt_embedding._embed_layer                          prompt.words
    prompt_obj_post_layer.0                                prompt.images.0
    prompt_obj_post_layer.3                                prompt.images.2
    prompt_obj_post_layer.6                                prompt.images.4
    t5_prompt_encoder_post_layer                           prompt.out
    end_effector_encoder                                   end_effectors
    obs_fusion_layer                                       observation_out
    action_encoder._embed_dict.pose0_position._layer.0     head.actions.parts.0.0
    action_encoder._embed_dict.pose0_position._layer.3     head.actions.parts.0.2
    action_encoder._embed_dict.pose0_rotation._layer.0     head.actions.parts.1.0
    action_encoder._embed_dict.pose0_rotation._layer.3     head.actions.parts.1.2
    action_encoder._embed_dict.pose1_position._layer.0     head.actions.parts.2.0
    action_encoder._embed_dict.pose1_position._layer.3     head.actions.parts.2.2
    action_encoder._embed_dict.pose1_rotation._layer.0     head.actions.parts.3.0
    action_encoder._embed_dict.pose1_rotation._layer.3     head.actions.parts.3.2
    action_encoder._post_layer                             head.actions.out
    """
    ),
    *_table(_CLASSIFIER_NAMES, "action_decoder._decoders.", "head.classifiers."),
)
_CROSS_ATTENTION_RULES = (
    *_table(_DECODER_NAMES, "xattn_gpt.", "decoder."),
    *_table(
        """
    xattn_positions_embed      prompt_positions
    xattns.*.layernorm         cross_blocks.*.norm_attention
    xattns.*.query             cross_blocks.*.query
    xattns.*.key_value         cross_blocks.*.key_value
    xattns.*.attention_out     cross_blocks.*.attention_out
    xattns.*.ln                cross_blocks.*.norm_feed_forward
    xattns.*.linear1           cross_blocks.*.widen
    xattns.*.linear2           cross_blocks.*.narrow
    xattns.*.gated_layer       cross_blocks.*.gate
    """,
        "xattn_gpt.",
        "decoder.",
    ),
)
_PREFIX_RULES = (
    *_table(_DECODER_NAMES, "transformer.lm.", "decoder."),
    *_table("prompt_sep_token  decoder.separator"),
)
_OBJECT_RULES = _table(
    """
    bbox_mlp.front.0               box_encoders.0.0
    bbox_mlp.front.3               box_encoders.0.2
    bbox_mlp.front.6               box_encoders.0.4
    bbox_mlp.top.0                 box_encoders.1.0
    bbox_mlp.top.3                 box_encoders.1.2
    bbox_mlp.top.6                 box_encoders.1.4
    pre_transformer_layer.front    fusion.0
    pre_transformer_layer.top      fusion.1
    """,
    "obj_encoder.",
    "images.",
)
PERCEIVER = "obj_encoder.peceiver.model"  # spelled like this in the files
_RESAMPLER_LAYER_NAMES = """
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
    *_table("embeddings.latents  latents", f"{PERCEIVER}.", "resampler."),
    *_table(_RESAMPLER_LAYER_NAMES, f"{PERCEIVER}.encoder.cross_attention.", "resampler.cross_layer."),
    *_table(_RESAMPLER_LAYER_NAMES, f"{PERCEIVER}.encoder.self_attends.*.", "resampler.self_layers.*."),
)


@dataclass(frozen=True, slots=True)
class PublishedAdapter:
    """How to load published files of one architecture.

    Args:
        rules: Names of all weights.
        cfg_names: What `cfg` calls the width, the number of layers and the numbers of heads.
        build: Its config in a size.
    """

    rules: tuple[Rule, ...]
    cfg_names: tuple[str, ...]
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
    (
        *_SHARED_RULES,
        *_table(_VIT_NAMES, f"{VIT}.", "images.crop_encoder."),
        *_OBJECT_RULES,
        *_CROSS_ATTENTION_RULES,
    ),
    cfg_names=("embed_dim", "xf_n_layers", "sattn_n_heads", "xattn_n_heads"),
    build=vima,
)
_FRAME_RULES = _table(_VIT_NAMES, f"{VIT}.", "images.")
GATO = PublishedAdapter(
    (*_SHARED_RULES, *_FRAME_RULES, *_PREFIX_RULES),
    cfg_names=("embed_dim", "n_layer", "n_head"),
    build=gato,
)
FLAMINGO = PublishedAdapter(
    (*_SHARED_RULES, *_FRAME_RULES, *_RESAMPLER_RULES, *_CROSS_ATTENTION_RULES),
    cfg_names=("embed_dim", "dt_n_layers", "dt_n_heads", "xattn_n_heads"),
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


def adapter_of(names: Collection[str]) -> PublishedAdapter:
    """Recognise the architecture of weights by their published names.

    Raises:
        InputFileError: It is none of the four.
    """
    if any(name.startswith("obj_encoder.bbox_mlp.") for name in names):
        return VIMA
    if any(name.startswith(f"{PERCEIVER}.") for name in names):
        return FLAMINGO
    if any(name.startswith("transformer.lm.") for name in names):
        return GPT if f"{VIT}.cls_token" in names else GATO
    raise InputFileError(
        "these are no weights of VIMA, VIMA-Gato, VIMA-Flamingo or VIMA-GPT: no name begins with "
        f"obj_encoder.bbox_mlp, {PERCEIVER} or transformer.lm."
    )


def from_published(weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Rename published weights to their names in this package.

    Args:
        weights: Weights by published name, without the prefix `policy.`.

    Returns:
        Weights in float32, matrices as (out, in). Unused entries are dropped; unknown names are unchanged.

    Raises:
        InputFileError: The names are not those of VIMA or one of its baselines.
    """
    adapter = adapter_of(weights)
    result = {}
    for name, tensor in weights.items():
        if _UNUSED.fullmatch(name):
            continue
        ours, transposed = to_ours(adapter.rules, name) or (name, False)
        tensor = tensor.detach().float() if tensor.is_floating_point() else tensor
        result[ours] = (tensor.T if transposed and tensor.ndim == 2 else tensor).contiguous()
    return result


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
            up to 5 of each.
    """
    file = Path(file)
    if not file.exists() or file.is_dir():
        raise InputFileError(f"{file} is no file. A published checkpoint is a single file such as 2M.ckpt.")
    weights, cfg = _contents(file, read_archive(file))
    try:
        network, tensors = outline_network(config_from_published(weights, cfg)), from_published(weights)
        if problems := mismatches(tensors, network.state_dict()):
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
    if not isinstance(values, Mapping) or not all(
        isinstance(values.get(name), Mapping) for name in ("state_dict", "cfg")
    ):
        raise InputFileError(
            f"{file} holds {short(values)}; a published checkpoint holds the mappings state_dict and cfg. "
            "The number of heads cannot be inferred from weights alone."
        )
    weights = values["state_dict"]
    others = [
        short(name)
        for name, value in weights.items()
        if not isinstance(value, torch.Tensor) or not isinstance(name, str)
    ]
    if others:
        raise InputFileError(f"{file}: {listed('state_dict holds more than weights', others)[0]}.")
    return {name.removeprefix(PREFIX): tensor for name, tensor in weights.items()}, values["cfg"]


def config_from_published(weights: Mapping[str, torch.Tensor], cfg: Mapping[str, object]) -> PolicyConfig:
    """Infer the config of a published network.

    Args:
        weights: Weights by published name, without the prefix `policy.`.
        cfg: The `cfg` entry of the file, the only source of the number of heads.

    Returns:
        The config; as in the paper, words are frozen and the last two layers of T5 are trained.

    Raises:
        InputFileError: The weights belong to none of the four policies or lack some that tell sizes, or `cfg`
            lacks an entry.
        ConfigError: The sizes contradict each other.
    """
    adapter = adapter_of(weights)
    given = _read_cfg(cfg, adapter.cfg_names)
    shapes = {name: tensor.shape for name, tensor in weights.items()}
    try:
        size = Size(
            *given[:3],
            prompt=_prompt(shapes),
            image_width=shapes[f"{VIT}.conv1.weight"][0],
            image_layers=_num_layers(shapes, f"{VIT}.blocks"),
            hidden_width=shapes["action_decoder._decoders.pose0_position.mlps.0.0.weight"][0],
            action_width=shapes["action_encoder._embed_dict.pose0_position._layer.0.weight"][0],
        )
    except LookupError as error:
        raise InputFileError(
            f"the weights lack {error}, which tells sizes, or it has too few axes."
        ) from error
    config = adapter.build(size)
    return replace(config, decoder=type(config.decoder)(*given))


def _read_cfg(cfg: Mapping[str, object], names: tuple[str, ...]) -> list[int]:
    given = {name: cfg.get(name) for name in names}
    numbers = [value for value in given.values() if type(value) is int]
    if len(numbers) < len(names):
        wrong = ", ".join(f"{name} {short(value)}" for name, value in given.items() if type(value) is not int)
        raise InputFileError(f"cfg has {wrong}; it must hold {', '.join(names)} as whole numbers.")
    return numbers


def _num_layers(shapes: Iterable[str], stem: str) -> int:
    """Return the number of layers with this name stem."""
    pattern = re.compile(re.escape(stem) + r"\.(\d+)\.")
    return len({match[1] for name in shapes if (match := pattern.match(name))})


def _prompt(shapes: Mapping[str, tuple[int, ...]]) -> PromptEncoderConfig:
    attention = f"{T5}.block.0.layer.0.SelfAttention"
    words = shapes["prompt_embedding._embed_layer.weight"]
    num_heads = shapes[f"{attention}.relative_attention_bias.weight"][1]
    num_layers = _num_layers(shapes, f"{T5}.block")
    return PromptEncoderConfig(
        TextEncoderConfig(
            words[1],
            num_layers,
            num_heads,
            head_width=shapes[f"{attention}.q.weight"][0] // max(num_heads, 1),  # the file may say 0
            hidden_width=shapes[f"{T5}.block.0.layer.1.DenseReluDense.wi.weight"][0],
        ),
        image_width=shapes["prompt_obj_post_layer.0.weight"][0],
        vocabulary_size=words[0],
        tokenizer="t5",
        train_words=False,
        trained_layers=min(TUNED_T5_LAYERS, num_layers),
    )
