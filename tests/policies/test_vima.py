"""The nano network: sizes, masks, batches, gradients, checkpoints."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import yaml  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402

from openvima.errors import CheckpointError, ConfigError, PolicyError, PromptError  # noqa: E402
from openvima.policies import load_policy, preset  # noqa: E402
from openvima.policies.acting import NetworkPolicy  # noqa: E402
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint  # noqa: E402
from openvima.policies.config import PolicyConfig  # noqa: E402
from openvima.policies.heads.base import from_unit_range, to_unit_range  # noqa: E402
from openvima.policies.heads.bins import BinsConfig, decode_bins, encode_bins  # noqa: E402
from openvima.policies.heads.pointing import carried_place, yaw_bin  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.policies.layers.trunk import Decoder, DecoderConfig  # noqa: E402
from openvima.policies.network import PolicyNetwork, build_network  # noqa: E402
from openvima.scene import Action  # noqa: E402
from openvima.training.dataset import make_batch, read_examples  # noqa: E402


def played(policy: NetworkPolicy, demonstrations, *, num_steps: int = 2) -> list[list[dict]]:
    """Feed the observations of demonstrations, whatever the policy does, each to its own end."""
    policy.reset([demo.prompt for demo in demonstrations])
    actions: list[list[dict]] = [[] for _ in demonstrations]
    for step in range(num_steps):
        seen = [demo.observation(step) if step < demo.num_steps else None for demo in demonstrations]
        for row, action in enumerate(policy.act(seen)):
            assert (action is None) == (seen[row] is None)
            if action is not None:
                actions[row].append(action)
    return actions


def test_nano_has_two_to_five_million_parameters():
    count = sum(parameter.numel() for parameter in PolicyNetwork(preset("nano")).parameters())
    assert 2e6 < count < 5e6


@pytest.mark.parametrize("name", ["nano", "nano-bins"])
def test_actions_are_within_bounds_and_float32(demonstrations, name):
    for actions in played(load_policy(name), demonstrations):
        for action in actions:
            Action.from_arrays(action)
            assert all(value.dtype == np.float32 for value in action.values())


@pytest.mark.parametrize("bins", [False, True])
def test_a_batch_gives_the_same_actions_as_each_episode_alone(demonstrations, small_sizes, bins):
    sizes = replace(small_sizes, head=BinsConfig(32)) if bins else small_sizes
    policy = NetworkPolicy(build_network(sizes, seed=1))
    together = played(policy, demonstrations)
    backwards = played(policy, demonstrations[::-1])[::-1]
    for row, demo in enumerate(demonstrations):
        (alone,) = played(policy, [demo])
        for others in (together[row], backwards[row]):
            assert len(alone) == len(others)
            for first, second in zip(alone, others, strict=True):
                assert all(np.array_equal(first[key], second[key]) for key in first)


def test_fresh_weights_follow_from_the_seed_and_leave_global_state_alone(small_sizes):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, second, other = (build_network(small_sizes, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(torch.rand(3), expected)
    for name, weight in first.state_dict().items():
        assert torch.equal(weight, second.state_dict()[name])
    assert not torch.equal(first.prompt.words.weight, other.prompt.words.weight)


def test_gradients_reach_every_parameter(demonstrations, small_sizes):
    model = build_network(small_sizes, seed=0).eval()  # without dropout
    with torch.no_grad():
        for parameter in model.head.parameters():  # some start at zero, which would stop the gradient
            parameter.add_(0.01 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    examples = read_examples(demonstrations, Reader.of(small_sizes.images), validation_share=0, seed=0)
    batch = make_batch(examples.training)
    features = model.encode_images(examples.images)
    memory = model.encode_prompts(batch.prompts, features)
    loss, _ = model.head.loss(
        model(memory, batch.history, features, batch.targets.actions_BTC), batch.targets
    )
    loss.backward()
    without = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


def test_the_future_and_masked_places_change_nothing_before_them():
    torch.manual_seed(0)
    decoder = Decoder(DecoderConfig(width=16, num_layers=2, num_self_heads=2, num_cross_heads=2)).eval()
    tokens, prompt = torch.randn(1, 8, 16), torch.randn(1, 3, 16)
    mask, prompt_mask = torch.ones(1, 8, dtype=torch.bool), torch.tensor([[True, True, False]])
    mask[0, 3] = False

    def run(tokens, prompt):
        return decoder.extend(decoder.begin(prompt, prompt_mask), tokens, mask)[0]

    expected = run(tokens, prompt)
    changed = tokens.clone()
    changed[0, 6:] = 9.0  # future
    changed[0, 3] = 9.0  # masked
    changed_prompt = prompt.clone()
    changed_prompt[0, 2] = 9.0
    actual = run(changed, changed_prompt)
    torch.testing.assert_close(actual[0, [0, 1, 2, 4, 5]], expected[0, [0, 1, 2, 4, 5]])
    assert not torch.allclose(actual[0, 6], expected[0, 6])


def test_too_long_a_history_is_refused():
    decoder = Decoder(DecoderConfig(width=4, num_layers=1, num_self_heads=1, num_cross_heads=1))
    tokens, prompt = torch.zeros(1, 513, 4), torch.zeros(1, 1, 4)
    mask = torch.ones(1, 513, dtype=torch.bool)
    with pytest.raises(PolicyError, match="513 tokens; this policy takes 512"):
        decoder.extend(decoder.begin(prompt, mask[:, :1]), tokens, mask)


def test_bins_follow_the_published_rule():
    values = torch.tensor([0.0, 1e-6, 1 / 49, 0.5, 0.98, 1.0, 2.0, -1.0])
    bins = encode_bins(values[:, None].expand(-1, 12))
    assert bins[:, 0].tolist() == [0, 1, 1, 25, 49, 49, 49, 0]
    assert bins[:, 1].tolist()[3:6] == [50, 98, 99]
    assert decode_bins(bins)[3].tolist() == [0.5] * 12


def test_unit_range_undoes_itself_and_clips():
    actions = torch.tensor([[0.3, -0.4, 0.0, 0.0, 0.6, 0.8, 0.7, 0.5, 0.0, 0.0, 0.0, 1.0]])
    torch.testing.assert_close(from_unit_range(to_unit_range(actions)), actions)
    outside = from_unit_range(torch.full((1, 12), 2.0))
    assert outside[0, :2].tolist() == [0.75, 0.5]


def test_yaw_bins_are_centred_on_whole_steps():
    turns = torch.deg2rad(torch.tensor([0.0, 2.4, 2.6, -2.6, 180.0, -180.0, 357.6]))
    assert yaw_bin(turns, 72).tolist() == [0, 0, 1, 71, 36, 36, 0]


def test_a_place_follows_the_grasp_rigidly():
    """Grasped 2 cm further along x and turned by 90 degrees, the hand ends 2 cm further along y."""
    half = 0.5**0.5
    action = torch.tensor([[[0.4, 0.0, 0, 0, 0, 1, 0.6, 0.1, 0, 0, half, half]]])
    place = carried_place(action, torch.tensor([[[0.42, 0.0]]]))
    torch.testing.assert_close(place, torch.tensor([[[0.6, 0.12]]]))


def test_a_prompt_word_that_is_not_known_is_an_error(demonstrations):
    policy = load_policy("untrained")
    with pytest.raises(PromptError, match="'juggle'"):
        policy.reset([replace(demonstrations[0].prompt, text="Juggle " + demonstrations[0].prompt.text)])


def test_acting_before_a_reset_is_an_error(demonstrations):
    with pytest.raises(PolicyError, match="call reset"):
        load_policy("untrained").act([demonstrations[0].observation(0)])


def test_a_config_survives_its_file():
    for name in ("nano", "nano-bins"):
        text = yaml.safe_dump(preset(name).to_dict())
        assert PolicyConfig.from_dict(yaml.safe_load(text)) == preset(name)


def test_sizes_that_do_not_fit_are_named():
    sizes = preset("nano")
    with pytest.raises(ConfigError, match="make them equal"):
        replace(sizes, trunk=replace(sizes.trunk, width=64))
    with pytest.raises(ConfigError, match=r"policy\.trunk has unknown fields depth"):
        PolicyConfig.from_dict({**sizes.to_dict(), "trunk": {"depth": 3}})


def test_a_checkpoint_gives_the_same_policy_back(demonstrations, small_sizes, tmp_path):
    model = build_network(small_sizes, seed=7)
    save_checkpoint(model, tmp_path)
    loaded = load_policy(str(tmp_path))
    for mine, theirs in zip(
        played(NetworkPolicy(model), demonstrations), played(loaded, demonstrations), strict=True
    ):
        assert all(np.array_equal(a[key], b[key]) for a, b in zip(mine, theirs, strict=True) for key in a)


def test_everything_wrong_with_a_checkpoint_is_told_at_once(small_sizes, tmp_path):
    save_checkpoint(build_network(small_sizes, seed=0), tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    del weights["query"]
    weights["prompt.words.weight"] = weights["prompt.words.weight"][:5].contiguous()
    weights["prompt.images.0.bias"] = weights["prompt.images.0.bias"].half()
    weights["spare"] = torch.zeros(1)
    save_file(weights, tmp_path / "model.safetensors")
    with pytest.raises(CheckpointError) as error:
        load_checkpoint(tmp_path)
    for part in ("missing: query", "unexpected: spare", "words.weight is float32 (5, ", "is float16"):
        assert part in str(error.value)


def test_a_truncated_checkpoint_is_named(small_sizes, tmp_path):
    save_checkpoint(build_network(small_sizes, seed=0), tmp_path)
    file = tmp_path / "model.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="is damaged"):
        load_checkpoint(tmp_path)
