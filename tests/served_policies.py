"""Small prompts, observations and policies for tests of servers and clients."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from websockets.sync.server import serve

from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.serving.protocol import PROTOCOL, pack

VIEWS = ("front", "top")
SIZE = (4, 8)


def made_up_prompt(number: int) -> RenderedPrompt:
    """A prompt that only one number has."""
    rgb = {view: np.full((3, *SIZE), number, np.uint8) for view in VIEWS}
    segm = {view: np.zeros(SIZE, np.uint8) for view in VIEWS}
    records = (ObjectRecord(0, "bowl", "red swirl"),)
    image = PromptImage("thing", "object", rgb, segm, records)
    return RenderedPrompt(f"Look at {{thing}}, number {number}.", {"thing": image})


def made_up_observation(number: int) -> dict[str, Any]:
    rgb = {view: np.full((3, *SIZE), number, np.uint8) for view in VIEWS}
    return {"rgb": rgb, "segm": {view: np.ones(SIZE, np.uint8) for view in VIEWS}, "ee": 1}


class Telltale:
    """Answers with the number of the prompt, that of the observation, and how often it was asked."""

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        self.numbers = [int(prompt.images["thing"].rgb["top"][0, 0, 0]) for prompt in prompts]
        self.steps = 0

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        self.steps += 1
        return [
            None if seen is None else self._action(number, int(seen["rgb"]["top"][0, 0, 0]))
            for number, seen in zip(self.numbers, observations, strict=True)
        ]

    def _action(self, prompt: int, seen: int) -> dict[str, np.ndarray]:
        rotation = np.array([0, 0, 0, 1], np.float32)
        return {
            "pose0_position": np.array([prompt, seen], np.float32),
            "pose0_rotation": rotation,
            "pose1_position": np.array([self.steps, 0], np.float32),
            "pose1_rotation": rotation,
        }


class ForMany(Telltale):
    """The same for several clients at once."""

    def new_session(self) -> "ForMany":
        return ForMany()


def told(action: Mapping[str, np.ndarray] | None) -> tuple[int, int, int]:
    """What an action of `Telltale` says: prompt, observation, number of the step."""
    assert action is not None
    return (*map(int, action["pose0_position"]), int(action["pose1_position"][0]))


@contextmanager
def scripted_server(*frames: object, metadata: object = None) -> Iterator[str]:
    """A server that answers each request with the next of some frames; a function is called instead."""
    first = {"protocol": PROTOCOL} if metadata is None else metadata

    def converse(connection: Any) -> None:
        connection.send(first if isinstance(first, str) else pack(first))
        for _, frame in zip(connection, frames, strict=False):
            if callable(frame):
                frame(connection)
            else:
                connection.send(frame if isinstance(frame, str | bytes) else pack(frame))
        connection.close()

    with running(converse) as url:
        yield url


@contextmanager
def running(converse: Callable[[Any], None], **options: Any) -> Iterator[str]:
    """Serve in a thread; each connection is given to a function."""
    server = serve(converse, "127.0.0.1", 0, compression=None, **options)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
    finally:
        server.shutdown()
        thread.join()
