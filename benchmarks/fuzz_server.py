"""Attacks on a policy server: fuzzed messages, and well-formed ones that ask for as much as they can.

    python benchmarks/fuzz_server.py [--rounds N] [--policy NAME] [--seed S] [--out PATH]

The server is `openvima serve` in a process of its own. One client sends N fuzzed messages (30,000 by
default), then every attack of `LARGE`. Meanwhile a second client plays one-episode batches of small, proper
requests and times each; a third asks `/healthz`, which the event loop answers. Printed are the server's peak
memory, the longest time that each of the two waited, and crashes. `--out` writes PATH.json and PATH.md.
"""

import argparse
import json
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from openvima.env import TabletopEnv
from openvima.scene import RenderedPrompt
from openvima.serving.protocol import encode_observation, encode_prompt, pack
from sim import circumstances

VIEWS = ("front", "top")
KEYS = (
    "type",
    "prompts",
    "observations",
    "text",
    "images",
    "rgb",
    "ee",
    "top",
    b"data",
    "prompt",
    "protocol",
)
PLAIN = (None, True, -1, 2**64 - 1, 1e300, float("nan"), "text", b"bytes", "", [], {})
MB = 2**20


class Fuzzer:
    """Makes malformed messages.

    Args:
        good: Proper messages, to damage.
        random: Source of randomness.
    """

    def __init__(self, good: Sequence[bytes], random: Random) -> None:
        self._good = good
        self._random = random

    def message(self) -> bytes | str:
        """Return one of the ways in which a message can be wrong."""
        random = self._random
        ways = (
            lambda: random.randbytes(random.randrange(300)),
            self._cut,
            self._garbled,
            lambda: _packed(["type", self._junk()]),
            lambda: _packed(
                {"type": random.choice(["reset", "act", "", None, 3, "x" * 9999]), "rows": self._junk()}
            ),
            lambda: _packed({"type": "reset", "prompts": [self._junk()]}),
            lambda: _packed({"type": "act", "observations": [self._junk()] * 3}),  # and out of order
            lambda: _packed({"prompt": self._junk(), "rgb": self._array(), "ee": self._junk(1)}),
            lambda: bytes([random.choice(b"\x91\x81\xdc\xdd")]) * random.randrange(1, 5000),
            lambda: (
                random.choice([b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9"]) + b"\xff" * random.randrange(9)
            ),
            lambda: "text " * random.randrange(9),
        )
        return random.choice(ways)()

    def _cut(self) -> bytes:
        good = self._random.choice(self._good)
        return good[: self._random.randrange(len(good))]

    def _garbled(self) -> bytes:
        bad = bytearray(self._random.choice(self._good))
        for _ in range(self._random.randrange(1, 9)):
            bad[self._random.randrange(min(200, len(bad)))] = self._random.randrange(256)
        return bytes(bad) + b"!"

    def _junk(self, depth: int = 3) -> Any:  # Any: whatever can be packed
        random = self._random
        kind = random.randrange(4) if depth else 0
        if kind == 1:
            return [self._junk(depth - 1) for _ in range(random.randrange(4))]
        if kind == 2:
            return {random.choice(KEYS): self._junk(depth - 1) for _ in range(random.randrange(4))}
        return self._array() if kind == 3 else random.choice(PLAIN)

    def _array(self) -> dict[bytes, Any]:  # Any: right or wrong
        random = self._random
        dtypes = ["|O", "O", "<U9", "|V8", "<c16", "<M8[s]", "|S4", "u1,f8", "<f8", "|u1", "x" * 999, 7, None]
        lengths = [0, 1, -1, 3, 2**31, 2**62, -(2**40), 1.5, "3", True, None]
        return {
            b"__ndarray__": True,
            b"data": random.randbytes(random.randrange(9)),
            b"dtype": random.choice(dtypes),
            b"shape": [random.choice(lengths) for _ in range(random.randrange(12))],
        }


def _packed(message: object) -> bytes:
    packed = msgpack.packb(message)
    assert packed is not None
    return packed


def text_of(size: int) -> list[bytes]:
    """A prompt of known words alone."""
    return [pack({"type": "reset", "prompts": [{"text": "put the " * (size // 8)}]})]


def one_word(size: int) -> list[bytes]:
    """A prompt of one unknown word."""
    return [pack({"type": "reset", "prompts": [{"text": "juggle" * (size // 6)}]})]


def placeholders(count: int) -> list[bytes]:
    """A prompt that names its only image again and again."""
    return [pack({"type": "reset", "prompts": [{"text": "{a}" * count, "images": [image("a", noise(64))]}]})]


def many_images(count: int) -> list[bytes]:
    """A prompt of many images full of objects."""
    names = [f"i{n}" for n in range(count)]
    images = [image(name, noise(64), range(2, 66)) for name in names]
    return [
        pack({"type": "reset", "prompts": [{"text": " ".join(f"{{{n}}}" for n in names), "images": images}]})
    ]


def many_records(count: int) -> list[bytes]:
    """An image whose one object is listed again and again."""
    sent = image("a", noise(64), [2] * count)
    return [pack({"type": "reset", "prompts": [{"text": "{a}", "images": [sent]}]})]


def objects_in_view(count: int, episodes: int) -> list[bytes]:
    """Observations whose pixels belong to so many objects at random, each of which fills the image."""
    seen = {**noise(count), "ee": 0}
    return [
        pack({"type": "reset", "prompts": [{"text": "put the"}] * episodes}),
        pack({"type": "act", "observations": [seen] * episodes}),
    ]


def largest_batch(episodes: int, words: int) -> list[bytes]:
    """As many prompts of as many words as are allowed, or more."""
    return [pack({"type": "reset", "prompts": [{"text": "put " * words}] * episodes})]


def long_history(episodes: int, steps: int) -> list[bytes]:
    """Steps that show many objects in one episode after the other and few in the rest."""
    few, many = ({**noise(count), "ee": 0} for count in (2, 40))
    steps_sent = [
        pack(
            {"type": "act", "observations": [many if e == step % episodes else few for e in range(episodes)]}
        )
        for step in range(steps)
    ]
    return [pack({"type": "reset", "prompts": [{"text": "put the"}] * episodes}), *steps_sent]


def distinct_prompts(count: int) -> list[bytes]:
    """Prompts of the greatest length, no two alike, which fill caches."""
    return [
        pack({"type": "reset", "prompts": [{"text": f"{n // 361} {n % 361} " + "put " * 20 + " " * 4000}]})
        for n in range(count)
    ]


def large_image(side: int) -> list[bytes]:
    """An observation of large images."""
    rgb = {view: np.zeros((3, side, side), np.uint8) for view in VIEWS}
    return [
        pack({"type": "reset", "prompts": [{"text": "put"}]}),
        pack({"type": "act", "observations": [{"rgb": rgb, "ee": 0}]}),
    ]


def values(count: int) -> list[bytes]:
    """Empty maps, which take many times their size."""
    inner = [{}] * 4000
    return [_packed({"type": "reset", "prompts": [inner] * (count // 4000)})]


def noise(count: int) -> dict[str, Any]:  # Any: arrays by view
    """Images of both views whose pixels belong to so many objects at random."""
    rng = np.random.default_rng(0)
    rgb = {view: rng.integers(0, 256, (3, 128, 256), np.uint8) for view in VIEWS}
    first = min(10, 255 - count)  # ids below belong to the arm, those above to nothing
    segm = {view: rng.integers(first, first + count, (128, 256), np.uint8) for view in VIEWS}
    return {"rgb": rgb, "segm": segm}


def image(name: str, views: dict[str, Any], ids: Sequence[int] = (2,)) -> dict[str, Any]:  # Any: of a message
    """An image of a prompt."""
    records = [{"object_id": number, "object": "bowl", "texture": "red"} for number in ids]
    return {"name": name, "kind": "scene", **views, "objects": records}


LARGE: dict[str, Callable[[], list[bytes]]] = {
    "text of 10 kB": lambda: text_of(10_000),
    "text of 277 kB": lambda: text_of(277_000),
    "text of 374 kB": lambda: text_of(374_000),
    "text of 100 MB": lambda: text_of(100_000_000),
    "unknown word of 1 MB": lambda: one_word(1_000_000),
    "1,365 placeholders": lambda: placeholders(1365),
    "480 images": lambda: many_images(480),
    "4,000 records of one object": lambda: many_records(4000),
    "250 objects in view, 64 episodes": lambda: objects_in_view(250, 64),
    "1,000,000 values": lambda: values(990_000),
    "2,000,000 values": lambda: values(2_000_000),
    "images of 3,000 × 3,000": lambda: large_image(3000),
    "64 episodes of 300 words": lambda: largest_batch(64, 300),
    "64 prompts of 250 words": lambda: largest_batch(64, 250),
    "allowed: 64 prompts of 120 words": lambda: largest_batch(64, 120),
    "60 objects in view, 64 episodes": lambda: objects_in_view(60, 64),
    "allowed: 24 objects in view, 64 episodes": lambda: objects_in_view(24, 64),
    "allowed: 64 episodes, objects in turns": lambda: long_history(64, 16),
    "allowed: 500 distinct prompts": lambda: distinct_prompts(500),
}


class Probe:
    """Asks the server for something again and again, and times how long it waits.

    Args:
        ask: Called again and again; raises if the server gives no proper answer.
    """

    def __init__(self, ask: Callable[[], None]) -> None:
        self._ask = ask
        self._stop = threading.Event()
        self._waits_s: list[float] = []
        self.failures: list[str] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def longest_s(self) -> float:
        """Longest wait since the last call, once what is asked now is answered, too."""
        count = len(self._waits_s)
        while len(self._waits_s) == count:
            time.sleep(0.01)
        longest = max(self._waits_s)
        self._waits_s.clear()
        return longest

    def stop(self) -> None:
        """Ask no more."""
        self._stop.set()
        self._thread.join(60)

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            started = time.perf_counter()
            try:
                self._ask()
            except Exception as error:  # whatever it is, the server did not answer
                self.failures.append(f"{type(error).__name__}: {error}")
                self._stop.wait(1)
            self._waits_s.append(time.perf_counter() - started)


def attack(
    url: str, pid: int, *, rounds: int, seed: int, large: Sequence[str], fragments: int = 2_000_000
) -> dict[str, Any]:  # Any: plain values
    """Attack a server that runs.

    Args:
        url: Its address.
        pid: Its process.
        rounds: Fuzzed messages.
        seed: Of the fuzzed messages.
        large: Names of the attacks of `LARGE`.
        fragments: Empty fragments of a message.

    Returns:
        Peak memory in MB, longest waits in seconds, and a row for each attack.
    """
    env = TabletopEnv("rotate", domain="user")
    seen = encode_observation(env.reset(seed=1)[0])
    reset = pack({"type": "reset", "prompts": [encode_prompt(env.prompt)]})
    act = pack({"type": "act", "observations": [seen]})
    small = RenderedPrompt("Rotate.", {})
    tiny = pack({"type": "reset", "prompts": [encode_prompt(small)] * 2})
    fuzzer = Fuzzer([tiny, reset, act], Random(seed))
    before_mb = memory_mb(pid, "VmRSS")
    with connected(url) as playing:

        def play() -> None:
            for request in (reset, act):
                playing.send(request)
                if isinstance(answer := playing.recv(timeout=300), str):
                    raise RuntimeError(answer)

        play()  # the first time code is compiled
        probes = {"play": Probe(play), "health": Probe(lambda: ask_health(url))}
        rows = [row("fuzzed messages", lambda: fuzz(url, fuzzer, rounds), pid, probes)]
        for name in large:
            rows.append(row(name, lambda name=name: send_all(url, LARGE[name]()), pid, probes))
        name = f"{fragments:,} empty fragments"
        rows.append(row(name, lambda: send_fragments(url, fragments), pid, probes))
        for each in probes.values():
            each.stop()
    failures = [failure for each in probes.values() for failure in each.failures]
    hostile = [each for each in rows if not each["attack"].startswith("allowed")]
    return {
        "messages": rounds,
        "failures_of_others": failures,
        "memory_before_mb": before_mb,
        "peak_memory_mb": memory_mb(pid, "VmHWM"),
        "longest_block_refused_s": max(each["others_waited_s"] for each in hostile),
        "longest_block_allowed_s": max(each["others_waited_s"] for each in rows),
        "longest_block_health_s": max(each["health_waited_s"] for each in rows),
        "attacks": rows,
    }


def row(
    name: str, run: Callable[[], Counter[str]], pid: int, probes: dict[str, Probe]
) -> dict[str, Any]:  # Any: of a table
    """Run an attack and record what it cost."""
    started = time.perf_counter()
    answers = run()
    seconds = time.perf_counter() - started
    result = {
        "attack": name,
        "seconds": round(seconds, 2),
        "others_waited_s": round(probes["play"].longest_s(), 2),
        "health_waited_s": round(probes["health"].longest_s(), 2),
        "peak_memory_mb": memory_mb(pid, "VmHWM"),
        "answers": dict(answers.most_common(3)),
    }
    print(json.dumps(result, ensure_ascii=False), file=sys.stderr, flush=True)
    return result


def fuzz(url: str, fuzzer: Fuzzer, rounds: int) -> Counter[str]:
    """Send fuzzed messages; none may be answered, and every refusal must be short and harmless."""
    answers: Counter[str] = Counter()
    with connected(url) as connection:
        for _ in range(rounds):
            connection.send(fuzzer.message())
            answers[kind_of(connection.recv(timeout=300))] += 1
    return answers


def send_all(url: str, messages: Sequence[bytes]) -> Counter[str]:
    """Send messages one after the other and count the answers."""
    answers: Counter[str] = Counter()
    with connected(url) as connection:
        try:
            for message in messages:
                connection.send(message)
                answers[kind_of(connection.recv(timeout=600))] += 1
        except ConnectionClosed as closed:
            answers[f"closed: {closed}"[:120]] += 1
    return answers


def send_fragments(url: str, count: int) -> Counter[str]:
    """Send a message of endless empty fragments."""
    part = Frame(Opcode.CONT, b"", fin=False).serialize(mask=True) * 1000
    with connected(url) as connection:
        try:
            connection.socket.sendall(Frame(Opcode.BINARY, b"x", fin=False).serialize(mask=True))
            for _ in range(count // 1000):
                connection.socket.sendall(part)
            connection.recv(timeout=60)
        except ConnectionClosed as closed:
            return Counter([f"closed: {closed}"[:120]])
        except OSError as error:
            return Counter([f"closed: {type(error).__name__}"])
    return Counter(["answered"])


def kind_of(answer: str | bytes) -> str:
    """Sort an answer: proper, or refused and how."""
    if isinstance(answer, bytes):
        return "answered"
    if not answer.isprintable() or len(answer) > 500 or "Traceback" in answer:
        raise RuntimeError(f"an unfit refusal: {answer!r}")
    return answer[:120] if answer.startswith("PromptError") else answer.partition(":")[0]


@contextmanager
def connected(url: str) -> Iterator[ClientConnection]:
    """Connect and read the first frame."""
    with connect(url, compression=None, proxy=None, ping_interval=None, max_size=None) as connection:
        connection.recv()
        yield connection


def ask_health(url: str) -> None:
    """Ask whether the server lives."""
    client = HTTPConnection(urlsplit(url).netloc, timeout=120)
    try:
        client.request("GET", "/healthz")
        if client.getresponse().status != 200:
            raise RuntimeError("the server is not well")
    finally:
        client.close()


def memory_mb(pid: int, field: str) -> float:
    """Memory of a process: VmRSS now, VmHWM at its peak."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return float("inf")
    # A process that has ended, and for which nobody has waited, holds none.
    return round(next((int(line.split()[1]) for line in lines if line.startswith(field)), 0) / 1024, 1)


@contextmanager
def served(policy: str, *options: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run `openvima serve` with some options in a process of its own; its address, and the process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "openvima", "serve", policy, "--port", str(port), *options]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert server.stdout is not None
        yield server.stdout.readline().strip(), server
    finally:
        server.terminate()
        server.wait(60)


def report(result: dict[str, Any], command: str) -> str:
    """Return the results as Markdown."""
    lines = [
        "# Attacks on a policy server",
        "",
        f"`{command}`, commit `{result['commit']}`, {result['machine']}, Python {result['python']}, load "
        f"{result['load_average']} at the start.",
        "",
        f"{result['messages']:,} fuzzed messages and {len(result['attacks']) - 1} large requests: "
        f"{result['crashes']} crashes, {len(result['failures_of_others'])} failures of other clients.",
        "",
        f"- Memory of the server: {result['memory_before_mb']:,.0f} MB before, at the peak "
        f"{result['peak_memory_mb']:,.0f} MB",
        "- Longest wait of a client that plays meanwhile: beside requests that are refused "
        f"{result['longest_block_refused_s']:.2f} s, beside the largest that are allowed "
        f"{result['longest_block_allowed_s']:.2f} s",
        "- Longest wait of `GET /healthz`, which the event loop answers: "
        f"{result['longest_block_health_s']:.2f} s",
        "",
        "| attack | takes s | others wait s | `/healthz` waits s | peak MB so far | answers |",
        "|---|---|---|---|---|---|",
    ]
    for each in result["attacks"]:
        answers = "; ".join(f"{number:,} × {text}" for text, number in each["answers"].items())
        lines.append(
            f"| {each['attack']} | {each['seconds']:.2f} | {each['others_waited_s']:.2f} | "
            f"{each['health_waited_s']:.2f} | {each['peak_memory_mb']:,.0f} | {answers} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Attack a server and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=30_000, help="fuzzed messages")
    parser.add_argument("--policy", default="openvima-small")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, help="write PATH.json and PATH.md")
    options = parser.parse_args()
    about = circumstances()
    with served(options.policy) as (url, server):
        result = attack(url, server.pid, rounds=options.rounds, seed=options.seed, large=list(LARGE))
        result["crashes"] = int(server.poll() is not None)
    command = f"python benchmarks/fuzz_server.py --rounds {options.rounds} --policy {options.policy}"
    result = {"command": command, **about, **result}
    text = report(result, command)
    print(text)
    if options.out:
        options.out.with_suffix(".json").write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
        options.out.with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
