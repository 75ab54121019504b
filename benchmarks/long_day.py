"""Hours of everything that runs for hours: a policy server, evaluations, vector environments.

    python benchmarks/long_day.py --hours 2 [--policy NAME] [--clients N] [--seed S] [--out PATH]

`openvima serve` runs in a process of its own. 16 clients come to it, replay a part of an episode, or of
several at once, and leave: with a goodbye, while an answer is computed, or within a message. Besides, one
process evaluates the policy again and again, directly and through the server, and one steps vector
environments, whose workers are killed at random.

Sampled are memory (without that of mapped files, which the system takes back as it likes), open handles,
threads and children of these processes except the clients', and the latency of the server's answers. The
first quarter warms up; memory is flat if its median over the last quarter exceeds that over the second by 5 %
at most. Nothing is lost if every answer is that of the policy in process, to the bit, every evaluation has
the outcomes of the first, and every step of a vector environment the bytes of one without workers. `--out`
writes PATH.json, PATH.md and PATH.png. Exit status 1 if a verdict is bad.
"""

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import openvima
from fuzz_server import served
from long_day_loads import QUANTILES, Plan, evaluate_again, play_clients, step_vectors
from openvima.policies import load_policy
from openvima.serving.server import Session, WaitingRequest
from serving import record_batch
from sim import circumstances

SIZES = (1, 1, 1, 1, 1, 1, 4, 20)  # episodes at once of the plans; the last are computed in several batches
NUM_PLANS = 24
NUM_SAMPLES = 240
MAX_GROWTH = 0.05  # of memory
MORE_HANDLES = 4  # that a process may hold open for a moment: connections that come and go
VECTOR = "vector environments"
COUNTED = {  # by load; the first is what can be lost
    "clients": ("answers", "observations", "visits", "abrupt", "full"),
    "evaluation": ("episodes",),
    VECTOR: ("steps", "killed"),
}
RESOURCES = ("memory_mb", "handles", "threads", "children")


def make_plans(policy: Any, seed: int) -> list[Plan]:  # Any: has sessions
    """Record episodes, and what the policy answers in process, request after request."""
    tasks, plans = openvima.list_tasks(), []
    for number in range(NUM_PLANS):
        size = SIZES[number % len(SIZES)]
        names = [tasks[(number + n) % len(tasks)] for n in range(size)]
        session, plan = Session(policy.new_session(), 64), []
        for request, count in record_batch(names, seed + number):
            calls = session.read(request)
            if isinstance(calls, str):
                raise RuntimeError(calls)
            waiting = WaitingRequest(session, calls, is_joint=False)
            waiting.begin()
            answer = waiting.reply.result()
            if isinstance(answer, str):
                raise RuntimeError(answer)
            plan.append((request, count, answer))
        plans.append(plan)
    return plans


def sample(pid: int) -> dict[str, float] | None:
    """Resources of a process; None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        status = dict(
            line.split(":", 1) for line in (folder / "status").read_text(encoding="utf-8").splitlines()
        )
        children = [(task / "children").read_text().split() for task in (folder / "task").iterdir()]
        return {
            "memory_mb": sum(int(status[name].split()[0]) for name in ("RssAnon", "RssShmem")) / 1024,
            "handles": len(os.listdir(folder / "fd")),
            "threads": int(status["Threads"]),
            "children": sum(map(len, children)),
        }
    except (OSError, KeyError):  # a zombie has no memory
        return None


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:  # Any: plain values
    """Run all loads for some hours.

    Args:
        options: Those of the command.
        folder: For logs and results of the loads.

    Returns:
        Samples of each process, records of each load, and what ended before its time.
    """
    plans = make_plans(load_policy(options.policy), options.seed)
    interval_s = max(1.0, 3600 * options.hours / NUM_SAMPLES)
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    logs = {name: folder / f"{name}.jsonl" for name in ("clients", "evaluation", VECTOR)}
    with served(options.policy, "--max-connections", str(2 * options.clients)) as (url, server):
        own = (interval_s, options.seed, logs["clients"], stop)
        loads = {
            "clients": context.Process(target=play_clients, args=(url, plans, options.clients, *own)),
            "evaluation": context.Process(
                target=evaluate_again, args=(url, options.policy, folder, logs["evaluation"], stop)
            ),
            VECTOR: context.Process(target=step_vectors, args=(options.seed, logs[VECTOR], stop)),
        }
        for process in loads.values():
            process.start()
        pids = {"server": server.pid} | {name: loads[name].pid or 0 for name in ("evaluation", VECTOR)}
        started_s = time.time()
        samples: dict[str, list[dict[str, float]]] = {name: [] for name in pids}
        while time.time() < started_s + 3600 * options.hours and server.poll() is None:
            time.sleep(interval_s)
            for name, pid in pids.items():
                if (found := sample(pid)) is not None:
                    samples[name].append({"at_s": time.time() - started_s, **found})
        stop.set()
        for process in loads.values():
            process.join(600)
        ended = [f"{name}: exit code {each.exitcode}" for name, each in loads.items() if each.exitcode != 0]
        ended += [f"server: exit code {server.poll()}"] if server.poll() is not None else []
        for process in loads.values():
            process.kill()
    records = {
        name: [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        if path.exists()
        else []
        for name, path in logs.items()
    }
    for each in records.values():
        for fields in each:
            fields["at_s"] -= started_s
    return {"samples": samples, "records": records, "ended": ended}


def quarter(values: Sequence[dict[str, Any]], number: int, name: str) -> list[float]:  # Any: plain values
    """Return a field of the records of a quarter of the time, from 0."""
    if not values:
        return []
    end_s = values[-1]["at_s"]
    return [
        each[name]
        for each in values
        if each[name] is not None and number * end_s / 4 < each["at_s"] <= (number + 1) * end_s / 4
    ]


def memory_mb(samples: Sequence[dict[str, float]]) -> tuple[float, float]:
    """Return the medians of memory over the second and the last quarter; NaN without samples."""
    second, last = (quarter(samples, number, "memory_mb") or [float("nan")] for number in (1, 3))
    return statistics.median(second), statistics.median(last)


def verdicts(result: dict[str, Any]) -> list[dict[str, Any]]:  # Any: plain values
    """Say of each process and each load whether it is as it must be."""
    lines = []
    for name, samples in result["samples"].items():
        before_mb, after_mb = memory_mb(samples)
        growth = after_mb / before_mb - 1
        good, found = growth <= MAX_GROWTH, [f"memory {100 * growth:+.1f} %"]
        for resource in RESOURCES[1:]:
            before, after = (quarter(samples, number, resource) for number in (1, 3))
            more = max(after, default=0) - max(before, default=0)
            good, found = good and more <= MORE_HANDLES, [*found, f"{resource} {more:+.0f}"]
        lines.append(verdict(f"{name}: nothing grows", good, ", ".join(found)))
    for name, records in result["records"].items():
        lost = [text for each in records for text in each["lost"]]
        counted = COUNTED[name][0]
        done = sum(each[counted] for each in records)
        good = not lost and done > 0
        found = f"{len(lost)} of {done:,} {counted}" + "".join(f"; {text}" for text in lost[:1])
        lines.append(verdict(f"{name}: nothing is lost or wrong", good, found))
    lines.append(verdict("all ran to the end", not result["ended"], "; ".join(result["ended"]) or "yes"))
    return lines


def performance(result: dict[str, Any]) -> list[dict[str, Any]]:  # Any: plain values
    """Return the figure for docs/performance.md."""
    before_mb, after_mb = memory_mb(result["samples"]["server"])
    figure = {
        "what": "policy server kept busy for hours, memory, second quarter to last",
        "value": f"{before_mb:,.0f} to {after_mb:,.0f}",
        "unit": "MB",
    }
    return [figure | {name: result[name] for name in ("command", "commit")}]


def verdict(what: str, good: bool, found: str) -> dict[str, Any]:  # Any: plain values
    """Make a line of the verdicts."""
    return {"what": what, "good": bool(good), "found": found}


def totals(records: dict[str, list[dict[str, Any]]]) -> dict[str, dict[str, float]]:  # Any: plain values
    """Sum up what each load did."""
    return {
        load: {"records": len(records[load])}
        | {name: sum(each[name] for each in records[load]) for name in counted}
        for load, counted in COUNTED.items()
    }


def draw(result: dict[str, Any], path: Path) -> None:  # Any: plain values
    """Draw resources of the processes and latency of the answers over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6.5), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True).flatten()
    for axes, resource, label in zip(
        panels, RESOURCES[:3], ("memory, MB", "open handles", "threads"), strict=False
    ):
        for name, samples in result["samples"].items():
            hours = [each["at_s"] / 3600 for each in samples]
            axes.plot(hours, [each[resource] for each in samples], label=name, linewidth=1)
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
    panels[0].legend(fontsize="small")
    spans = [each for each in result["records"]["clients"] if each["p50_ms"] is not None]
    for quantile in QUANTILES:
        waits = [each[f"p{quantile}_ms"] for each in spans]
        panels[3].plot([each["at_s"] / 3600 for each in spans], waits, label=f"p{quantile}", linewidth=1)
    panels[3].set_ylabel("an answer takes, ms")
    panels[3].set_ylim(bottom=0)
    panels[3].legend(fontsize="small")
    for axes in panels[2:]:
        axes.set_xlabel("hours")
    figure.savefig(path, dpi=120, metadata={"Software": None})


def report(result: dict[str, Any], figure: str) -> str:  # Any: plain values
    """Return the results as Markdown."""
    lines = [
        "# A long day",
        "",
        f"`{result['command']}`, commit `{result['commit']}`, {result['machine']}, Python "
        f"{result['python']}, load {result['load_average']} at the start.",
        "",
        "| | verdict | found |",
        "|---|---|---|",
        *(
            f"| {each['what']} | {'yes' if each['good'] else '**no**'} | {each['found']} |"
            for each in result["verdicts"]
        ),
        "",
        "The first quarter warms up. Memory, without that of mapped files: median of the last quarter over "
        "that of the second. Handles, threads, children: largest number in the last quarter over that in the "
        "second.",
        "",
        "| process | memory MB, second quarter | last | handles | threads | children |",
        "|---|---|---|---|---|---|",
    ]
    for name, samples in result["samples"].items():
        memory = [f"{median_mb:,.0f}" for median_mb in memory_mb(samples)]
        most = [f"{max((each[r] for each in samples), default=0):.0f}" for r in RESOURCES[1:]]
        lines.append(f"| {name} | {' | '.join([*memory, *most])} |")
    lines += ["", "| latency of an answer | p50 ms | p95 ms | p99 ms |", "|---|---|---|---|"]
    for number, name in enumerate(("first quarter", "second", "third", "last")):
        spans = [quarter(result["records"]["clients"], number, f"p{q}_ms") for q in QUANTILES]
        lines.append(f"| {name} | {' | '.join(f'{statistics.median(each or [0]):.0f}' for each in spans)} |")
    clients, evaluation, vector = (result["totals"][name] for name in COUNTED)
    lines += [
        "",
        f"- Clients: {clients['visits']:,} visits, {clients['abrupt']:,} of them ended without a goodbye, "
        f"{clients['full']:,} found the server full; {clients['answers']:,} answers, "
        f"{clients['observations']:,} observations",
        f"- Evaluation: {evaluation['records']:,} rounds, {evaluation['episodes']:,} episodes",
        f"- Vector environments: {vector['records']:,} rounds, {vector['steps']:,} steps, "
        f"{vector['killed']:,} workers killed",
        "",
        f"![Memory, open handles, threads and latency over time]({figure})",
    ]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run, print the report, and write it, its data and a figure if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--policy", default="openvima-small")
    parser.add_argument("--clients", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write PATH.json, PATH.md and PATH.png")
    options = parser.parse_args()
    about = circumstances()
    with tempfile.TemporaryDirectory() as folder:
        result = run(options, Path(folder))
    command = f"python benchmarks/long_day.py --hours {options.hours:g} --policy {options.policy}"
    result = {
        "command": command,
        **about,
        "verdicts": verdicts(result),
        "totals": totals(result["records"]),
        **result,
    }
    result["performance"] = performance(result)
    name = options.out.name if options.out else "long_day"
    text = report(result, f"{name}.png")
    print(text)
    if options.out:
        file = options.out.with_name(f"{name}.json")
        file.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        options.out.with_name(f"{name}.md").write_text(text, encoding="utf-8")
        draw(result, options.out.with_name(f"{name}.png"))
    return 0 if all(each["good"] for each in result["verdicts"]) else 1


if __name__ == "__main__":
    sys.exit(main())
