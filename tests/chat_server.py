"""A server of the OpenAI-compatible chat protocol whose answers a test gives."""

import base64
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image


@dataclass
class ChatServer:
    """What a server was sent, and what it does.

    Args:
        reply: From the body of a request to the words of an answer, or to status, headers and body.
        key: What it wants as a key; empty takes any.
    """

    reply: Callable[[dict[str, Any]], str | tuple[int, dict[str, str], bytes]]
    key: str = ""
    url: str = ""
    bodies: list[dict[str, Any]] = field(default_factory=list)
    answered: list[str] = field(default_factory=list)  # requests that got an answer
    lock: threading.Lock = field(default_factory=threading.Lock)


def text_of(body: dict[str, Any]) -> str:
    """All text of a request, with a mark for each image."""
    return "\n".join(
        part["text"] if part["type"] == "text" else "<image>"
        for message in body["messages"]
        for part in message["content"]
    )


def images_of(body: dict[str, Any]) -> list[np.ndarray]:
    """The images of a request, shape (H, W, 3), uint8."""
    urls = [
        part["image_url"]["url"]
        for message in body["messages"]
        for part in message["content"]
        if part["type"] == "image_url"
    ]
    return [np.asarray(Image.open(BytesIO(base64.b64decode(url.partition(",")[2])))) for url in urls]


@contextmanager
def chat_server(
    reply: Callable[[dict[str, Any]], str | tuple[int, dict[str, str], bytes]], key: str = ""
) -> Iterator[ChatServer]:
    """Serve while the block runs."""
    state = ChatServer(reply, key)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._send(*((200, {}, b'{"object": "list", "data": []}') if self._may() else _DENIED))

        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if not self._may():
                return self._send(*_DENIED)
            with state.lock:
                state.bodies.append(body)
            said = state.reply(body)
            if isinstance(said, str):
                with state.lock:
                    state.answered.append(json.dumps(body, sort_keys=True))
            return self._send(*(said if isinstance(said, tuple) else (200, {}, completion(said))))

        def _may(self) -> bool:
            return not state.key or self.headers["Authorization"] == f"Bearer {state.key}"

        def _send(self, status: int, headers: dict[str, str], content: bytes) -> None:
            self.send_response(status)
            for name, value in {"Content-Type": "application/json", **headers}.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}/v1"
    try:
        yield state
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


_DENIED = 401, {}, b'{"error": {"message": "Incorrect API key provided: sk-secret-of-a-test"}}'


def completion(words: str) -> bytes:
    """The body of a response with these words."""
    return json.dumps(
        {
            "id": "1",
            "object": "chat.completion",
            "created": 0,
            "model": "served-model-7",
            "choices": [
                {
                    "index": 0,
                    "finish_reason": "stop",
                    "message": {"role": "assistant", "content": words},
                }
            ],
            "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110},
        }
    ).encode()


def refused(status: int, message: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """A response with an error."""
    return status, headers, json.dumps({"error": {"message": message}}).encode()
