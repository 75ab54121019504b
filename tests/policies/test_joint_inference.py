"""Sessions of a network that act in one batch, in pieces, get the actions that they get alone."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.errors import PolicyError  # noqa: E402
from openvima.policies import load_policy, preset  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from openvima.policies.episodes import JointCall  # noqa: E402
from openvima.policies.inference import NetworkPolicy  # noqa: E402
from openvima.scene import RenderedPrompt  # noqa: E402
from small_networks import narrow_small  # noqa: E402

FAST = ("nano", "small", "gato-nano")
SLOW = ("nano-bins", "vima-nano", "flamingo-nano", "gpt-nano", "midas-nano", "openvima-small")
# What each session does in a round: begins so many episodes, acts in those that go on, or waits.
ROUNDS: tuple[tuple[str | int, ...], ...] = (
    (1, 3, 1, 2),
    ("act", "act", "wait", "act"),
    ("act", "wait", "act", "act but the first"),
    (2, "act", "act", "act but the first"),
    ("act", 1, "act", "act but the first"),
    ("act", "act", "act", "act but the first"),
)


Calls = Sequence[tuple[NetworkPolicy, str, Sequence[Any]]]


def make(name: str) -> NetworkPolicy:
    if name == "openvima-small":
        return load_policy(name)  # type: ignore[return-value]
    network = build_network(narrow_small() if name == "small" else preset(name), seed=3)
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():  # fresh heads start near zero
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return NetworkPolicy(network)


@pytest.fixture(
    scope="module", params=[*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]
)
def policy(request) -> NetworkPolicy:
    return make(request.param)


@pytest.fixture(scope="module")
def pool(demonstrations) -> list[dict]:
    return [demo.observation(t) for demo in demonstrations for t in range(demo.num_steps + 1)]


@pytest.fixture(scope="module")
def prompts(demonstrations) -> list[RenderedPrompt]:
    """Prompts of several lengths; one names the texture of an object in words."""
    told = [demo.prompt for demo in demonstrations]
    return [*told, replace(told[0], text=told[0].text + " It is the red and blue one, not the green one.")]


def alone(calls: Calls) -> list[Any]:
    return [getattr(session, kind)(inputs) for session, kind, inputs in calls]


def together(calls: Calls, rows: int = 2) -> list[Any]:
    """The same in batches of up to so many rows of each call."""
    made = [session.joint_call(kind, inputs) for session, kind, inputs in calls]
    joint = [call for call in made if call is not None]
    assert len(joint) == len(calls)
    while left := [call for call in joint if call.num_left]:
        group = [call for call in left if call.joins(left[0])]
        JointCall.compute_together([(call, min(rows, call.num_left)) for call in group])
    finished: list[Any] = [call.finish() for call in joint]
    return finished


def play(policy: NetworkPolicy, prompts, pool, compute) -> list[Any]:
    sessions = [policy.new_session() for _ in ROUNDS[0]]
    sizes, given = [0] * len(sessions), []
    for number, doings in enumerate(ROUNDS):
        calls = []
        for s, (session, doing) in enumerate(zip(sessions, doings, strict=True)):
            if isinstance(doing, int):
                sizes[s] = doing
                inputs = [prompts[(s + number + n) % len(prompts)] for n in range(doing)]
                calls.append((session, "reset", inputs))
            elif doing != "wait":
                inputs = [pool[(5 * s + 3 * number + 2 * n) % len(pool)] for n in range(sizes[s])]
                inputs = [None, *inputs[1:]] if doing.endswith("first") else inputs
                calls.append((session, "act", inputs))
        given.append((compute(calls), [session.near_ties for session in sessions]))
    return given


def test_sessions_at_different_steps_get_the_bits_that_they_get_alone(policy, prompts, pool) -> None:
    separate, joint = (play(policy, prompts, pool, compute) for compute in (alone, together))
    actions = 0
    for (some, near), (others, also_near) in zip(separate, joint, strict=True):
        assert near == also_near
        for one, other in zip(some, others, strict=True):
            assert (one is None) == (other is None)
            for expected, got in zip(one or (), other or (), strict=True):
                assert (expected is None) == (got is None)
                for key, array in (expected or {}).items():
                    actions += 1
                    np.testing.assert_array_equal(got[key], array, strict=True)
    assert actions == 4 * 23


def test_an_error_of_one_session_leaves_all_as_they_were(policy, prompts, pool) -> None:
    good, bad = policy.new_session(), policy.new_session()
    together([(good, "reset", prompts[:1]), (bad, "reset", prompts[1:2])])
    broken = {**pool[0], "rgb": {**pool[0]["rgb"], "top": np.zeros((3, 2, 2), np.uint8)}}
    with pytest.raises(ValueError, match=r"\(3, 2, 2\)"):
        together([(good, "act", pool[:1]), (bad, "act", [broken])])
    twin = policy.new_session()
    twin.reset(prompts[:1])
    for step in range(2):
        (action,), (expected,) = good.act(pool[step : step + 1]), twin.act(pool[step : step + 1])
        for key, array in expected.items():
            np.testing.assert_array_equal(action[key], array, strict=True)


def test_a_call_that_cannot_be_computed_is_refused_before_it_waits_for_others(policy, prompts, pool) -> None:
    session = policy.new_session()
    with pytest.raises(PolicyError, match="call reset"):
        session.joint_call("act", pool[:1])
    with pytest.raises(PolicyError, match="reset got no prompts"):
        session.joint_call("reset", [])
    long = replace(prompts[0], text="put the " * 100 + prompts[0].text)
    with pytest.raises(PolicyError, match=r"40 prompts of up to 2\d\d tokens"):
        session.joint_call("reset", [long] + [prompts[1]] * 39)
    session.reset(prompts[:2])
    session.act([pool[0], None])
    with pytest.raises(PolicyError, match="episode 1 ended"):
        session.joint_call("act", pool[:2])


def test_a_session_does_not_keep_the_histories_of_others(policy, prompts, pool) -> None:
    session, other, twin = (policy.new_session() for _ in range(3))
    together([(session, "reset", prompts[:1]), (other, "reset", prompts[1:2])])
    twin.reset(prompts[:1])
    for _ in range(6):
        other.act(pool[-1:])
    for _ in range(3):
        together([(session, "act", pool[:1]), (other, "act", pool[-1:])])
        twin.act(pool[:1])
    assert session._episodes and twin._episodes
    kept, alone = session._episodes.cache, twin._episodes.cache
    assert kept.mask_BS.shape == alone.mask_BS.shape
    for keys, expected in zip(kept.past, alone.past, strict=True):
        assert [tuple(each.shape) for each in keys] == [tuple(each.shape) for each in expected]
        assert [each.untyped_storage().nbytes() for each in keys] == [each.nbytes for each in keys]


def test_where_rounding_or_samples_could_differ_nothing_is_computed_together(prompts) -> None:
    network = build_network(preset("nano"), seed=0)
    single = NetworkPolicy(network, dtype=torch.float32)
    assert single.joint_call("reset", prompts[:1]) is None
    sampled = NetworkPolicy(
        build_network(preset("nano"), seed=0), temperature=1.0, generator=torch.Generator()
    )
    assert sampled.joint_call("reset", prompts[:1]) is None
