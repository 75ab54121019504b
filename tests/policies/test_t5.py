"""T5: the tokenizer's ids for pieces of prompts, and hidden states equal to those of transformers."""

import json
import sys
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

pytest.importorskip("transformers")

from openvima.errors import InputFileError, MissingExtraError, PolicyError, PromptError
from openvima.policies.build import build_network
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import RmsNorm, TextEncoderConfig
from openvima.policies.processor import Processor
from openvima.policies.t5 import T5Tokenizer, load_t5, tokenizer_for
from openvima.policies.tokenizer import benchmark_vocabulary
from openvima.render.camera import VIEWS
from openvima.scene import PromptImage, RenderedPrompt
from published_policies import write_t5, write_tokenizer

MARKER, STOP = 3, 5  # "▁" and ".", as in t5-base
PIECES = ("▁", "X", ".", "▁the", "▁Put", "▁into", "in", "to", "▁Rot", "ate", "s", "3", "0", "▁degree", ",")
IDS = {piece: number for number, piece in enumerate(PIECES, start=3)}
TEXT = TextEncoderConfig(width=24, num_layers=3, num_heads=2, head_width=4, hidden_width=32)


@pytest.fixture(scope="module")
def tokenizer_folder(tmp_path_factory) -> Path:
    scored = [(piece, -2.0 - 0.1 * number) for number, piece in enumerate(PIECES)]
    return write_tokenizer(tmp_path_factory.mktemp("tokenizer") / "t5", scored)


@pytest.fixture(scope="module")
def tokenizer(tokenizer_folder) -> T5Tokenizer:
    return T5Tokenizer(tokenizer_folder)


def ids(*pieces: str) -> list[int]:
    return [IDS[piece] for piece in pieces]


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        ("Put the", "▁Put ▁the"),
        ("Rotates 30 degrees.", "▁Rot ate s ▁ 3 0 ▁degree s ."),
        (".", "▁ ."),  # after a placeholder a full stop is a word of its own
        (". Put", "▁ . ▁Put"),
        (" into the  ", "▁into ▁the"),  # blanks before a placeholder leave no lone marker
        (" \n\t", ""),
    ],
)
def test_words_begin_with_the_marker_and_no_piece_ends_with_special_ids(tokenizer, text, pieces) -> None:
    assert tokenizer.encode(text) == ids(*pieces.split())


def test_a_prompt_is_read_with_placeholders_between_words_and_the_end_mark(tokenizer) -> None:
    image = PromptImage("a", "object", dict.fromkeys(VIEWS, np.zeros((3, 128, 256), np.uint8)), {}, ())
    prompt = RenderedPrompt("Put the {a} into the {a}.", {"a": image})
    processor = Processor("frames", tokens_per_image=1, tokenizer=tokenizer)
    batch, _ = processor.encode_prompts([prompt])
    words, shows_image = batch.word_ids_BL[0], batch.object_index_BL[0] >= 0
    assert shows_image.tolist() == [False, False, True, False, False, True, False, False, False]
    expected = [*ids("▁Put", "▁the", "▁into", "▁the"), MARKER, STOP, 1]
    assert words[~shows_image].tolist() == expected


def test_words_without_ids_are_all_named(tokenizer) -> None:
    with pytest.raises(PromptError, match=r"'quokka', '{the}', '</s>', '<extra_id_3>'") as caught:
        tokenizer.encode("Put the quokka {the} quokka </s> <extra_id_3>")
    assert "'Put'" not in str(caught.value)


def test_a_saved_tokenizer_is_read_again(tokenizer, tmp_path) -> None:
    tokenizer.save(tmp_path / "new" / "folder")
    again = T5Tokenizer(tmp_path / "new" / "folder")
    assert again.encode("Put 30 into.") == tokenizer.encode("Put 30 into.")
    assert again.vocabulary_size == tokenizer.vocabulary_size == 3 + len(PIECES) + 100


def test_a_folder_without_a_tokenizer_that_can_be_read_is_refused(tmp_path) -> None:
    with pytest.raises(InputFileError, match=r"holds no tokenizer\.json"):
        T5Tokenizer(tmp_path)
    (tmp_path / "tokenizer.json").write_text('{"model":', encoding="utf-8")
    with pytest.raises(InputFileError, match="no tokenizer that can be read"):
        T5Tokenizer(tmp_path)


def test_the_tokenizer_of_another_model_is_refused(tokenizer_folder, tmp_path) -> None:
    values = json.loads((tokenizer_folder / "tokenizer.json").read_text("utf-8"))
    vocabulary = values["model"]["vocab"]
    values["model"]["vocab"] = [vocabulary[1], vocabulary[0], *vocabulary[2:]]  # end and padding swapped
    values["added_tokens"] = []
    (tmp_path / "tokenizer.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(InputFileError, match=r"not that of T5.*\(1, 0, 2\)"):
        T5Tokenizer(tmp_path)


def test_a_missing_transformers_is_named_with_its_extra(tokenizer_folder, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingExtraError, match=r"openvima\[t5\]"):
        T5Tokenizer(tokenizer_folder)


@pytest.mark.parametrize("name", ["t5-base", "google-t5/t5-base@v2"])
def test_an_id_is_fetched_from_the_hub_without_anything_that_is_not_needed(
    name, tokenizer_folder, monkeypatch
) -> None:
    asked = []

    def download(repository: str, *, revision: str | None, allow_patterns: list[str], **_: object) -> str:
        asked.append((f"{repository}@{revision}" if revision else repository, allow_patterns))
        return str(tokenizer_folder)

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    assert T5Tokenizer(name).encode("Put") == ids("▁Put")
    ((repository, patterns),) = asked
    assert repository == name
    assert "tokenizer.json" in patterns
    assert not any("model.safetensors" in pattern or "*" in pattern for pattern in patterns)


def t5_sizes(sizes, **changes):
    """The sizes of a network, with a small T5 as its text encoder."""
    prompt = replace(sizes.prompt, text=TEXT, vocabulary_size=128, tokenizer="t5")
    return replace(sizes, prompt=replace(prompt, **changes))


def test_the_tokenizer_follows_from_the_config(small_sizes, tokenizer_folder) -> None:
    assert tokenizer_for(small_sizes.prompt).vocabulary == benchmark_vocabulary()
    prompt = t5_sizes(small_sizes).prompt
    assert tokenizer_for(prompt, tokenizer_folder).encode("Put") == ids("▁Put")
    with pytest.raises(PolicyError, match="'t5-base'"):
        tokenizer_for(prompt)
    with pytest.raises(PolicyError, match="118 ids, the policy 100"):
        tokenizer_for(replace(prompt, vocabulary_size=100), tokenizer_folder)


@pytest.fixture(scope="module")
def weights_folder(tmp_path_factory) -> Path:
    return write_t5(tmp_path_factory.mktemp("weights"), TEXT, 128)


@pytest.fixture(scope="module")
def reference(weights_folder):
    """A small T5 encoder of transformers."""
    from transformers import T5EncoderModel

    return T5EncoderModel.from_pretrained(weights_folder).eval()


def loaded(sizes, folder: Path, **changes) -> PolicyNetwork:
    network = build_network(t5_sizes(sizes, **changes), seed=0).eval()
    load_t5(network, folder)
    return network


@torch.no_grad()
def test_hidden_states_equal_those_of_transformers_with_masks_and_far_positions(
    reference, weights_folder, small_sizes
) -> None:
    prompt = loaded(small_sizes, weights_folder).prompt
    generator = torch.Generator().manual_seed(1)
    word_ids_BL = torch.randint(0, 128, (3, 150), generator=generator)  # distances beyond the last bucket
    mask_BL = torch.rand(3, 150, generator=generator) < 0.7
    expected = reference(input_ids=word_ids_BL, attention_mask=mask_BL.long()).last_hidden_state
    actual = prompt.text(prompt.words(word_ids_BL), mask_BL)
    atol = 1e-5 * max(1.0, float(expected[mask_BL].abs().max()))  # rounding grows with the values
    torch.testing.assert_close(actual[mask_BL], expected[mask_BL], rtol=0, atol=atol)


def test_weights_in_half_precision_are_read(reference, weights_folder, small_sizes, tmp_path) -> None:
    expected = loaded(small_sizes, weights_folder).state_dict()
    deepcopy(reference).bfloat16().save_pretrained(tmp_path / "half")
    half = loaded(small_sizes, tmp_path / "half").state_dict()
    for name, tensor in expected.items():
        assert half[name].dtype == torch.float32
        torch.testing.assert_close(half[name], tensor, rtol=1e-2, atol=1e-2)


def test_weights_of_other_sizes_are_refused_in_one_message_and_change_nothing(
    weights_folder, small_sizes
) -> None:
    sizes = t5_sizes(small_sizes, vocabulary_size=130, text=replace(TEXT, num_layers=2))
    network = build_network(sizes, seed=0)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    with pytest.raises(InputFileError) as caught:
        load_t5(network, weights_folder)
    message = str(caught.value)
    assert "prompt.words.weight is float32 (128, 24) instead of float32 (130, 24)" in message
    assert "prompt.text.blocks.2.key.weight" in message
    assert " and 3 more" in message
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())


def test_gated_encoders_of_later_versions_are_refused(reference, small_sizes, tmp_path) -> None:
    values = dict(reference.state_dict())
    values["encoder.block.1.layer.1.DenseReluDense.wi_0.weight"] = values.pop(
        "encoder.block.1.layer.1.DenseReluDense.wi.weight"
    )
    values.pop("encoder.embed_tokens.weight", None)  # shares its memory
    save_file(values, tmp_path / "model.safetensors")
    with pytest.raises(
        InputFileError, match=r"missing: .*widen\.weight; unexpected: .*wi_0\.weight.* T5 1\.0"
    ):
        loaded(small_sizes, tmp_path)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_the_norm_of_large_values_in_half_precision_is_that_of_float32(dtype) -> None:
    norm, x = RmsNorm(768), 300 * torch.randn(4, 768, generator=torch.Generator().manual_seed(0))
    halved = norm.to(dtype)(x.to(dtype))
    assert halved.dtype == dtype
    expected = norm.float()(x.to(dtype).float()).to(dtype)
    torch.testing.assert_close(halved, expected, rtol=0, atol=0)
