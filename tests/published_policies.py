"""Small policies as others publish theirs: a `.ckpt` file, and the files of a tokenizer of T5."""

import os
from collections.abc import Sequence
from pathlib import Path

import torch

from openvima.policies.architectures import TokenPolicyConfig, vima
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.published import FLAMINGO, GATO, T5, VIMA, _pattern
from openvima.policies.sizes import Size

VOCABULARY_SIZE = 160
_UNUSED_VOCABULARY_SIZE = 40478  # of the first GPT, whose unused embedding Gato and GPT contain


class Touch:
    """Pickled, it makes whoever unpickles it carelessly create a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.folder),)


def to_published(network: PolicyNetwork) -> dict[str, torch.Tensor]:
    """Give the weights of a network their published names, without `policy.` before them."""
    adapters = {"vima": VIMA, "gato": GATO, "gpt": GATO, "flamingo": FLAMINGO}
    rules, result = adapters[network.config.architecture].rules, {}
    for name, tensor in network.state_dict().items():
        rule, match = next((rule, match) for rule in rules if (match := _pattern(rule.ours).fullmatch(name)))
        *numbers, ending = match.groups(default="")
        published = rule.published
        for number in numbers:
            published = published.replace("*", number, 1)
        tensor = tensor.detach().float() if tensor.is_floating_point() else tensor
        is_turned = rule.transposed and tensor.ndim == 2
        result[published + ending] = (tensor.T if is_turned else tensor).contiguous()
    return result


def small_vima() -> TokenPolicyConfig:
    """VIMA as published, with few and narrow layers."""
    text = TextEncoderConfig(width=32, num_layers=2, num_heads=2, head_width=8, hidden_width=16)
    prompt = PromptEncoderConfig(
        text, 16, VOCABULARY_SIZE, tokenizer="t5", train_words=False, trained_layers=2
    )
    return vima(Size(32, 1, 2, prompt, image_width=48, image_layers=1, hidden_width=8, action_width=8))


def write_published(network: PolicyNetwork, file: Path) -> Path:
    """Write a network of `small_vima` as a published file."""
    cfg = {"embed_dim": 32, "xf_n_layers": 1, "sattn_n_heads": 2, "xattn_n_heads": 2}
    weights = {f"policy.{name}": tensor for name, tensor in to_published(network).items()}
    torch.save({"state_dict": weights, "cfg": cfg}, file)
    return file


def with_unused_entries(network: PolicyNetwork) -> dict[str, torch.Tensor]:
    """Published weights with the entries without effect, which the published code demands."""
    words = network.prompt.words.weight.detach().float()
    positions = torch.arange(MAX_POSITIONS, device=words.device)
    entries = {"t5_prompt_encoder.t5.shared.weight": words, f"{T5}.embed_tokens.weight": words}
    if network.config.architecture in ("gato", "gpt"):
        entries["transformer.lm.position_ids"] = positions
        unused = words.new_zeros(_UNUSED_VOCABULARY_SIZE, network.decoder.width)
        entries["transformer.lm.tokens_embed.weight"] = unused
        return {**to_published(network), **entries}
    prompt_positions = positions[:MAX_PROMPT_POSITIONS].clone()
    causal = words.new_ones(1, 1, MAX_POSITIONS, MAX_POSITIONS).tril()
    entries["xattn_gpt.position_ids"] = positions
    entries["xattn_gpt.xattn_position_ids"] = prompt_positions
    for block in range(len(network.decoder.self_blocks)):
        entries[f"xattn_gpt.h.{block}.attn.bias"] = causal
        entries[f"xattn_gpt.xattns.{block}.kv_position_ids"] = prompt_positions
    return {**to_published(network), **entries}


_LETTERS = [(letter, -9.0) for letter in "▁abcdefghijklmnopqrstuvwxyzPRST.,0123456789:"]
_WORDS = [(f"▁{word}", -2.0) for word in ("Put", "the", "into", "Rotate", "degrees")]


def write_tokenizer(folder: Path, scored: Sequence[tuple[str, float]] = (*_LETTERS, *_WORDS)) -> Path:
    """Write a tokenizer in the format of t5-base; unless given, it knows a few words, and spells all else."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors

    special = ["<pad>", "</s>", "<unk>"]
    extra = [f"<extra_id_{number}>" for number in reversed(range(100))]
    vocabulary = [*((name, 0.0) for name in special), *scored, *((name, 0.0) for name in extra)]
    tokenizer = Tokenizer(models.Unigram(vocabulary, unk_id=2))
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence(
        [pre_tokenizers.WhitespaceSplit(), pre_tokenizers.Metaspace()]
    )
    tokenizer.decoder = decoders.Metaspace()
    tokenizer.post_processor = processors.TemplateProcessing(single="$A </s>", special_tokens=[("</s>", 1)])
    tokenizer.add_special_tokens(special + extra)
    folder.mkdir(parents=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    return folder


def write_t5(folder: Path, text: TextEncoderConfig, vocabulary_size: int) -> Path:
    """Write a T5 of transformers with random weights, no two alike."""
    from transformers import T5Config, T5EncoderModel

    sizes = T5Config(
        vocab_size=vocabulary_size,
        d_model=text.width,
        d_kv=text.head_width,
        d_ff=text.hidden_width,
        num_layers=text.num_layers,
        num_heads=text.num_heads,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = T5EncoderModel(sizes)
        for parameter in model.parameters():  # norms differ from 1, biases of positions from each other
            parameter.data.add_(0.3 * torch.randn(parameter.shape))
    model.save_pretrained(folder)
    return folder
