"""Acting with caches equals decoding everything from scratch, whatever the batch."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.errors import PolicyError, PromptError, ShapeError, UnknownWordWarning
from openvima.perception.objects import GroundTruth, observe
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ACTION_WIDTH,
    ActionTargets,
    sampling,
)
from openvima.policies.nn.decoder import MAX_POSITIONS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.model import Pointer
from openvima.policies.presets import preset
from openvima.policies.variants import with_variant
from openvima.scene import Action, RenderedPrompt
from small_networks import perturbed

NAMES = ("nano", "nano-bins", "small", "vima-nano", "gato-nano", "flamingo-nano", "gpt-nano", "midas-nano")
LENGTHS = (5, 2, 3, 5)  # steps of the episodes that are played together


FAST, SLOW = ("nano", "small"), ("vima-nano", "gato-nano", "midas-nano")  # objects, frames, views
for_one_network = pytest.mark.parametrize("policy", ["nano"], indirect=True)  # what all share


@pytest.fixture(
    scope="module",
    params=[*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)],
)
def policy(request) -> NetworkPolicy:
    """One policy in double precision for each kind of network; every test resets it."""
    if request.param not in ("vima-nano", "midas-nano"):
        return NetworkPolicy(perturbed(request.param))
    return NetworkPolicy(perturbed(with_variant(preset(request.param), {"points": True})))


@pytest.fixture(scope="module")
def pool(demonstrations) -> list[dict]:
    """Observations of several tasks, with different numbers of objects."""
    return [demo.observation(t) for demo in demonstrations for t in range(demo.num_steps + 1)]


@pytest.fixture(scope="module")
def prompts(demonstrations) -> list[RenderedPrompt]:
    """Four prompts of different lengths."""
    return [demonstrations[row].prompt for row in (0, 2, 4, 1)]


def seen_by(row: int, step: int, pool: Sequence[dict]) -> dict:
    return pool[(5 * row + 3 * step) % len(pool)]


def batch_at(step: int, rows: Sequence[int], pool: Sequence[dict]) -> list[dict | None]:
    return [seen_by(row, step, pool) if step < LENGTHS[row] else None for row in rows]


def vector(action: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([action[key] for key in ACTION_PARTS])


def first_of_head(network: PolicyNetwork) -> torch.nn.Module:
    """The module of the head that is called first, once per call of the network."""
    return network.head.pick if isinstance(network, Pointer) else network.head.classifiers[0]


@contextmanager
def recorded_queries(network: PolicyNetwork) -> Iterator[list["torch.Tensor"]]:
    """Collect the decoder's outputs at the action queries, (B, T, D), of each call."""
    queries = []

    def record(_, arguments):
        (given,) = arguments
        queries.append(given.query_BTD if isinstance(network, Pointer) else given)

    hook = first_of_head(network).register_forward_pre_hook(record)
    try:
        yield queries
    finally:
        hook.remove()


def played(policy: NetworkPolicy, prompts, pool, rows: Sequence[int] = (0, 1, 2, 3)) -> dict:
    """Play episodes together; return (row, step) -> action and query, both as vectors."""
    policy.reset([prompts[row] for row in rows])
    result = {}
    with recorded_queries(policy.network) as queries:
        for step in range(max(LENGTHS[row] for row in rows)):
            actions = policy.act(batch_at(step, rows, pool))
            running = [row for row in rows if step < LENGTHS[row]]
            assert [row for row, action in zip(rows, actions, strict=True) if action is not None] == running
            for place, row in enumerate(running):
                action = actions[rows.index(row)]
                Action.from_arrays(action)
                assert all(value.dtype == np.float32 for value in action.values())
                result[row, step] = (vector(action), queries[-1][place, 0].double().numpy())
    return result


@torch.no_grad()
def recomputed(policy: NetworkPolicy, prompts, pool, actions: dict) -> dict:
    """For every step of every episode decode prompt and history from scratch; return (row, step) -> query."""
    network, processor = policy.network, policy.processor
    result = {}
    for step in range(max(LENGTHS)):
        rows = [row for row, length in enumerate(LENGTHS) if step < length]
        batch, stack = processor.encode_prompts([prompts[row] for row in rows])
        observations = [[seen_by(row, t, pool) for t in range(step + 1)] for row in rows]
        history, stack = processor.encode_observations(observations, stack=stack)
        features = network.encode_images(torch.from_numpy(stack.images()))
        prompt = network.encode_prompt(batch, features)
        taken = np.zeros((len(rows), step + 1, ACTION_WIDTH))
        for place, row in enumerate(rows):
            taken[place, :-1] = [actions[row, t][0] for t in range(step)] or taken[place, :-1]
        no_slots = torch.full_like(history.num_slots_BT, -1)
        targets = ActionTargets(torch.from_numpy(taken), no_slots, no_slots, history.steps_BT)
        with recorded_queries(network) as queries:
            network.loss(prompt, history, features, targets)
        for place, row in enumerate(rows):
            result[row, step] = queries[0][place, step].double().numpy()
    return result


def largest_difference(played_steps: dict, queries: dict) -> float:
    assert played_steps.keys() == queries.keys()
    return max(np.abs(played_steps[key][1] - queries[key]).max() for key in queries)


def assert_same_actions(some: dict, others: dict) -> None:
    for key, (action, _) in some.items():
        np.testing.assert_array_equal(action, others[key][0], err_msg=f"episode and step {key}")


@pytest.fixture(scope="module")
def together(policy, prompts, pool) -> dict:
    """What the policy does in all episodes at once."""
    return played(policy, prompts, pool)


def test_caches_change_nothing_in_a_ragged_batch(policy, prompts, pool, together) -> None:
    assert len(set(policy.processor.encode_prompts(prompts)[0].mask_BL.sum(1).tolist())) > 2
    assert largest_difference(together, recomputed(policy, prompts, pool, together)) < 1e-9


@pytest.mark.parametrize("name", ["nano-bins", "small", "flamingo-nano", "gpt-nano"])  # others: see above
@pytest.mark.slow
def test_in_single_precision_it_agrees_to_a_ten_thousandth(name, prompts, pool) -> None:
    policy = NetworkPolicy(perturbed(name), dtype=torch.float32)
    steps = played(policy, prompts, pool)
    assert largest_difference(steps, recomputed(policy, prompts, pool, steps)) < 1e-4


def test_neither_company_nor_order_changes_an_action(policy, prompts, pool, together) -> None:
    for rows in ((3, 2, 1, 0), (1, 3)):
        assert_same_actions(played(policy, prompts, pool, rows), together)


def test_history_and_prompt_change_the_action(policy, prompts, pool) -> None:
    """Without this the tests above could pass for a network that ignores its input."""
    policy.reset([prompts[0], prompts[1], prompts[0]])
    with recorded_queries(policy.network) as queries:
        policy.act([pool[0], pool[0], pool[3]])
        policy.act([pool[5]] * 3)
    first, other_prompt, other_past = queries[-1][:, 0]
    assert (first - other_prompt).abs().max() > 1e-3
    assert (first - other_past).abs().max() > 1e-3


def test_images_that_did_not_change_are_encoded_once(policy, prompts, pool, monkeypatch) -> None:
    encode, counts = policy.network.encode_images, []
    monkeypatch.setattr(
        policy.network, "encode_images", lambda images: (counts.append(len(images)), encode(images))[1]
    )
    policy.reset([prompts[0], prompts[1]])
    counts.clear()
    for _ in range(2):
        policy.act([pool[0], pool[0]])
    assert counts[0] > 0
    assert counts[1] == 0


def test_an_episode_that_ended_stays_ended(policy, prompts, pool) -> None:
    policy.reset(prompts[:3])
    policy.act(pool[:3])
    assert [action is None for action in policy.act([pool[0], None, pool[2]])] == [False, True, False]
    with pytest.raises(PolicyError, match="episode 1 ended with a None before; call reset"):
        policy.act([pool[0], pool[1], pool[2]])
    assert policy.act([None, None, None]) == [None, None, None]


def broken(observation: dict) -> dict:
    return {**observation, "rgb": {view: rgb.astype(np.float32) for view, rgb in observation["rgb"].items()}}


def test_an_error_leaves_the_policy_as_it_was(policy, prompts, pool, together) -> None:
    """Each call below fails in a different place; then the episodes go on as if it had not been made."""
    crowded = max(pool, key=lambda observation: len(observe(observation)))
    policy.reset(prompts)
    for step in range(max(LENGTHS)):
        seen = batch_at(step, range(4), pool)
        with pytest.raises(ShapeError, match="rgb 'front' is float32"):
            policy.act([crowded, None, None, broken(pool[0])])
        with pytest.raises(PolicyError, match="got 1 observations for 4 prompts"):
            policy.act(seen[:1])
        with pytest.raises(PromptError, match="the prompt is empty"):
            policy.reset([prompts[1], RenderedPrompt("", {})])
        with pytest.MonkeyPatch.context() as patch, pytest.raises(RuntimeError, match="no luck"):
            patch.setattr(
                first_of_head(policy.network),
                "forward",
                lambda *_: (_ for _ in ()).throw(RuntimeError("no luck")),
            )
            policy.act([None, None, None, pool[2]] if seen[3] is not None else [None] * 4)
        for row, action in enumerate(policy.act(seen)):
            if action is not None:
                np.testing.assert_array_equal(vector(action), together[row, step][0])


def test_half_precision_does_not_blur_the_places_that_it_points_at(prompts, pool) -> None:
    """The grasp point is a measured place; rounding it to bfloat16 would move it by up to 2 mm."""
    policy = NetworkPolicy(perturbed("nano"), dtype=torch.bfloat16)
    policy.reset([prompts[0]])
    (action,) = policy.act([pool[0]])
    grasps = policy.processor.encode_observations([[pool[0]]])[0].grasps_BTN2[0, 0].numpy()
    assert np.abs(grasps - action["pose0_position"]).max(axis=1).min() < 1e-6


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_gpu_gives_valid_actions_and_in_single_precision_the_same_queries(
    name, dtype, prompts, pool
) -> None:
    steps = played(NetworkPolicy(perturbed(name), device="cuda", dtype=dtype), prompts, pool)
    assert all(np.isfinite(action).all() and np.isfinite(query).all() for action, query in steps.values())
    if dtype is torch.float32:
        reference = NetworkPolicy(perturbed(name))
        assert largest_difference(steps, recomputed(reference, prompts, pool, steps)) < 1e-2


def test_draws_follow_from_the_generator_alone_and_leave_it_alone(policy, prompts, pool) -> None:
    generator = torch.Generator().manual_seed(11)
    state = generator.get_state()
    drawn = NetworkPolicy(policy.network, temperature=2.0, generator=generator)
    first = played(drawn, prompts, pool)
    assert_same_actions(played(drawn, prompts, pool, (3, 1)), first)
    assert torch.equal(generator.get_state(), state)
    other = NetworkPolicy(policy.network, temperature=2.0, generator=torch.Generator().manual_seed(12))
    others = played(other, prompts, pool)
    assert any(not np.array_equal(others[key][0], first[key][0]) for key in first)


def test_a_low_temperature_gives_the_greedy_actions(policy, prompts, pool, together) -> None:
    cold = NetworkPolicy(policy.network, temperature=1e-9, generator=torch.Generator().manual_seed(1))
    assert_same_actions(played(cold, prompts, pool), together)


def test_samples_have_the_distribution_of_the_logits() -> None:
    """Chi-square over 4000 draws from five classes and a hidden one, at temperature 2."""
    scores = torch.tensor([0.0, 3.0, 1.0, torch.finfo(torch.float32).min, 2.0, 4.0])
    probabilities = torch.softmax(scores.double() / 2, dim=-1).numpy()
    generators = [torch.Generator().manual_seed(seed) for seed in range(4000)]
    drawn = sampling(generators, 2.0)(scores.expand(4000, 1, 6)).flatten()
    counts = np.bincount(drawn.numpy(), minlength=6)
    assert counts[3] == 0
    shown = probabilities > 0
    expected = 4000 * probabilities[shown]
    assert ((counts[shown] - expected) ** 2 / expected).sum() < 23.5  # exceeded once in 10 000 times


@pytest.mark.parametrize(
    ("temperature", "generator"),
    [(0.5, None), *((temperature, torch.Generator()) for temperature in (-1.0, math.nan, math.inf))],
)
def test_a_temperature_that_makes_no_sense_is_refused(small_sizes, temperature, generator) -> None:
    with pytest.raises(
        PolicyError, match=f"temperature is {temperature:g}; it must be 0, or a finite number above 0"
    ):
        NetworkPolicy(build_network(small_sizes, seed=0), temperature=temperature, generator=generator)


@for_one_network
def test_a_word_that_nobody_taught_is_named_once_for_all_sessions_of_a_policy(policy, prompts) -> None:
    prompt = replace(prompts[0], text=f"Juggle {prompts[0].text} Wildly!")
    with pytest.warns(UnknownWordWarning, match="in training: 'juggle', 'wildly'[.]") as caught:
        policy.reset([prompt])
    assert len(caught) == 1
    for session in (policy, policy.new_session()):
        session.reset([replace(prompt, text=prompt.text + " Juggle!")])  # a warning would be an error


@for_one_network
def test_a_prompt_longer_than_the_position_table_is_refused_before_it_is_encoded(
    policy, prompts, monkeypatch
) -> None:
    text = "put the " * 150 + prompts[0].text
    monkeypatch.setattr(policy.network, "encode_images", lambda images: pytest.fail("encoded"))
    monkeypatch.setattr(policy.network, "encode_prompt", lambda *inputs: pytest.fail("encoded"))
    with pytest.raises(PolicyError, match=r"the prompt has 3\d\d tokens; this policy takes 256"):
        policy.reset([prompts[1], RenderedPrompt(text, prompts[0].images)])


@for_one_network
def test_a_prompt_of_hundreds_of_kilobytes_is_refused_before_it_is_split(policy, monkeypatch) -> None:
    monkeypatch.setattr("openvima.policies.processor.preprocess_prompt", lambda *_: pytest.fail("split"))
    with pytest.raises(PromptError, match="the prompt has 400,000 characters; this policy takes 4,096"):
        policy.reset([RenderedPrompt("put the " * 50_000, {})])
    with pytest.raises(PromptError, match="1,300 images; this policy takes 64"):
        policy.reset([RenderedPrompt("{a}" * 1300, {})])


@for_one_network
def test_a_history_longer_than_the_position_table_is_refused(policy, prompts, pool) -> None:
    policy.reset([prompts[0]])
    crowded = max(pool, key=lambda observation: len(observe(observation)))
    with pytest.raises(PolicyError, match=rf"history has 5\d\d tokens; this policy takes {MAX_POSITIONS}"):
        for _ in range(MAX_POSITIONS):
            policy.act([crowded])


class Doubled(GroundTruth):
    """Finds every object a hundred times."""

    def in_observation(self, observation):
        found = super().in_observation(observation)
        return found.select(np.tile(np.arange(len(found)), 600 // len(found) + 1))


@pytest.mark.parametrize(("name", "limit"), [("nano", 511), ("vima-nano", 255)])
def test_more_objects_than_fit_are_refused(name, limit, prompts, pool) -> None:
    policy = NetworkPolicy(perturbed(name), extractor=Doubled())
    policy.reset([prompts[0]])
    with pytest.raises(PolicyError, match=rf"shows 6\d\d objects; this policy takes {limit}"):
        policy.act([pool[0]])
