"""Requests of several clients in one batch: who waits for whom, and whose error is whose."""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from openvima.errors import PolicyError
from openvima.serving import RemotePolicy, serve_in_thread
from openvima.serving.protocol import encode_observation, encode_prompt, pack, unpack
from openvima.serving.server import DynamicBatcher, Session, fair_shares
from served_policies import ForMany, made_up_observation, made_up_prompt, told

BAD = 99  # observation that a batch cannot hold


class Batched:
    """Sessions that answer like `ForMany`, computed in batches, whose sizes are recorded.

    Attributes:
        batches: For each batch the rows of each call in it.
        free: Batches are computed while it is set.
    """

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.started, self.free = threading.Event(), threading.Event()
        self.free.set()

    def new_session(self) -> "BatchedSession":
        return BatchedSession(self)

    def reset(self, prompts) -> None:
        pytest.fail("a client got the policy itself")

    act = reset

    def compute(self, pieces: Sequence[tuple["Call", int]]) -> None:
        self.started.set()
        assert self.free.wait(20)
        self.batches.append([count for _, count in pieces])
        for call, count in pieces:
            rows = call.inputs[call.done : call.done + count]
            if any(call.kind == "act" and row["rgb"]["top"][0, 0, 0] == BAD for row in rows):
                raise PolicyError(f"number {BAD} came in")
        for call, count in pieces:
            call.done += count


class BatchedSession(ForMany):
    def __init__(self, policy: Batched) -> None:
        self.policy = policy

    def joint_call(self, kind: str, inputs: Sequence[Any]) -> "Call":
        return Call(self, kind, inputs)


class Call:
    """A call of `BatchedSession`."""

    def __init__(self, session: BatchedSession, kind: str, inputs: Sequence[Any]) -> None:
        self.session, self.kind, self.inputs, self.done = session, kind, inputs, 0

    @property
    def num_left(self) -> int:
        return len(self.inputs) - self.done

    def joins(self, other: "Call") -> bool:
        return self.kind == other.kind

    def compute_together(self, pieces: Sequence[tuple["Call", int]]) -> None:
        self.session.policy.compute(pieces)

    def finish(self) -> Any:
        return getattr(self.session, self.kind)(self.inputs)


def reset(*numbers: int) -> bytes:
    return pack({"type": "reset", "prompts": [encode_prompt(made_up_prompt(n)) for n in numbers]})


def act(*numbers: int) -> bytes:
    return pack(
        {"type": "act", "observations": [encode_observation(made_up_observation(n)) for n in numbers]}
    )


def answers(reply: bytes | str) -> list[tuple[int, int, int]]:
    assert isinstance(reply, bytes), reply
    return [told(action) for action in unpack(reply)["actions"]]  # type: ignore[index]


def run(
    policy: Batched,
    script: Callable[..., Awaitable[None]],
    max_batch: int = 16,
    executor: ThreadPoolExecutor | None = None,
) -> None:
    """Run a script with a batcher; whatever it waits for comes in time."""
    with ThreadPoolExecutor(2) as readers, executor or ThreadPoolExecutor(1) as computing:
        batcher = DynamicBatcher(readers, computing, max_batch)
        asyncio.run(asyncio.wait_for(script(batcher), 20))  # type: ignore[arg-type]
    assert policy.free.is_set()


async def submitted(batcher: DynamicBatcher, session: Session, data: bytes) -> Awaitable[bytes | str]:
    reply = await batcher.submit(session, data)
    assert not isinstance(reply, str)
    return reply


async def begun(batcher: DynamicBatcher, policy: Batched, sizes: Sequence[int]) -> list[Session]:
    """Sessions with so many episodes each."""
    sessions = [Session(policy.new_session(), 64) for _ in sizes]
    for number, (session, size) in enumerate(zip(sessions, sizes, strict=True), 1):
        await (await submitted(batcher, session, reset(*[number] * size)))
    policy.batches.clear()
    policy.free.clear()
    policy.started.clear()
    return sessions


def test_what_arrives_during_a_batch_is_the_next_one() -> None:
    policy = Batched()

    async def script(batcher: DynamicBatcher) -> None:
        sessions = await begun(batcher, policy, [1] * 4)
        replies = [await submitted(batcher, sessions[0], act(50))]
        await asyncio.to_thread(policy.started.wait)
        replies += [await submitted(batcher, each, act(50 + n)) for n, each in enumerate(sessions[1:], 1)]
        policy.free.set()
        for number, reply in enumerate(replies):
            assert answers(await reply) == [(number + 1, 50 + number, 1)]
        assert policy.batches == [[1], [1, 1, 1]]

    run(policy, script)


def test_a_client_with_many_episodes_lets_the_others_in() -> None:
    policy = Batched()

    async def script(batcher: DynamicBatcher) -> None:
        large, small, other = await begun(batcher, policy, [40, 1, 2])
        many = await submitted(batcher, large, act(*range(40)))
        await asyncio.to_thread(policy.started.wait)
        one, two = [await submitted(batcher, *each) for each in ((small, act(7)), (other, act(8, 9)))]
        policy.free.set()
        assert answers(await one) == [(2, 7, 1)]
        assert answers(await two) == [(3, 8, 1), (3, 9, 1)]
        assert answers(await many) == [(1, n, 1) for n in range(40)]
        assert policy.batches == [[16], [1, 2, 13], [11]]

    run(policy, script)


def test_resets_and_steps_take_turns() -> None:
    policy = Batched()

    async def script(batcher: DynamicBatcher) -> None:
        first, second, third = await begun(batcher, policy, [20, 1, 1])
        replies = [await submitted(batcher, first, act(*range(20)))]
        await asyncio.to_thread(policy.started.wait)
        replies.append(await submitted(batcher, second, reset(1, 2)))
        replies.append(await submitted(batcher, third, act(6)))
        policy.free.set()
        await asyncio.gather(*replies)
        assert policy.batches == [[16], [2], [1, 4]]

    run(policy, script)


def test_the_error_of_one_observation_is_that_of_its_client() -> None:
    policy = Batched()

    async def script(batcher: DynamicBatcher) -> None:
        sessions = await begun(batcher, policy, [1] * 4)
        first = await submitted(batcher, sessions[0], act(1))
        await asyncio.to_thread(policy.started.wait)
        numbers = (2, BAD, 3)
        replies = [
            await submitted(batcher, each, act(number))
            for each, number in zip(sessions[1:], numbers, strict=True)
        ]
        policy.free.set()
        await first
        good, bad, also_good = await asyncio.gather(*replies)
        assert policy.batches == [[1], [1, 1, 1], [1], [1], [1]]
        assert answers(good) == [(2, 2, 1)]
        assert answers(also_good) == [(4, 3, 1)]
        assert bad == f"PolicyError: number {BAD} came in"
        # And the client goes on.
        again = await submitted(batcher, sessions[2], act(5))
        assert answers(await again) == [(3, 5, 1)]

    run(policy, script)


def test_clients_that_are_gone_harm_no_other() -> None:
    policy = Batched()

    async def script(batcher: DynamicBatcher) -> None:
        sessions = await begun(batcher, policy, [1] * 4)
        replies = [await submitted(batcher, sessions[0], act(1))]
        await asyncio.to_thread(policy.started.wait)
        replies += [await submitted(batcher, each, act(2)) for each in sessions[1:]]
        for gone in (replies[0], replies[2]):  # one that is computed now, and one that waits
            gone.cancel()  # type: ignore[attr-defined]
        await asyncio.sleep(0)  # until that is told
        policy.free.set()
        assert answers(await replies[1]) == [(2, 2, 1)]
        assert answers(await replies[3]) == [(4, 2, 1)]
        assert policy.batches == [[1], [1, 1]]

    run(policy, script)


def test_requests_that_wait_leave_no_tasks_behind() -> None:
    """Under constant load the batcher never ends, and a task for each request would stay in the queue."""
    policy = Batched()

    class Counting(ThreadPoolExecutor):
        submitted = 0

        def submit(self, *arguments, **options):  # type: ignore[no-untyped-def, override]
            self.submitted += 1
            return super().submit(*arguments, **options)

    computing = Counting(1)

    async def script(batcher: DynamicBatcher) -> None:
        sessions = await begun(batcher, policy, [1] * 4)
        before = computing.submitted
        replies = [await submitted(batcher, sessions[0], act(1))]
        await asyncio.to_thread(policy.started.wait)
        replies += [await submitted(batcher, each, act(2)) for each in sessions[1:]]
        after = computing.submitted
        policy.free.set()
        await asyncio.gather(*replies)
        assert after <= before + 1  # the task that answered `begun` may still run
        assert answers(await (await submitted(batcher, sessions[0], act(3)))) == [(1, 3, 2)]

    run(policy, script, executor=computing)


def test_one_client_alone_does_not_wait_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("openvima.serving.server.WINDOW_S", 3600.0)
    policy = Batched()
    with serve_in_thread(policy) as url, RemotePolicy(url) as client, RemotePolicy(url):  # type: ignore[arg-type]
        client.reset([made_up_prompt(4)])
        assert told(client.act([made_up_observation(1)])[0]) == (4, 1, 1)


def test_a_batch_of_one_means_one_request_after_the_other() -> None:
    policy = Batched()
    with serve_in_thread(policy, max_batch=1) as url, RemotePolicy(url) as client:  # type: ignore[arg-type]
        client.reset([made_up_prompt(4)] * 2)
        assert told(client.act([made_up_observation(1), None])[0]) == (4, 1, 1)
    assert policy.batches == []


@pytest.mark.parametrize(
    ("wanted", "shares"),
    [
        ([1, 1, 1], [1, 1, 1]),
        ([64], [16]),
        ([64, 1, 64], [8, 1, 7]),
        ([5, 64, 3, 64], [5, 4, 3, 4]),
        ([1] * 20, [1] * 16 + [0] * 4),
    ],
)
def test_shares_are_fair(wanted: list[int], shares: list[int]) -> None:
    assert fair_shares(wanted, 16) == shares
