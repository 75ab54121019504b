"""How many decisions a second an evaluation of a vision-language model makes, and what one costs.

    python benchmarks/vlm.py [--tasks a,b|all] [--episodes N] [--answer-s S] [--concurrency C] [--json FILE]

A chat server in a process of its own gives the same wrong answer to everything, `--answer-s` after the
request, so that every episode takes as many steps as it may. The evaluation is the real one: prompts, PNG
files, the client, answers on disk, physics. Its processor time, of all threads, does not depend on what else
the machine does; decisions a second do. A first evaluation compiles kernels and fills caches.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from openvima.data.chat_settings import VlmOptions
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.chat import ANSWERS_NAME
from openvima.serving.chat import VlmConfig
from openvima.tasks.registry import tasks_of
from sim import circumstances

# Answers for both tools; it moves what lies in the middle of the table, if anything does.
WORDS = '{"pick": [500, 500], "place": [600, 500], "rotate": 0, "from": [500, 500], "to": [600, 500]}'


def serve(answer_s: float, pipe: Connection) -> None:
    """Serve until the process is ended; sends the port."""
    message = {"role": "assistant", "content": WORDS}
    usage = {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110}
    said = json.dumps({"model": "m", "choices": [{"index": 0, "message": message}], "usage": usage}).encode()
    head = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(said)

    async def client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError, ConnectionError):  # the end of a connection
            while True:
                request = (await reader.readuntil(b"\r\n\r\n")).lower()
                length = request.partition(b"content-length:")[2].partition(b"\r\n")[0]
                if length:
                    await reader.readexactly(int(length))
                    await asyncio.sleep(answer_s)
                writer.write(head + said)

    async def run() -> None:
        server = await asyncio.start_server(client, "127.0.0.1", 0, limit=1 << 24)
        pipe.send(server.sockets[0].getsockname()[1])
        await server.serve_forever()

    asyncio.run(run())


def measure(tasks: Sequence[str], episodes: int, url: str, concurrency: int) -> dict[str, float]:
    """Evaluate once into a new folder; return decisions, and seconds of the clock and of the processor."""
    with tempfile.TemporaryDirectory() as folder:
        config = EvaluationConfig(
            ("vlm:some/model",),
            tasks=tuple(tasks),
            levels=("L1",),
            episodes=episodes,
            out=Path(folder),
            vlm=VlmConfig(url, options=VlmOptions(concurrency=concurrency)),
        )
        clock, cpu = time.perf_counter(), time.process_time()
        evaluate(config)
        clock, cpu = time.perf_counter() - clock, time.process_time() - cpu
        decisions = len((Path(folder) / ANSWERS_NAME).read_text(encoding="utf-8").splitlines())
    return {"decisions": decisions, "seconds": clock, "cpu_s": cpu}


def main() -> None:
    """Parse the command line, measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", default="all")
    parser.add_argument("--episodes", type=int, default=16, help="of each task, at L1")
    parser.add_argument("--answer-s", type=float, default=0.2)
    parser.add_argument("--concurrency", type=int, default=16)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()

    tasks = tasks_of("L1") if args.tasks == "all" else args.tasks.split(",")
    ours, theirs = multiprocessing.Pipe()
    server = multiprocessing.get_context("spawn").Process(
        target=serve, args=(args.answer_s, theirs), daemon=True
    )
    server.start()
    url = f"http://127.0.0.1:{ours.recv()}/v1"
    measure(tasks, 1, url, args.concurrency)
    found = measure(tasks, args.episodes, url, args.concurrency)
    server.terminate()
    found["decisions_per_s"] = found["decisions"] / found["seconds"]
    found["cpu_ms_per_decision"] = 1000 * found["cpu_s"] / found["decisions"]
    print(
        f"{found['decisions']} decisions in {found['seconds']:.1f} s: {found['decisions_per_s']:.1f} a "
        f"second; {found['cpu_ms_per_decision']:.1f} ms of a processor each"
    )
    if args.json:
        record = {**circumstances(), "tasks": tasks, "answer_s": args.answer_s, **found}
        args.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
