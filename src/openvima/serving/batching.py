"""Dynamic batching: the requests of all clients are computed in one thread, several in one batch."""

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from openvima.serving.session import Calls, PolicyCall, Session

if TYPE_CHECKING:
    from openvima.policies.joint_inference import JointCall

# Of waiting for the other clients, which are those that asked within the last second. A client that was just
# answered needs a few ms for its next request, and a batch of 16 takes ten times the window.
WINDOW_S = 0.01
ACTIVE_S = 1.0


class DynamicBatcher:
    """Answers the requests of sessions, in order of arrival.

    While one batch is computed, the requests for the next one arrive. It takes the same number of episodes of
    each client, as far as they have so many, so a client with many episodes is answered in several batches
    and the others wait for one of them at most.

    Policies without `joint_call`, and those for which it returns None, are called once for each request.

    Args:
        readers: Threads that read and check requests.
        computing: The one thread that policies are called in.
        max_batch: Episodes of several requests that are computed at once; with 1 each request is computed by
            itself.
    """

    def __init__(self, readers: Executor, computing: Executor, max_batch: int) -> None:
        self._readers, self._computing = readers, computing
        self._max_batch = max_batch
        self._changed = threading.Condition()
        self._last_asked_s: WeakKeyDictionary[Session, float] = WeakKeyDictionary()
        self._arrived: list[WaitingRequest] = []
        self._is_running = False  # or about to: `_run` is submitted once, however many requests wait
        self._waiting: list[WaitingRequest] = []  # those that have waited longest come first

    async def submit(self, session: Session, data: bytes | str) -> Awaitable[bytes | str] | str:
        """Read a message.

        Returns:
            The answer, which is to be awaited, or a refusal. The message is no longer needed.
        """
        loop = asyncio.get_running_loop()
        with self._changed:
            self._last_asked_s[session] = time.monotonic()
        calls = await loop.run_in_executor(self._readers, session.read, data)
        if isinstance(calls, str):
            return calls
        request = WaitingRequest(session, calls, is_joint=self._max_batch > 1)
        with self._changed:
            self._arrived.append(request)
            self._changed.notify()
            was_running, self._is_running = self._is_running, True
        if not was_running:
            self._computing.submit(self._run)
        return asyncio.wrap_future(request.reply)

    def _run(self) -> None:
        """Compute batches until no request waits."""
        try:
            while self._is_needed():
                self._gather(self._compute_batch() if self._waiting else [])
        except BaseException:  # the next request runs it again
            with self._changed:
                self._is_running = False
            raise

    def _is_needed(self) -> bool:
        """Whether a request waits; if not, the next one will run the batcher again."""
        with self._changed:
            self._is_running = bool(self._waiting or self._arrived)
            return self._is_running

    def _gather(self, unfinished: "Sequence[WaitingRequest]") -> None:
        """Take the requests that have arrived, and some behind them; wait a little for other clients."""
        self._take_arrived()
        if count := len(self._waiting) + len(unfinished):
            since_s = time.monotonic() - ACTIVE_S
            with self._changed:
                num_active = sum(asked_s > since_s for asked_s in self._last_asked_s.values())
                full = min(num_active, self._max_batch)
                self._changed.wait_for(lambda: count + len(self._arrived) >= full, WINDOW_S)
            self._take_arrived()
        self._waiting += unfinished

    def _take_arrived(self) -> None:
        with self._changed:
            arrived, self._arrived = self._arrived, []
        self._waiting += [each for each in arrived if each.begin()]

    def _compute_batch(self) -> "list[WaitingRequest]":
        """Compute rows of the request that has waited longest, and of those that join it.

        Returns:
            Those of them that are not finished; they no longer wait.
        """
        calls = [(each, each.joint) for each in self._waiting if each.joint]
        first = calls[0][1]
        calls = [(each, call) for each, call in calls if call.joins(first)]
        shares = fair_shares([call.num_left for _, call in calls], self._max_batch)
        pieces = [(*call, share) for call, share in zip(calls, shares, strict=True) if share]
        _compute(pieces)
        served = [each for each, _, _ in pieces]
        self._waiting = [each for each in self._waiting if each not in served]
        return [each for each in served if each.joint]


class WaitingRequest:
    """A request that waits for its answer.

    Attributes:
        reply: The answer, once it is there.
        joint: A call of the policy that is to be computed with those of others; None if there is none.
    """

    def __init__(self, session: Session, calls: Calls, *, is_joint: bool) -> None:
        self._policy: Any = session.policy  # Any: `joint_call` is optional
        self._calls = session.reply(calls)
        self._is_joint = is_joint and hasattr(session.policy, "joint_call")
        self.reply: Future[bytes | str] = Future()
        self.joint: JointCall | None = None

    def begin(self) -> bool:
        """Make the calls before the first joint one; whether there is one."""
        if self.reply.set_running_or_notify_cancel():  # else the server stops
            self._resume(lambda: None)
        return self.joint is not None

    def go_on(self) -> None:
        """Go on with the answer if the joint call is computed."""
        joint = self.joint
        if joint is not None and not joint.num_left:
            self.joint = None
            self._resume(joint.finish)

    def fail(self, error: Exception) -> None:
        """Go on with the error of the joint call."""
        self.joint = None
        self._resume(partial(_raise, error))

    def _resume(self, result: Callable[[], Any]) -> None:  # Any: what a policy returns
        """Send what a call returned, or raised, and make those that follow, up to a joint one."""
        while True:
            try:
                given = result()
            except Exception as error:
                resume = partial(self._calls.throw, error)
            else:
                if self.joint is not None:
                    return
                resume = partial(self._calls.send, given)
            try:
                call = resume()
            except StopIteration as end:
                self.reply.set_result(end.value)
                return
            result = partial(self._made, call)

    def _made(self, call: PolicyCall) -> Any:  # Any: what a policy returns
        """Make a call, unless it is a joint one."""
        joint: JointCall | None = None
        if self._is_joint:
            joint = self._policy.joint_call(call.kind, call.inputs)
        if joint is None:
            return getattr(self._policy, call.kind)(call.inputs)
        if not joint.num_left:
            return joint.finish()
        self.joint = joint
        return None


def fair_shares(wanted: Sequence[int], total: int) -> list[int]:
    """Divide a number of rows in turns, one at a time, so that whoever wants few gets them.

    Example:
        >>> fair_shares([1, 64, 1, 5], total=16)
        [1, 9, 1, 5]
    """
    shares = [0] * len(wanted)
    total = min(total, sum(wanted))
    while total:
        for index, most in enumerate(wanted):
            if shares[index] < most and total:
                shares[index] += 1
                total -= 1
    return shares


def _compute(pieces: "Sequence[tuple[WaitingRequest, JointCall, int]]") -> None:
    """Compute rows of calls in one batch; if that fails each by itself, for errors of its own."""
    try:
        pieces[0][1].compute_together([(call, count) for _, call, count in pieces])
    except Exception as error:
        if len(pieces) == 1:
            pieces[0][0].fail(error)
        else:
            for piece in pieces:
                _compute([piece])
        return
    for request, _, _ in pieces:
        request.go_on()


def _raise(error: Exception) -> None:
    raise error
