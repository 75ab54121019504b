"""Small policies as others publish theirs: a `.ckpt` file, and the files of a tokenizer of T5."""

from pathlib import Path

import torch

from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.text_encoder import TextEncoderConfig
from openvima.policies.published.names import to_published
from openvima.policies.sizes import Size
from openvima.policies.vima.config import VimaConfig, vima

VOCABULARY_SIZE = 160


def small_vima() -> VimaConfig:
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


def write_tokenizer(folder: Path) -> Path:
    """Write the files of a T5 tokenizer with a few words of its own; all else it spells."""
    from tokenizers import Tokenizer, models, pre_tokenizers

    special = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0)]
    letters = [(letter, -9.0) for letter in "▁abcdefghijklmnopqrstuvwxyzPRST.,0123456789:"]
    words = [(f"▁{word}", -2.0) for word in ("Put", "the", "into", "Rotate", "degrees")]
    tokenizer = Tokenizer(models.Unigram(special + letters + words, unk_id=2))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    folder.mkdir(parents=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    return folder
