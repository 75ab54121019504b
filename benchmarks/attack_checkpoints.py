"""Whether a hostile or damaged checkpoint can harm whoever loads it.

    python benchmarks/attack_checkpoints.py [--rounds N] [--seed S] [--json FILE]

Linux only. Each kind of attack runs in its own process. Counted are attacks that executed anything (started a
process, wrote or deleted a file, opened a connection), took longer than 10 s, raised the peak of memory by
more than 512 MB, killed the process, ended with another error than one line of the package, or gave weights
that are not finite. A damaged file (bits, bytes or its end changed) must be refused or give the very weights
it had; so must the first file of each kind, which is whole. A forged one, whose checksums were made anew, may
be loaded with any finite weights. Exit status 1 if anything was counted.
"""

import argparse
import io
import json
import multiprocessing
import os
import platform
import random
import signal
import struct
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
import yaml
from safetensors.torch import save_file

from openvima import __version__
from openvima.errors import OpenVimaError
from openvima.policies.architectures import vima
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint
from openvima.policies.naming import CONFIG_FILE, WEIGHTS_FILE
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig, TextEncoderConfig
from openvima.policies.published import load_published
from openvima.policies.published_names import to_published
from openvima.policies.sizes import Size

CLEAR_REFS = Path("/proc/self/clear_refs")
LIMIT_S = 10
LIMIT_MB = 512
MAX_MESSAGE = 2000  # characters
# What code that a file smuggles in would do.
_EXECUTED = (
    *("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pty.spawn"),
    *("os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.chmod", "shutil.rmtree", "socket.connect"),
    *("ctypes.dlopen", "webbrowser.open"),
)
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT

Weights = dict[str, torch.Tensor]
# What loads a file, and what it held before; None if it may load as anything finite.
Attack = tuple[Callable[[], Any], Weights | None]


class Hung(BaseException):
    """Raised when an attack takes too long."""


@dataclass(slots=True)
class Findings:
    """What came of one kind of attack."""

    attacks: int = 0
    refused: int = 0
    loaded: int = 0
    executed: int = 0
    hung: int = 0
    over_memory: int = 0
    crashed: int = 0
    raw_errors: int = 0
    silently_wrong: int = 0
    slowest_s: float = 0.0
    peak_mb: float = 0.0  # above that before the first attack
    problems: list[str] = field(default_factory=list)

    @property
    def num_harmful(self) -> int:
        """Number of attacks that did harm."""
        harmful = (self.executed, self.hung, self.over_memory, self.crashed)
        return sum(harmful) + self.raw_errors + self.silently_wrong


def small_network() -> Any:  # Any: a network of the package
    """Build VIMA as published, with few and narrow layers."""
    text = TextEncoderConfig(width=16, num_layers=1, num_heads=2, head_width=8, hidden_width=8)
    prompt = PromptEncoderConfig(text, 8, 40, tokenizer="t5", train_words=False, trained_layers=1)
    size = Size(16, 1, 2, prompt, image_width=48, image_layers=1, hidden_width=8, action_width=8)
    return build_network(vima(size), seed=0)


def published_bytes(network: Any, *, limit: int | None = None) -> bytes:  # Any: a network of the package
    """Return the network, or its first weights, as a published file."""
    cfg = {"embed_dim": 16, "xf_n_layers": 1, "sattn_n_heads": 2, "xattn_n_heads": 2}
    weights = {f"policy.{name}": tensor.clone() for name, tensor in [*to_published(network).items()][:limit]}
    stream = io.BytesIO()
    torch.save({"state_dict": weights, "cfg": cfg}, stream)
    return stream.getvalue()


def mutated(content: bytes, rng: random.Random, words: tuple[bytes, ...] = ()) -> bytes:
    """Change, insert, delete or repeat bytes of a file at up to four places."""
    result = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(result) + 1)
        end = min(len(result), at + rng.choice((1, 1, 2, 8, 64)))
        kind = rng.randrange(5 if words else 4)
        if kind == 0 and at < len(result):
            result[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            result[at:at] = rng.randbytes(rng.randint(1, 8))
        elif kind == 2:
            del result[at:end]
        elif kind == 3:
            result[at:at] = result[at:end] * rng.choice((1, 2, 100))
        elif words:
            result[at:end] = rng.choice(words)
    return bytes(result) or b"\0"


def entries_of(content: bytes) -> dict[str, bytes]:
    """Return the entries of an archive by name."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(entries: dict[str, bytes]) -> bytes:
    """Write an archive with correct checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return stream.getvalue()


PICKLE_WORDS = (
    b"cos\nsystem\n",
    b"cposix\nsystem\nX\x12\x00\x00\x00touch executed.txt\x85R",
    b"cbuiltins\nexec\nX\x19\x00\x00\x00open('executed.txt', 'w')\x85R",
    b"cbuiltins\neval\n",
    b"cbuiltins\nbytearray\n\x8a\x06\x00\x00\x00\x00\x00\x01\x85R",
    b"csubprocess\nPopen\n",
    b"ctorch.hub\nload\n",
    b"ctorch\nFloatStorage\n\x8a\x05\x00\x00\x00\x00\x10\x85R",
    b"ctorch._utils\n_rebuild_meta_tensor_no_storage\n",
    b"\x85" * 40_000,
    b"q\x01h\x01h\x01\x86" * 30,
    b"r\xff\xff\xff\xff",
    b"\x8a\xff" + b"\x7f" * 255,
    *(b"R", b"b", b"\x81", b"s", b"u", b"0", b"2", b"\x93", b"Q", b"(", b"t", b"e", b"."),
)
YAML_WORDS = (
    *(b"&a [", b"*a", b"<<: ", b"[" * 500, b"{" * 500, b"!!python/object/apply:os.mkdir [executed]"),
    *(b"999999999999", b"-1", b"0", b".nan", b".inf", b"1e999", b"null", b"true", b"[]", b"{}", b"''"),
    *(b"0x" + b"f" * 5000, b"1:1:1:1:1:1", b"? [1]\n: 2\n", b"2026-13-01", b"\x1b[2J", b"\xff", b"\0"),
    *(b"\n", b"  ", b": "),
)


def mutated_pickles(folder: Path, rng: random.Random, rounds: int) -> Iterator[Attack]:
    """Archives with a mutated pickle and correct checksums."""
    file, network = folder / "policy.ckpt", small_network()
    file.write_bytes(published_bytes(network))
    yield lambda: load_published(file), network.state_dict()
    whole, part = (entries_of(published_bytes(network, limit=limit)) for limit in (None, 3))
    for number in range(rounds):
        entries = part if number % 20 else whole  # mutants of a few weights are checked faster
        (name,) = (name for name in entries if name.endswith("data.pkl"))
        file.write_bytes(zipped({**entries, name: mutated(entries[name], rng, PICKLE_WORDS)}))
        yield lambda: load_published(file), None


def damaged_archives(folder: Path, rng: random.Random, rounds: int) -> Iterator[Attack]:
    """Published files with damage anywhere."""
    network = small_network()
    file, content = folder / "policy.ckpt", published_bytes(network)
    file.write_bytes(content)
    yield lambda: load_published(file), network.state_dict()
    for _ in range(rounds // 20):
        cut = content[: rng.randrange(len(content))] if rng.random() < 0.2 else content
        file.write_bytes(cut if cut != content else mutated(content, rng))
        yield lambda: load_published(file), network.state_dict()


def damaged_weights(folder: Path, rng: random.Random, rounds: int) -> Iterator[Attack]:
    """Safetensors files with damage in the header or anywhere."""
    network = small_network()
    save_checkpoint(network, folder / "checkpoint")
    file = folder / "checkpoint" / WEIGHTS_FILE
    yield lambda: load_checkpoint(file.parent), network.state_dict()
    content = file.read_bytes()
    start = 8 + int.from_bytes(content[:8], "little")
    for number in range(rounds // 20):
        if number % 2:
            damaged = mutated(content, rng)
        else:
            words = (b"0", b"99999999999", b'"F64"', b'"F8_E4M3"', b"[" * 90, b"-1", b"[0,0]", b'"query"')
            header = mutated(content[8:start], rng, words)
            damaged = struct.pack("<Q", len(header)) + header + content[start:]
        file.write_bytes(damaged)
        yield lambda: load_checkpoint(file.parent), network.state_dict()


def mutated_configs(folder: Path, rng: random.Random, rounds: int) -> Iterator[Attack]:
    """Configs with mutated text, and with one value replaced."""
    save_checkpoint(small_network(), folder / "checkpoint")
    file = folder / "checkpoint" / CONFIG_FILE
    yield lambda: load_checkpoint(file.parent), small_network().state_dict()
    content = file.read_bytes()
    lines = content.splitlines(keepends=True)
    for number in range(rounds // 20):
        if number % 2:
            file.write_bytes(mutated(content, rng, YAML_WORDS))
        else:
            at = rng.randrange(len(lines))
            line = lines[at].partition(b":")[0] + b": " + rng.choice(YAML_WORDS) + b"\n"
            file.write_bytes(b"".join([*lines[:at], line, *lines[at + 1 :]]))
        yield lambda: load_checkpoint(file.parent), None


def bombs(folder: Path, rng: random.Random, rounds: int) -> Iterator[Attack]:
    """Files that were built to block, to execute, or to take all memory; each once."""
    del rng, rounds
    file, network = folder / "policy.ckpt", small_network()
    content = published_bytes(network)
    entries = entries_of(content)
    file.write_bytes(zipped(entries))
    yield lambda: load_published(file), network.state_dict()
    (name,) = (name for name in entries if name.endswith("data.pkl"))
    for word in PICKLE_WORDS:
        file.write_bytes(zipped({**entries, name: b"\x80\x02" + word + b"."}))
        yield lambda: load_published(file), None
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for entry, value in {**entries, "policy/data/9": bytes(1_000_000_000)}.items():
            archive.writestr(entry, value)
    yield lambda: load_published(file), None
    values = torch.load(io.BytesIO(content), weights_only=True)
    words = "policy.prompt_embedding._embed_layer.weight"
    values["state_dict"][words] = torch.zeros(1).expand(1_000_000_000, 16)
    torch.save(values, file)
    yield lambda: load_published(file), None
    file.unlink()
    os.mkfifo(file)
    yield lambda: load_published(file), None
    file.unlink()
    for device in ("/dev/zero", "/dev/random", "/dev/tty"):
        yield lambda device=device: load_published(device), None
    checkpoint = folder / "checkpoint"
    for target in (CONFIG_FILE, WEIGHTS_FILE):
        for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir):
            save_checkpoint(network, checkpoint)
            (checkpoint / target).unlink()
            make(checkpoint / target)
            yield lambda: load_checkpoint(checkpoint), None
            (checkpoint / target).rmdir() if make is Path.mkdir else (checkpoint / target).unlink()
            (checkpoint / target).touch()
    yield from _large_files(checkpoint, network)


def _large_files(checkpoint: Path, network: Any) -> Iterator[Attack]:  # Any: a network of the package
    save_checkpoint(network, checkpoint)
    config = yaml.safe_load((checkpoint / CONFIG_FILE).read_text())
    laughs = "a0: &a0 [lol]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 60))
    for text in (laughs, "a: " + "[" * 2_000_000, "a: " + "x" * 500_000_000, "- 1\n" * 60_000):
        (checkpoint / CONFIG_FILE).write_text(text)
        yield lambda: load_checkpoint(checkpoint), None
    for value in (10**5, 10**9, 2**62, 10**30):
        for section in ("decoder", "prompt", "images"):
            for size in [key for key, old in config["config"][section].items() if type(old) is int]:
                hostile = {**config["config"], section: {**config["config"][section], size: value}}
                (checkpoint / CONFIG_FILE).write_text(yaml.safe_dump({**config, "config": hostile}))
                yield lambda: load_checkpoint(checkpoint), None
    save_checkpoint(network, checkpoint)
    with (checkpoint / WEIGHTS_FILE).open("r+b") as file:  # a header of half a gigabyte of nested lists
        file.write(struct.pack("<Q", 500_000_000) + b"[" * 500_000_000)
    yield lambda: load_checkpoint(checkpoint), None
    for number in (float("nan"), float("inf"), -float("inf")):
        save_checkpoint(network, checkpoint)
        weights = {name: tensor.clone() for name, tensor in network.state_dict().items()}
        next(iter(weights.values())).flatten()[0] = number
        save_file(weights, checkpoint / WEIGHTS_FILE)
        yield lambda: load_checkpoint(checkpoint), None


ATTACKS = {
    "mutated pickles": mutated_pickles,
    "damaged archives": damaged_archives,
    "damaged weights": damaged_weights,
    "mutated configs": mutated_configs,
    "bombs": bombs,
}


def run(kind: str, rounds: int, seed: int) -> Findings:
    """Run all attacks of one kind in this process."""
    findings, events = Findings(), _watch()
    old = signal.signal(signal.SIGALRM, _stop)
    with tempfile.TemporaryDirectory() as folder:
        for load, before in ATTACKS[kind](Path(folder), random.Random(seed), rounds):
            findings.attacks += 1
            _attack(load, before, findings, events)
            if findings.attacks == 1:
                findings.peak_mb, findings.slowest_s = 0.0, 0.0  # first calls import and compile
                if not findings.loaded:
                    findings.silently_wrong, findings.problems = 1, ["the whole file was refused"]
    signal.signal(signal.SIGALRM, old)
    return findings


def _attack(
    load: Callable[[], Any], before: Weights | None, findings: Findings, events: list[str]
) -> None:  # Any: a network
    CLEAR_REFS.write_text("5")  # the peak of memory is measured anew
    problem, started, peak = "", time.perf_counter(), _peak_mb()
    events.append("armed")
    signal.alarm(LIMIT_S)
    try:
        weights = load().state_dict()
        findings.loaded += 1
        if _is_wrong(weights, before):
            findings.silently_wrong, problem = findings.silently_wrong + 1, "loaded with wrong weights"
    except OpenVimaError as error:
        findings.refused += 1
        text = str(error)
        if "\n" in text or len(text) > MAX_MESSAGE:
            findings.raw_errors, problem = findings.raw_errors + 1, f"message of {len(text)} characters"
    except OSError as error:  # reported in one line by the command line, if it names a path
        findings.refused += 1
        if error.filename is None:
            findings.raw_errors, problem = findings.raw_errors + 1, repr(error)[:200]
    except Hung:
        findings.hung, problem = findings.hung + 1, "hung"
    except Exception as error:
        findings.raw_errors, problem = findings.raw_errors + 1, repr(error)[:200]
    finally:
        signal.alarm(0)
    if executed := events[events.index("armed") + 1 :]:
        findings.executed, problem = findings.executed + 1, f"executed {executed[:3]}"
    events.clear()
    grown = _peak_mb() - peak
    if grown > LIMIT_MB:
        findings.over_memory, problem = findings.over_memory + 1, f"took {grown:.0f} MB"
    findings.peak_mb = max(findings.peak_mb, round(grown, 1))
    findings.slowest_s = max(findings.slowest_s, round(time.perf_counter() - started, 3))
    if problem:
        findings.problems.append(f"attack {findings.attacks}: {problem}")


def _is_wrong(weights: Weights, before: Weights | None) -> bool:
    if not all(bool(tensor.isfinite().all()) for tensor in weights.values()):
        return True
    return before is not None and not (
        weights.keys() == before.keys() and all(torch.equal(weights[name], before[name]) for name in before)
    )


def _watch() -> list[str]:
    """Return a list to which the process adds what it executes, while it holds "armed"."""
    events: list[str] = []

    def hook(event: str, arguments: tuple) -> None:
        if not events:
            return
        writes = event == "open" and isinstance(arguments[2], int) and bool(arguments[2] & _WRITING)
        if writes or event in _EXECUTED:
            events.append(f"{event} {arguments[:1]}"[:200])

    sys.addaudithook(hook)
    return events


def _stop(number: int, frame: object) -> None:
    raise Hung


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def run_apart(kind: str, rounds: int, seed: int) -> Findings:
    """Run all attacks of one kind in a process of their own, which they may kill."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        done = manager.list()
        process = context.Process(target=_report, args=(done, kind, rounds, seed))
        process.start()
        process.join()
        found = list(done)
    return found[0] if found else Findings(crashed=1, problems=[f"exit status {process.exitcode}"])


def _report(done: Any, kind: str, rounds: int, seed: int) -> None:  # Any: a list of another process
    done.append(run(kind, rounds, seed))


def table(results: dict[str, Findings]) -> str:
    """Return the findings as a table in Markdown."""
    names = [name for name in Findings.__slots__ if name != "problems"]
    head = ("kind", *(name.replace("_", " ") for name in names))
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for kind, findings in results.items():
        lines.append(f"| {kind} | {' | '.join(f'{getattr(findings, name):,}' for name in names)} |")
    return "\n".join(lines)


def main() -> int:
    """Run all attacks, print a table and the problems, and write them as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--rounds", type=int, default=60_000, help="mutated pickles; a 20th of the others")
    parser.add_argument("--seed", type=int, default=0, help="of the mutations")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    started = time.perf_counter()
    results = {kind: run_apart(kind, options.rounds, options.seed) for kind in ATTACKS}
    seconds = time.perf_counter() - started
    print(table(results))
    problems = [f"{kind}: {problem}" for kind, found in results.items() for problem in found.problems]
    print("\n".join(problems[:50]), file=sys.stderr, end="\n" if problems else "")
    if options.json:
        content = {
            "command": " ".join(("python", *sys.argv)),
            "versions": {"openvima": __version__, "torch": torch.__version__},
            "python": platform.python_version(),
            "limits": {"seconds": LIMIT_S, "megabytes": LIMIT_MB},
            "seconds": round(seconds, 1),
            "kinds": {kind: asdict(findings) for kind, findings in results.items()},
        }
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 1 if any(findings.num_harmful for findings in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
