"""How fast the studio answers, and whether its memory stays flat over many episodes.

    PYTHONPATH=tests python benchmarks/studio.py [--episodes N] [--rounds R] [--policy NAME] [--json FILE]

`openvima studio` runs in a process of its own. A client of viser without a picture presses its buttons and
reads what is sent, as a browser does. Reported are: seconds from the command until the first episode is sent
and, where playwright and Chromium are installed, until a page shows it; seconds from pressing *step* until
the arm moves, which include the policy's decision and the simulation; poses of the arm a second while it
moves; and the resident memory of the studio over episodes of all tasks. Caches of meshes, textures and
physics models fill up in the first hundreds of episodes. Whether memory is flat is therefore judged by the
slope over the second half, in MB a thousand episodes.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect

from openvima.policies.naming import SMALL
from openvima.tasks import list_tasks
from sim import circumstances

WAIT_S = 120.0
START, ENDED = "0 steps of at most", ("solved", "not solved")  # of what the page says of an episode
CAMERA = {
    "wxyz": (0.0, 0.7, 0.7, 0.0),
    "position": (1.2, 0.0, 1.0),
    "look_at": (0.4, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1300,
}
HAND = "/first/arm/7"  # the arm's last node
SAMPLES = 20  # of memory


class Viewer:
    """A client of viser: it connects, presses buttons, and keeps when which message came.

    Args:
        url: Address of the studio.
    """

    def __init__(self, url: str) -> None:
        address = url.replace("http", "ws", 1)
        self._socket = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)  # type: ignore[list-item]
        self._uuids: dict[str, str] = {}  # of fields, by label or button
        self.status, self.error = "", ""
        self.moves: list[tuple[float, str]] = []  # when and what
        self._changed = threading.Condition()
        self._send("ViewerCameraMessage", **CAMERA)
        threading.Thread(target=self._read, daemon=True).start()

    def set(self, field: str, value: object) -> None:
        """Change a field, or press the button `value` of a group."""
        self._send("GuiUpdateMessage", uuid=self._uuids[field], updates={"value": value})

    def press(self, button: str) -> None:
        """Press a button of a group."""
        self.set(button, button)

    def wait(self, condition: Callable[[], bool]) -> float:
        """Wait for something, and return when it was so."""
        with self._changed:
            answered = self._changed.wait_for(lambda: self.error or condition(), WAIT_S)
            if self.error or not answered:
                raise RuntimeError(self.error or f"no answer in {WAIT_S:.0f} s after {self.status!r}")
        return time.perf_counter()

    def _send(self, kind: str, **fields: object) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def close(self) -> None:
        """Leave."""
        self._socket.close()

    def _read(self) -> None:
        for raw in self._socket:  # until it is closed
            now = time.perf_counter()
            end = 16 + int.from_bytes(raw[8:16], "little")
            window = msgspec.msgpack.decode(zstandard.decompress(raw[16:end]))
            with self._changed:
                for message in window["messages"]:
                    self._take(message, now)
                self._changed.notify_all()

    def _take(self, message: dict[str, Any], now: float) -> None:
        kind, props = message["type"], message.get("props", {})
        if kind == "NotificationShowMessage":
            self.error = str(props["body"])
        if kind.startswith("Gui") and "uuid" in message:
            for name in (props.get("label"), *(props.get("options", ()) if "Button" in kind else ())):
                self._uuids.setdefault(str(name), message["uuid"])
            text = str(message.get("updates", {}).get("_markdown", ""))
            if text.startswith(ENDED) or " of at most " in text:
                self.status = text
        elif kind in ("SetPositionMessage", "SetOrientationMessage"):
            self.moves.append((now, message["name"]))


@contextmanager
def running_studio() -> Iterator[tuple[subprocess.Popen, str, float]]:
    """Start `openvima studio`; give its process, its address and when it was started."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "openvima", "studio"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None  # a pipe
        yield process, process.stdout.readline().strip(), start
    finally:
        process.terminate()
        process.wait()


def browser_start_s() -> float | None:
    """Return seconds from the command until a page shows the first episode; None without a browser."""
    try:
        from studio_page import Page, find_browser, launched_browser  # type: ignore[import]  # of tests
    except ImportError:
        return None
    if find_browser() is None:
        return None
    with launched_browser() as browser, running_studio() as (_, url, start):
        page = Page(browser, url, width=1300, height=800)
        page.wait_for(START)
        page.raw.evaluate(
            "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        return round(time.perf_counter() - start, 3)


def step_times(viewer: Viewer, rounds: int) -> dict[str, float]:
    """Press *step* in new episodes: seconds until the arm moves, and poses a second until it stops."""
    waits, frames, messages = [], [], []
    for number in range(rounds + 1):
        viewer.moves.clear()
        start = time.perf_counter()
        viewer.press("step")
        begun = viewer.wait(lambda: bool(viewer.moves))
        viewer.wait(lambda: not viewer.status.startswith(START))
        hand = [when for when, name in viewer.moves if name == HAND]
        if number:  # the first loads code
            waits.append(begun - start)
            frames.append((len({*hand}) - 1) / (hand[-1] - hand[0]))
            messages.append(len(viewer.moves) / (hand[-1] - hand[0]))
        viewer.press("next seed")
        viewer.wait(lambda: viewer.status.startswith(START))
    return {
        "round_trip_s": round(statistics.median(waits), 3),
        "slowest_round_trip_s": round(max(waits), 3),
        "arm_poses_per_s": round(statistics.median(frames), 1),
        "pose_messages_per_s": round(statistics.median(messages), 1),
    }


def memory(viewer: Viewer, process: subprocess.Popen, episodes: int) -> list[tuple[int, float]]:
    """Play episodes of all tasks; return the resident memory in MB after some of them."""
    tasks, samples = list_tasks(), []
    for number in range(episodes):
        if number % len(tasks) == 0:
            viewer.set("seed", number)
        viewer.set("task", tasks[number % len(tasks)])
        viewer.wait(lambda: viewer.status.startswith(START))
        while not viewer.status.startswith(ENDED):
            before = viewer.status
            viewer.press("step")
            viewer.press("pause")  # ends the animation
            viewer.wait(lambda said=before: viewer.status != said)
        viewer.moves.clear()
        if number % max(1, episodes // SAMPLES) == 0 or number == episodes - 1:
            samples.append((number + 1, resident_mb(process.pid)))
            print(f"{samples[-1][0]} episodes: {samples[-1][1]:.1f} MB", file=sys.stderr)
    return samples


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def slope(samples: list[tuple[int, float]]) -> float:
    """Return the growth over the second half of the samples, in MB a thousand episodes."""
    half = np.array(samples[len(samples) // 2 :])
    return round(1000 * float(np.polyfit(half[:, 0], half[:, 1], 1)[0]), 1) if len(half) > 1 else 0.0


def main() -> None:
    """Measure, print the results, and write them as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--episodes", type=int, default=1000, help="played for the memory")
    parser.add_argument(
        "--rounds", type=int, default=10, help="steps that are timed, after one that warms up"
    )
    parser.add_argument("--policy", default=SMALL, help="one that the page offers")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    results: dict[str, Any] = {"policy": options.policy, "browser_first_picture_s": browser_start_s()}
    with running_studio() as (process, url, start), closing(Viewer(url)) as viewer:
        results["first_episode_sent_s"] = round(
            viewer.wait(lambda: viewer.status.startswith(START)) - start, 3
        )
        if options.policy != SMALL:
            viewer.set("policy", options.policy)
        results |= step_times(viewer, options.rounds)
        samples = memory(viewer, process, options.episodes)
    results |= {"rss_mb": samples, "rss_mb_per_1000_episodes": slope(samples)}
    for name, value in (circumstances() | results).items():
        print(f"{name}: {value}")
    if options.json:
        content = circumstances() | results
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
