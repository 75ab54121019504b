"""What `long_day.py` keeps busy: clients of a policy server, evaluations, vector environments.

Each function runs in a process of its own until an event stops it, and appends one JSON record a line to a
file: what happened in a span of time, and what was lost in it. Nothing may be.
"""

import hashlib
import json
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

import openvima
from openvima.env import stack_actions
from openvima.errors import WorkerError
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.results import Results
from vector import record as record_actions

Plan = Sequence[tuple[bytes, int, bytes]]  # requests, their numbers of observations, the right answers
QUANTILES = (50, 95, 99)
QUIET = logging.getLogger("long_day_loads.transport")  # it would tell of every client that vanishes
QUIET.setLevel(logging.CRITICAL + 1)
FULL = "this server has its"  # a place is free again once the server has noticed who left
EVALUATED = ("visual_manipulation", "rotate", "sweep_without_exceeding")
STEPPED = ("visual_manipulation", "rearrange", "rotate", "sweep_without_exceeding")
NUM_ENVS, NUM_STEPS, NUM_WORKERS = 8, 16, 2


def write(path: Path, **fields: Any) -> None:  # Any: plain values
    """Append a record to a file."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"at_s": time.time(), **fields}) + "\n")


class Crowd:
    """Clients that come, play a while and go, politely or not.

    Args:
        url: The server.
        plans: What they play.
        seed: Of what each does.
    """

    def __init__(self, url: str, plans: Sequence[Plan], seed: int) -> None:
        self._url, self._plans, self._seed = url, plans, seed
        self._lock = threading.Lock()
        self.stop = threading.Event()
        self._empty()

    def _empty(self) -> None:
        self._waits_ms: list[float] = []
        names = ("answers", "observations", "visits", "abrupt", "full")
        self._counts: dict[str, int] = dict.fromkeys(names, 0)
        self._lost: list[str] = []

    def span(self) -> dict[str, Any]:  # Any: plain values
        """Return what happened since the last call."""
        with self._lock:
            waits, counts, lost = self._waits_ms, self._counts, self._lost
            self._empty()
        quantiles = np.percentile(waits, QUANTILES).tolist() if waits else [None] * len(QUANTILES)
        named = {f"p{q}_ms": value for q, value in zip(QUANTILES, quantiles, strict=True)}
        return {**counts, **named, "lost": lost}

    def run(self, number: int) -> None:
        """Visit the server again and again."""
        random = Random(f"{self._seed} {number}")
        while not self.stop.is_set():
            plan = random.choice(self._plans)
            try:
                self._visit(plan, random)
            except Exception as error:  # whatever it is, an answer was lost
                self._note(lost=f"client {number}: {type(error).__name__}: {error}")

    def _visit(self, plan: Plan, random: Random) -> None:
        options = {"compression": None, "proxy": None, "ping_interval": None, "logger": QUIET}
        with connect(self._url, open_timeout=60, close_timeout=0.5, **options) as connection:
            if isinstance(first := connection.recv(timeout=60), str):
                if not first.startswith(FULL):
                    raise RuntimeError(first)
                self._note(full=1)
                time.sleep(0.1)
                return
            length = random.choice((len(plan), random.randint(1, len(plan))))
            for request, count, right in plan[:length]:
                began = time.perf_counter()
                connection.send(request)
                answer = connection.recv(timeout=600)
                self._note(
                    answers=1,
                    observations=count,
                    wait_ms=1000 * (time.perf_counter() - began) if count == 1 else None,
                    lost="" if answer == right else f"a wrong answer: {answer!r:.300}, not {right!r:.300}",
                )
                if self.stop.is_set():
                    return
            self._leave(connection, plan[0][0], random)
            self._note(visits=1)

    def _leave(self, connection: ClientConnection, reset: bytes, random: Random) -> None:
        """Say goodbye, or vanish: while an answer is computed, or within a message."""
        way = random.choice(("goodbye", "goodbye", "unanswered", "within"))
        if way == "goodbye":
            return
        self._note(abrupt=1)
        with suppress(OSError, ConnectionClosed):
            frame = Frame(Opcode.BINARY, reset).serialize(mask=True)
            connection.socket.sendall(frame if way == "unanswered" else frame[: len(frame) // 2])
            connection.socket.shutdown(socket.SHUT_RDWR)

    def _note(self, *, wait_ms: float | None = None, lost: str = "", **counts: int) -> None:
        with self._lock:
            for name, count in counts.items():
                self._counts[name] += count
            self._waits_ms += [] if wait_ms is None else [wait_ms]
            self._lost += [lost] if lost else []


def play_clients(
    url: str, plans: Sequence[Plan], num_clients: int, interval_s: float, seed: int, path: Path, stop: Any
) -> None:
    """Let clients play until `stop`, a multiprocessing event, is set; a record for each interval."""
    crowd = Crowd(url, plans, seed)
    threads = [threading.Thread(target=crowd.run, args=(number,)) for number in range(num_clients)]
    for thread in threads:
        thread.start()
    while not stop.wait(interval_s):
        write(path, **crowd.span())
    crowd.stop.set()
    for thread in threads:
        thread.join()
    write(path, **crowd.span())


def evaluate_again(url: str, policy: str, folder: Path, path: Path, stop: Any) -> None:
    """Evaluate a policy here and behind the server, again and again; a record for each round.

    All outcomes must be those of the first round, and those of the server those of here.
    """
    first, number = None, 0
    while not stop.is_set():
        began = time.monotonic()
        config = EvaluationConfig(
            policies=(f"here={policy}", f"served={url}"),
            tasks=EVALUATED,
            levels=("L1",),
            episodes=8,
            batch=4,
            workers=1 + number % 2,
            out=folder / "evaluation",
            force=True,
        )
        rows = Results.read(evaluate(config)).rows
        outcomes = {
            name: [replace(row, policy="") for row in rows if row.policy == name]
            for name in ("here", "served")
        }
        first = first or outcomes["here"]
        lost = [f"round {number}: other outcomes {name}" for name, own in outcomes.items() if own != first]
        write(path, episodes=16 * len(EVALUATED), seconds=time.monotonic() - began, lost=lost)
        number += 1


def step_vectors(seed: int, path: Path, stop: Any) -> None:
    """Step vector environments with workers, some of which are killed; a record for each round.

    Every step must give the bytes of environments without workers, and a kill a `WorkerError`.
    """
    random = Random(seed)
    plans = [record_actions(STEPPED[i % len(STEPPED)], i, NUM_ENVS, NUM_STEPS) for i in range(NUM_ENVS)]
    actions = [stack_actions(each) for each in zip(*plans, strict=True)]
    right = _digests(actions, 0, lambda step, envs: None)[0]
    while not stop.is_set():
        began = time.monotonic()
        victim_step = random.choice((None, random.randrange(NUM_STEPS)))

        def kill(step: int, envs: Any, victim_step: int | None = victim_step) -> None:
            if step == victim_step:
                os.kill(random.choice(envs.processes).pid, signal.SIGKILL)

        digests, error = _digests(actions, NUM_WORKERS, kill)
        lost = []
        if digests != right[: len(digests)]:
            lost.append("steps differ from those without workers")
        if isinstance(error, WorkerError) != (victim_step is not None) or (error and victim_step is None):
            lost.append(f"killed at step {victim_step}: {type(error).__name__}: {error}")
        lost += [f"left behind: {name}" for name in children() if "resource_tracker" not in name]
        write(
            path,
            steps=len(digests) * NUM_ENVS,
            killed=int(victim_step is not None),
            seconds=time.monotonic() - began,
            lost=lost,
        )


def children() -> list[str]:
    """Return the command lines of the processes that this thread has started and that still run."""
    names = []
    for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        with suppress(OSError):  # it ends just now
            names.append(Path(f"/proc/{child}/cmdline").read_text().replace("\0", " "))
    return names


def _digests(
    actions: Sequence[Any], num_workers: int, before_step: Callable[[int, Any], None]
) -> tuple[list[str], Exception | None]:
    """Step environments; the digest of each step, and what ended them before the last."""
    num_seeds = NUM_ENVS * (len(actions) + 1)
    envs = openvima.make_vec(list(STEPPED), NUM_ENVS, num_workers=num_workers, seeds=range(num_seeds))
    digests: list[str] = []
    try:
        envs.reset()
        for step, batch in enumerate(actions):
            before_step(step, envs)
            observations, rewards, terminated, truncated, _ = envs.step(batch)
            digest = hashlib.blake2b(digest_size=8)
            for part in ("rgb", "segm"):
                for view in sorted(observations[part]):
                    digest.update(observations[part][view].tobytes())
            for array in (rewards, terminated, truncated):
                digest.update(array.tobytes())
            digests.append(digest.hexdigest())
    except Exception as error:  # the caller says which may be
        return digests, error
    finally:
        envs.close()
    return digests, None
