"""Observations a second of a policy server: 16 clients in joint batches, and one request after the other.

    python benchmarks/serving.py [--policy NAME] [--clients N] [--episodes N] [--rounds N] [--json FILE]

Two `openvima serve` run, one with `--max-batch 1`. Clients replay oracle demonstrations that were recorded
and packed before: a reset, and an observation for each step. The two servers get the same requests in
alternating rounds, after one that warms up, and every answer of one must be that of the other to the bit.

Measured are a single client; all clients with an episode each; and as many of which one has 64 episodes at
once, whose effect on the others is their latency. CPU time of the server's process is less sensitive to what
else the machine does than the rate.
"""

import argparse
import json
import os
import statistics
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import openvima
from fuzz_server import connected, served
from openvima.env import TabletopEnv
from openvima.serving.protocol import encode_observation, encode_prompt, pack
from sim import circumstances

LARGE = 64  # episodes of the client with many
MODES = {"joint": (), "single": ("--max-batch", "1")}
QUANTILES = (50, 95, 99)


@dataclass(slots=True)
class Played:
    """What a client was answered.

    Args:
        answers: All answers, in order.
        waits_s: How long each took, seconds.
        observations: Number of observations sent.
    """

    answers: list[bytes | str] = field(default_factory=list)
    waits_s: list[float] = field(default_factory=list)
    observations: int = 0


def record(tasks: Sequence[str], seed: int, num_episodes: int) -> list[tuple[bytes, int]]:
    """Play episodes with the oracle, one after the other; requests, each with its number of observations."""
    return [
        request
        for number in range(num_episodes)
        for request in record_batch([tasks[(seed + number) % len(tasks)]], 1000 * seed + number)
    ]


def record_batch(tasks: Sequence[str], seed: int) -> list[tuple[bytes, int]]:
    """Play one episode of each task with the oracle, all at once; requests as of `record`."""
    envs = [TabletopEnv(task, domain="user") for task in tasks]
    observations: list[dict[str, Any] | None] = [env.reset(seed=seed)[0] for env in envs]
    requests = [(pack({"type": "reset", "prompts": [encode_prompt(env.prompt) for env in envs]}), 0)]
    while any(observations):
        seen = [encode_observation(observation) for observation in observations]
        count = sum(observation is not None for observation in observations)
        requests.append((pack({"type": "act", "observations": seen}), count))
        for index, (env, observation) in enumerate(zip(envs, observations, strict=True)):
            if observation is not None:
                following, _, terminated, truncated, _ = env.step(env.oracle_decision().action)
                observations[index] = None if terminated or truncated else following
    return requests


def many_episodes(task: str, steps: int) -> list[tuple[bytes, int]]:
    """Return requests of a client with `LARGE` episodes at once, each seen at its start at every step."""
    env = TabletopEnv(task, domain="user")
    prompts, seen = [], []
    for seed in range(LARGE):
        observation, _ = env.reset(seed=seed)
        prompts.append(encode_prompt(env.prompt))
        seen.append(encode_observation(observation))
    act = pack({"type": "act", "observations": seen}), LARGE
    return [(pack({"type": "reset", "prompts": prompts}), 0), *[act] * steps]


def play(url: str, plans: Sequence[Sequence[tuple[bytes, int]]]) -> tuple[list[Played], float]:
    """Let clients send their requests, all at once; what each was answered, and the seconds it took."""
    played = [Played() for _ in plans]
    start = threading.Barrier(len(plans) + 1)

    def run(plan: Sequence[tuple[bytes, int]], own: Played) -> None:
        with connected(url) as connection:
            start.wait()
            for request, count in plan:
                began = time.perf_counter()
                connection.send(request)
                own.answers.append(connection.recv(timeout=600))
                own.waits_s.append(time.perf_counter() - began)
                own.observations += count

    threads = [threading.Thread(target=run, args=each) for each in zip(plans, played, strict=True)]
    for thread in threads:
        thread.start()
    start.wait()
    began = time.perf_counter()
    for thread in threads:
        thread.join()
    return played, time.perf_counter() - began


def cpu_s(pid: int) -> float:
    """CPU time that a process has taken, in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(
    servers: dict[str, tuple[str, int]], plans: Sequence[Sequence[tuple[bytes, int]]], num_rounds: int
) -> dict[str, Any]:  # Any: of a report
    """Let clients play on both servers in turns.

    Raises:
        RuntimeError: A server refuses, or the two give different answers.
    """
    rounds: dict[str, list[tuple[float, float]]] = {mode: [] for mode in servers}
    waits: dict[str, list[float]] = {mode: [] for mode in servers}
    for number in range(num_rounds + 1):
        answers: dict[str, list[bytes | str]] = {}
        for mode, (url, pid) in servers.items():
            before_s = cpu_s(pid)
            played, seconds = play(url, plans)
            count = sum(each.observations for each in played)
            answers[mode] = [answer for each in played for answer in each.answers]
            if number:
                rounds[mode].append((count / seconds, 1000 * (cpu_s(pid) - before_s) / count))
                small = [each for each in played if each.observations < LARGE]
                waits[mode] += [1000 * wait for each in small for wait in each.waits_s]
        refusals = [answer for answer in answers["single"] if isinstance(answer, str)]
        if refusals or answers["joint"] != answers["single"]:
            raise RuntimeError(f"the servers give different answers, or refuse: {refusals[:1]}")
    result: dict[str, Any] = {mode: summary(rounds[mode], waits[mode]) for mode in servers}
    for name, index in (("ratio", 0), ("cpu_ratio", 1)):
        pairs = zip(rounds["joint"], rounds["single"], strict=True)
        ratios = [joint[index] / single[index] for joint, single in pairs]
        result[name] = round(statistics.median(ratios), 3)
        result[f"{name}s"] = [round(ratio, 3) for ratio in ratios]
    return result


def summary(rounds: Sequence[tuple[float, float]], waits_ms: Sequence[float]) -> dict[str, float]:
    """Return the median rate and cost of the rounds, and quantiles of the waits."""
    rates, costs = zip(*rounds, strict=True)
    quantiles = np.percentile(waits_ms, QUANTILES).tolist()
    return {
        "observations_per_s": round(statistics.median(rates), 2),
        "cpu_ms_per_observation": round(statistics.median(costs), 2),
        **{f"wait_p{q}_ms": round(value, 1) for q, value in zip(QUANTILES, quantiles, strict=True)},
    }


def table(cases: dict[str, dict[str, Any]]) -> str:  # Any: see `measure`
    """Return the results as lines of text."""
    lines = [
        f"{'clients':<34}{'requests':>10}{'obs/s':>9}{'CPU ms/obs':>12}"
        + "".join(f"{f'p{q} ms':>9}" for q in QUANTILES)
    ]
    for name, case in cases.items():
        for mode in MODES:
            row = case[mode]
            waits = "".join(f"{row[f'wait_p{q}_ms']:>9.1f}" for q in QUANTILES)
            lines.append(
                f"{name:<34}{mode:>10}{row['observations_per_s']:>9.1f}{row['cpu_ms_per_observation']:>12.2f}"
                + waits
            )
        lines.append(f"{'':<34}{'ratio':>10}{case['ratio']:>9.2f}{case['cpu_ratio']:>12.2f}")
    return "\n".join([*lines, f"Waits are those of clients with one episode, not of the one with {LARGE}."])


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--policy", default="openvima-small")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--episodes", type=int, default=8, help="that each client plays in a round")
    parser.add_argument("--rounds", type=int, default=3, help="after a first that warms up")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    tasks = openvima.list_tasks()
    plans = [record(tasks, number, options.episodes) for number in range(options.clients)]
    large = many_episodes("visual_manipulation", 1 + options.episodes // 4)
    cases = {
        "1 client": plans[:1],
        f"{options.clients} clients": plans,
        f"{options.clients} clients, one with {LARGE}": [*plans[:-1], large],
    }
    with ExitStack() as stack:
        servers = {}
        for mode, arguments in MODES.items():
            url, process = stack.enter_context(served(options.policy, *arguments))
            servers[mode] = url, process.pid
        results = {name: measure(servers, each, options.rounds) for name, each in cases.items()}
    print(table(results))
    if options.json:
        about = circumstances() | {"policy": options.policy, "rounds": options.rounds}
        options.json.write_text(json.dumps(about | {"cases": results}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
