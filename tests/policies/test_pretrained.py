"""Policies from elsewhere: folders, published files, the Hub; and the tokenizer that some of them need."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.errors import InputFileError, MissingExtraError, PolicyError, UnknownPolicyError
from openvima.policies import RandomPolicy, load_policy, preset
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.naming import TOKENIZER_FOLDER
from openvima.policies.t5 import T5Tokenizer
from openvima.policies.tokenizer import VOCABULARY_FILE
from published_policies import small_vima, write_published, write_tokenizer


@pytest.fixture
def policy(small_sizes) -> NetworkPolicy:
    """A small policy that computes in float64."""
    return NetworkPolicy(build_network(small_sizes, seed=3))


@pytest.fixture
def published(tmp_path):
    """A small published file."""
    return write_published(build_network(small_vima(), seed=2), tmp_path / "2M.ckpt")


@pytest.fixture
def tokenizer(tmp_path) -> T5Tokenizer:
    """A small tokenizer of T5."""
    pytest.importorskip("transformers")
    return T5Tokenizer(write_tokenizer(tmp_path / "t5"))


def first_action(policy, demonstrations) -> dict[str, np.ndarray]:
    demo = demonstrations[0]
    policy.reset([demo.prompt])
    return policy.act([demo.observation(0)])[0]


def assert_same_actions(first, second, demonstrations) -> None:
    mine, theirs = first_action(first, demonstrations), first_action(second, demonstrations)
    assert all(np.array_equal(mine[key], theirs[key]) for key in mine)


def test_a_saved_policy_comes_back(policy, demonstrations, tmp_path) -> None:
    policy.save_pretrained(tmp_path / "saved")
    assert (tmp_path / "saved" / TOKENIZER_FOLDER / VOCABULARY_FILE).is_file()
    assert_same_actions(load_policy(str(tmp_path / "saved")), policy, demonstrations)


def test_options_reach_the_policy(policy, tmp_path) -> None:
    policy.save_pretrained(tmp_path / "saved")
    loaded = load_policy(str(tmp_path / "saved"), dtype=torch.bfloat16)
    assert {tensor.dtype for tensor in loaded.network.parameters()} == {torch.bfloat16}
    assert load_policy("untrained", dtype=torch.float32).dtype == torch.float32
    with pytest.raises(PolicyError, match="temperature is -1"):
        load_policy(str(tmp_path / "saved"), temperature=-1.0)
    assert isinstance(load_policy("random", dtype=torch.float32), RandomPolicy)


@pytest.mark.parametrize("device", ["cdua", "cuda:99", "meta"])
def test_a_device_that_is_not_there_is_refused(device: str) -> None:
    with pytest.raises(PolicyError, match=f"device '{device}' cannot be used here; allowed: cpu, and cuda"):
        load_policy("untrained", device=device)


def test_a_published_file_is_a_policy_with_a_tokenizer_that_is_stored_with_it(
    published, tokenizer, demonstrations, tmp_path
) -> None:
    policy = load_policy(str(published), tokenizer=tokenizer)
    assert policy.network.config == replace(small_vima(), prompt=policy.network.config.prompt)
    assert policy.processor.tokenizer is tokenizer
    policy.save_pretrained(tmp_path / "saved")
    loaded = load_policy(str(tmp_path / "saved"))
    assert loaded.processor.tokenizer.encode("Put the z.") == tokenizer.encode("Put the z.")
    assert_same_actions(loaded, policy, demonstrations)


@pytest.mark.slow
def test_without_a_tokenizer_the_error_says_how_to_give_one(published) -> None:
    network, stored = load_network(published)
    assert stored is None
    for make in (
        lambda: load_policy(str(published)),
        lambda: load_policy("untrained:vima-2m"),
        lambda: NetworkPolicy(network),
    ):
        with pytest.raises(PolicyError, match=r"tokenizer=T5Tokenizer.*policies convert IN OUT --tokenizer"):
            make()


def test_a_path_that_is_not_there_is_refused(tmp_path) -> None:
    with pytest.raises(InputFileError, match="there is no checkpoint at"):
        load_network(tmp_path / "nowhere")
    with pytest.raises(UnknownPolicyError, match="there is no policy"):
        load_policy(str(tmp_path / "nowhere"))


def test_without_the_client_of_the_hub_its_package_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'openvima\[hub\]'"):
        load_policy("owner/some.policy-1")


@pytest.mark.parametrize("name", ["nano", "vima-nano"])
def test_a_preset_has_no_weights_and_the_error_says_how_to_get_some(name) -> None:
    ways = rf"'{name}' is a preset.*`openvima train --preset {name} --data DEMOS --out RUN`.*openvima-small"
    with pytest.raises(UnknownPolicyError, match=rf"{ways}.*untrained:{name} has random ones"):
        load_policy(name)
    with pytest.raises(InputFileError, match=ways):
        load_network(name)


def test_fresh_weights_of_a_preset_have_a_name() -> None:
    assert load_policy("untrained:vima-nano").network.config == preset("vima-nano")
    assert load_policy("untrained").network.config == preset("nano")
    with pytest.raises(UnknownPolicyError, match=r"no preset 'vima-nona'\. Did you mean 'vima-nano'"):
        load_policy("untrained:vima-nona")
