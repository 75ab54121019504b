"""Autoregressive decoding: the chain rule, caches, causality; and the visual residual."""

from dataclasses import replace

import pytest
import torch

from openvima.policies import preset
from openvima.policies.batch import Batch
from openvima.policies.build import build_network
from openvima.policies.nn.action_head import NUM_BINS, decode_bins, encode_bins
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ACTION_WIDTH,
    ActionTargets,
    from_unit_range,
    to_unit_range,
)
from openvima.policies.nn.heads import (
    AutoregressiveHead,
    ComponentTokens,
)
from openvima.policies.nn.policy_network import PolicyNetwork, StepInputs
from openvima.policies.processor import Processor
from openvima.policies.variants import with_variant
from small_networks import collate_examples, examples_of, perturbed

# One decoder; and cross-attention, with the last slot or with a query token as the action query.
CONFIGS = {
    "midas": preset("midas-nano"),
    "vima": with_variant(preset("vima-nano"), {"visual_residual": True, "head": "autoregressive"}),
    "query": with_variant(preset("nano-bins"), {"head": "autoregressive"}),
}


@pytest.fixture(scope="module", params=CONFIGS)
def network(request) -> PolicyNetwork:
    return perturbed(CONFIGS[request.param]).double()


def read(network: PolicyNetwork, demonstrations) -> tuple[Batch, "torch.Tensor"]:
    """A batch, and the features of its images."""
    processor = Processor(*network.config.inputs)
    examples, images = examples_of(demonstrations, processor)
    return collate_examples(processor, examples), network.encode_images(images)


def forward(network: PolicyNetwork, prompt, history, features, targets: ActionTargets):
    """Loss and metrics of whole histories, and the logits of all components, each (B, T, bins)."""
    logits = {}

    def record(component: int):
        return lambda _, __, result: logits.setdefault(component, result)

    hooks = [
        classifier.register_forward_hook(record(component))
        for component, classifier in enumerate(network.head.classifiers)
    ]
    loss, metrics = network.loss(prompt, history, features, targets)
    for hook in hooks:
        hook.remove()
    return loss, metrics, [logits[component] for component in range(ACTION_WIDTH)]


@torch.no_grad()
def teacher_forced(network: PolicyNetwork, demonstrations, actions: "torch.Tensor | None" = None):
    """Logits of all components of all actions, each (B, T, bins), and the batch."""
    batch, features = read(network, demonstrations)
    targets = batch.targets if actions is None else replace(batch.targets, actions_BTC=actions)
    prompt = network.encode_prompt(batch.prompts, features)
    return forward(network, prompt, batch.history, features, targets)[2], batch


def step_of(record, step: int):
    """One step of a history."""
    fields = {name: getattr(record, name) for name in type(record).__slots__}
    return type(record)(**{name: tensor[:, step : step + 1] for name, tensor in fields.items()})


@torch.no_grad()
@pytest.mark.slow
def test_incremental_log_probabilities_sum_to_the_teacher_forced_likelihood(network, demonstrations) -> None:
    logits, batch = teacher_forced(network, demonstrations)
    bins_BTC = encode_bins(to_unit_range(batch.targets.actions_BTC))
    steps_BT = batch.targets.steps_BT
    assert steps_BT.sum() > len(steps_BT)  # padded, with more than one step somewhere
    forced = sum(
        score.log_softmax(-1).gather(-1, bins_BTC[..., c, None]).squeeze(-1) for c, score in enumerate(logits)
    )

    _, features = read(network, demonstrations)
    prompt = network.encode_prompt(batch.prompts, features)
    state, previous = network.init_cache(prompt), torch.zeros_like(batch.targets.actions_BTC[:, :1])
    for step in range(steps_BT.shape[1]):
        has_previous = torch.full_like(steps_BT[:, :1], step > 0)
        history = step_of(batch.history, step)
        total, undecoded = torch.zeros(len(steps_BT), dtype=torch.float64), iter(range(ACTION_WIDTH))

        def as_demonstrated(
            logits_B1K, bins_B1C=bins_BTC[:, step : step + 1], undecoded=undecoded, total=total
        ):
            chosen_B1 = bins_B1C[..., next(undecoded)]
            total += logits_B1K.log_softmax(-1).gather(-1, chosen_B1[..., None])[:, 0, 0]
            return chosen_B1

        inputs = StepInputs(prompt, state, history, features, previous, has_previous)
        _, state = network.decode_step(inputs, as_demonstrated)
        exists = steps_BT[:, step]
        torch.testing.assert_close(total[exists], forced[exists, step], rtol=0, atol=1e-5)
        previous = batch.targets.actions_BTC[:, step : step + 1]


@pytest.mark.slow
def test_a_component_depends_only_on_those_before_it(network, demonstrations) -> None:
    logits, batch = teacher_forced(network, demonstrations)
    for component in range(ACTION_WIDTH):
        changed = batch.targets.actions_BTC.clone()
        last = batch.targets.steps_BT.sum(1) - 1  # later tokens do not change earlier outputs
        rows = torch.arange(len(last))
        moved = to_unit_range(changed[rows, last].double())
        moved[:, component] = (moved[:, component] + 0.5) % 1
        changed[rows, last] = from_unit_range(moved).to(changed.dtype)
        others, _ = teacher_forced(network, demonstrations, changed)
        differs = [
            not torch.equal(old[rows, last], new[rows, last]) for old, new in zip(logits, others, strict=True)
        ]
        assert differs == [later > component for later in range(ACTION_WIDTH)], component


def test_the_loss_is_that_of_the_published_head_on_these_logits(network, demonstrations) -> None:
    batch, features = read(network, demonstrations)
    actions = batch.targets.actions_BTC
    prompt = network.encode_prompt(batch.prompts, features)
    loss, metrics, logits = forward(network, prompt, batch.history, features, batch.targets)
    bins_BTC, exists = encode_bins(to_unit_range(actions)), batch.targets.steps_BT
    parts = torch.zeros((), dtype=torch.float64)
    for part in ACTION_PARTS.values():
        for c in range(part.start, part.stop):
            probabilities = logits[c].softmax(-1).gather(-1, bins_BTC[..., c, None])
            parts = parts - probabilities[exists].log().mean() / (part.stop - part.start)
    torch.testing.assert_close(loss, parts)
    assert isinstance(network.head, AutoregressiveHead)
    assert metrics.keys() >= {"accuracy", "pick_accuracy", "query_spread"}


@torch.no_grad()
def test_positions_from_objects_are_read_before_the_next_component_is_decoded(demonstrations) -> None:
    config = with_variant(preset("midas-nano"), {"points": True})
    network = perturbed(config, seed=4).double()
    batch, features = read(network, demonstrations)
    prompt, steps = network.encode_prompt(batch.prompts, features), batch.targets.steps_BT[:, :1]
    none = torch.zeros_like(batch.targets.actions_BTC[:, :1])
    history = step_of(batch.history, 0)
    actions, _ = network.decode_step(
        StepInputs(prompt, network.init_cache(prompt), history, features, none, torch.zeros_like(steps))
    )
    targets = replace(batch.targets, actions_BTC=actions, steps_BT=steps)
    metrics = network.loss(prompt, history, features, targets)[1]
    assert metrics["pick_accuracy"] == metrics["place_accuracy"] == 1
    observations, cache = network._observe(prompt, network.init_cache(prompt), history, features)
    points = observations.points_BTQ2
    torch.testing.assert_close(network.head.loss(network.decoder, cache, observations, targets)[2], actions)
    assert ((actions[:, :, None, :2] - points).norm(dim=-1).amin(-1) < 1e-6).all()


@pytest.mark.parametrize("component", range(ACTION_WIDTH))
def test_actions_as_they_are_sent_come_back_as_the_same_tokens(component: int) -> None:
    bins = torch.zeros(NUM_BINS[component], ACTION_WIDTH, dtype=torch.int64)
    bins[:, component] = torch.arange(NUM_BINS[component])
    sent = from_unit_range(decode_bins(bins)).to(torch.float32)
    tokens = ComponentTokens(4, std=1.0)
    back = tokens(to_unit_range(sent.double()))
    assert torch.equal(back[:, component], tokens.embed(component, torch.arange(NUM_BINS[component])))
    assert len(back[:, component].unique(dim=0)) == NUM_BINS[component]


@torch.no_grad()
def test_the_residual_changes_the_prompt_at_images_alone_by_what_goes_in(demonstrations) -> None:
    on = perturbed(with_variant(preset("vima-nano"), {"visual_residual": True})).double()
    off = build_network(preset("vima-nano"), seed=0).double().eval()
    off.load_state_dict(on.state_dict())
    batch, features = read(on, demonstrations)
    prompts = batch.prompts
    residual, plain = (network.encode_prompt(prompts, features) for network in (on, off))
    added_BLD = residual.tokens_BLD - plain.tokens_BLD
    is_image_BL = prompts.object_index_BL >= 0
    assert not added_BLD[~is_image_BL].any()
    tokens_IE = on.images(features[prompts.crop_index_VS], prompts.boxes_VS4, prompts.masks_VS)
    expected = on.prompt.images(tokens_IE)[prompts.object_index_BL[is_image_BL]]
    torch.testing.assert_close(added_BLD[is_image_BL], expected)  # widths are equal: no layer behind
    assert expected.abs().max() > 1e-3


def test_fresh_tokens_of_bins_are_heard_and_alike_where_bins_are_near():
    tokens = build_network(preset("midas-nano"), seed=0).head.actions
    for component, count in enumerate(NUM_BINS):
        vectors_ND = tokens.embed(component, torch.arange(count))
        assert 0.25 < vectors_ND.std(dim=0).square().mean().sqrt() < 0.6
        near = torch.cosine_similarity(vectors_ND[:-1], vectors_ND[1:])
        far = torch.cosine_similarity(vectors_ND[: count // 2], vectors_ND[count // 2 :])
        assert near.min() > 0.9 and far.abs().mean() < 0.4
