"""Vision-language models as policies: the client of a chat server, and the policy that asks it.

Any server of the OpenAI-compatible protocol will do. Answers are kept on disk by a hash of the request.
"""

import hashlib
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.data.chat import MOST_CHARACTERS, ChatFormat, Turn, family_of, tool_in, wording_hash
from openvima.data.chat_settings import DEFAULT_OPTIONS, SEGMENTATION, ChatView, VlmOptions
from openvima.errors import AnswerError, ConfigError, LimitReachedError, PolicyError, ServerError, echo
from openvima.imports import import_extra
from openvima.perception.objects import ObjectExtractor
from openvima.policies.base import Policy
from openvima.scene import RenderedPrompt
from openvima.scene.explanation import Explanation

KEY_VARIABLE, URL_VARIABLE = "OPENAI_API_KEY", "OPENAI_BASE_URL"
_LEAST_SECRET = 12  # characters of a key that is kept out of texts
_RETRIES = 12  # with pauses of up to 8 s, or what the server asks for: a minute and more
_TIMEOUT_S, _CONNECT_S = 600.0, 10.0
_OPTIONAL = ("response_format", "temperature")  # that servers may refuse, in the order of leaving them out


@dataclass(frozen=True, slots=True)
class VlmConfig:
    """A chat server, and how its models are asked.

    Args:
        base_url: Address of the API, such as "http://127.0.0.1:8000/v1"; None: that of OPENAI_BASE_URL, else
            OpenAI's own.
        view: As in `ChatFormat`.
        options: Further settings.
        answers: Folder in which answers are kept; None keeps none.

    Raises:
        ConfigError: The view or the address cannot be.
    """

    base_url: str | None = None
    view: ChatView = "top"
    options: VlmOptions = DEFAULT_OPTIONS
    answers: Path | None = None

    def __post_init__(self) -> None:
        ChatFormat(view=self.view)
        url = self.base_url
        if url is not None and not url.startswith(("http://", "https://")):
            raise ConfigError(f"base_url is {echo(url)!r}; give one such as http://127.0.0.1:8000/v1.")

    @property
    def server(self) -> str:
        """Host and port of the server, without what else an address may hold, such as a password."""
        url = urlsplit(self.base_url or os.environ.get(URL_VARIABLE) or "https://api.openai.com/v1")
        return f"{url.hostname}:{url.port}" if url.port else str(url.hostname)

    @property
    def modalities(self) -> tuple[str, ...]:
        """What observations hold: the segmentation only where it gives the boxes."""
        return ("rgb", "segm") if self.options.boxes == SEGMENTATION else ("rgb",)

    def format_of(self, model: str) -> ChatFormat:
        """Return how a model is shown views and writes points."""
        points = self.options.points or family_of(model).points
        return ChatFormat(points, self.view, self.options.enlarge)

    def record(self, model: str) -> dict[str, Any]:
        """Return what the answers of a model depend on, as plain JSON values."""
        options = {
            name: getattr(self.options, name) for name in ("boxes", "shots", "free_text", "temperature")
        }
        what = {"model": model, "server": self.server, **asdict(self.format_of(model)), **options}
        return {**what, "modalities": list(self.modalities), "wording": wording_hash()}


DEFAULT_VLM = VlmConfig()


def require_extra() -> Any:
    """Import the client's package; a `MissingExtraError` says how to install it."""
    advice = "policies vlm:MODEL need openai; install it with: pip install 'openvima[vlm]'"
    return import_extra("openai", advice)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a model said.

    Args:
        request: Hash of the request.
        text: Its words, reasoning first; of long ones the end.
        model: Its name as the server gives it.
        tokens_in: Tokens of the request, as the server counts them.
        tokens_out: Tokens of the answer.
        seconds: Until it was there.
        left_out: Settings that the server did not take.
    """

    request: str
    text: str
    model: str
    tokens_in: int
    tokens_out: int
    seconds: float
    left_out: list[str]


class ChatClient:
    """Asks a model of a chat server, from several threads; answers that are on disk are not asked for again.

    Args:
        model: Name of the model.
        config: The server, and how it is asked.

    Raises:
        MissingExtraError: The package `openai` is not installed.
    """

    def __init__(self, model: str, config: VlmConfig) -> None:
        self._openai = require_extra()
        self.model, self.config = model, config
        self.num_requests, self.num_tokens = 0, 0  # of this client, not of answers that were on disk
        key = os.environ.get(KEY_VARIABLE, "")
        self._key = key if len(key) >= _LEAST_SECRET else ""  # servers of one's own take "none" or "EMPTY"
        self._client = self._openai.OpenAI(
            base_url=config.base_url, api_key=key or "none", timeout=_TIMEOUT_S, max_retries=_RETRIES
        )
        self.shots: dict[tuple[str, ...], tuple[Turn, ...]] = {}  # demonstrations, made once for all episodes
        self._lock = threading.Lock()
        # Threads that compute at once hand the interpreter's lock to and fro, a third of a decision's time.
        # So the episodes of an evaluation hold the turn, except while they wait for an answer.
        self.turn = threading.Lock()
        self.is_stopped = False  # set to ask nothing more
        self._is_reached = False
        self._left_out: list[str] = []

    def ask(self, turns: Sequence[Turn], schema: Mapping[str, Any]) -> Answer:
        """Ask for the next message of a conversation, of a JSON schema.

        Raises:
            ServerError: The server is away, or refuses the key, the model or the images.
            LimitReachedError: The limit of requests or tokens is reached.
        """
        options, settings = self.config.options, dict[str, Any](model=self.model)
        if options.temperature >= 0:
            settings["temperature"] = options.temperature
        if not options.free_text:
            named = {"name": "action", "strict": True, "schema": schema}
            settings["response_format"] = {"type": "json_schema", "json_schema": named}
        messages = f'"messages": [{", ".join(turn.message for turn in turns)}]}}'.encode()
        asked = json.dumps([self.config.server, settings]).encode() + messages
        request = hashlib.sha256(asked).hexdigest()[:32]
        folder = self.config.answers
        path = None if folder is None else folder / request[:2] / f"{request}.json"
        if path is not None and path.is_file():
            return Answer(**json.loads(path.read_text(encoding="utf-8")))
        if is_shared := self.turn.locked():
            self.turn.release()
        try:
            self._reserve()
            answer = self._asked(settings, messages, request)
            with self._lock:
                self.num_tokens += answer.tokens_in + answer.tokens_out
            if path is not None:
                atomic_write_file(path, json.dumps(asdict(answer)) + "\n")
        finally:
            if is_shared:
                self.turn.acquire()
        return answer

    def _reserve(self) -> None:
        """Count a request, if there may be one more."""
        options = self.config.options
        with self._lock:
            if self.is_stopped:
                raise LimitReachedError("nothing more is asked.")
            if not self._is_reached:
                self._reach()
            for name, used in (("max_requests", self.num_requests), ("max_tokens", self.num_tokens)):
                if 0 < getattr(options, name) <= used:
                    raise LimitReachedError(
                        f"{self.num_requests:,} requests and {self.num_tokens:,} tokens are used; the limit "
                        f"is vlm.{name} {getattr(options, name):,}. The same command goes on where this "
                        "ended, and counts anew."
                    )
            self.num_requests += 1

    def _reach(self) -> None:
        """Look whether there is a server that takes the key, before it is waited for patiently."""
        openai = self._openai
        try:
            self._client.with_options(max_retries=0, timeout=_CONNECT_S).models.list()
        except openai.APIConnectionError as error:
            raise ServerError(
                f"no chat server answers at {self.config.server} ({self._shown(error.__cause__ or error)}); "
                f"start it, or give another --base-url (or {URL_VARIABLE})."
            ) from None
        except (openai.AuthenticationError, openai.PermissionDeniedError) as error:
            raise self._refusal(error) from None
        except openai.APIError:  # not every server lists its models
            pass
        self._is_reached = True

    def _asked(self, settings: Mapping[str, Any], messages: bytes, request: str) -> Answer:
        """Ask the server; where it refuses a request, ask without the settings that it may not know."""
        openai, left_out = self._openai, self._left_out
        while True:
            sent = json.dumps({name: value for name, value in settings.items() if name not in left_out})
            content = f"{sent[:-1]}, ".encode() + messages
            started = time.perf_counter()
            try:
                # Not `chat.completions.create`, which walks through the images: a third of a step's time.
                said = self._client.post("/chat/completions", cast_to=object, content=content)
            except (openai.BadRequestError, openai.UnprocessableEntityError) as error:
                optional = [name for name in _OPTIONAL if name in settings and name not in left_out]
                if not optional:
                    raise self._refusal(error) from None
                left_out = [*left_out, optional[0]]
                continue
            except openai.APIStatusError as error:
                raise self._refusal(error) from None
            except openai.APIError as error:
                raise ServerError(
                    f"the chat server at {self.config.server} was lost ({self._shown(error)}); the same "
                    "command goes on where this ended."
                ) from None
            except ValueError as error:  # such as HTML instead of JSON, which is an answer without an action
                said = str(error)
            self._left_out = left_out
            return self._answer(said, request, time.perf_counter() - started, left_out)

    def _answer(self, said: Any, request: str, seconds: float, left_out: list[str]) -> Answer:
        """Take out of a response what counts; servers differ in what they leave out."""
        names = ("reasoning", "reasoning_content", "content")
        words = (_found(said, "choices", 0, "message", name) for name in names)
        text = "\n".join(word for word in words if isinstance(word, str) and word)
        if self._key:
            text = text.replace(self._key, "…")
        counts = (_found(said, "usage", name) for name in ("prompt_tokens", "completion_tokens"))
        tokens_in, tokens_out = (count if isinstance(count, int) and count > 0 else 0 for count in counts)
        name, text = echo(str(_found(said, "model") or self.model)), text[-MOST_CHARACTERS:]
        return Answer(request, text, name, tokens_in, tokens_out, round(seconds, 3), left_out)

    def _refusal(self, error: Any) -> ServerError:
        """Compose the error for a request that the server refused."""
        status = error.status_code
        if status < 500 and status != 429:  # too many requests
            hint = (
                f"check the key in the environment variable {KEY_VARIABLE}, --base-url, such as "
                f"http://HOST:PORT/v1, and whether {echo(self.model)!r} sees and takes as many images"
            )
        else:
            hint = "the same command goes on where this ended"
        said = self._shown(error)
        return ServerError(f"{self.config.server} refuses the request (HTTP {status}: {said}); {hint}.")

    def _shown(self, error: object) -> str:
        text = str(error).strip(". ") or type(error).__name__
        return echo(text.replace(self._key, "…") if self._key else text)


def _found(value: Any, *path: str | int) -> Any:
    """Return what lies at a path in JSON values; None where there is no such place."""
    for key in path:
        try:
            value = value[key]
        except (LookupError, TypeError):
            return None
    return value


@dataclass(slots=True)
class _Chat:
    """One episode: its prompt, the conversation so far, and the last answer."""

    prompt: RenderedPrompt
    turns: list[Turn]
    answer: Answer | None = None
    action: dict[str, np.ndarray] | None = None


class VlmPolicy(Policy):
    """A vision-language model that is asked for each action.

    What it said is in `answers`, one for each episode, after `act`. Where an answer holds no action, `act`
    gives an `AnswerError` in its place, which ends the episode.

    Args:
        client: The model's.
        extractor: Finds the objects whose boxes are listed; None lists none.

    Example: `VlmPolicy(ChatClient("qwen3-vl", VlmConfig("http://127.0.0.1:8000/v1")))`
    """

    def __init__(self, client: ChatClient, extractor: ObjectExtractor | None = None) -> None:
        self.client, self.extractor = client, extractor
        self.modalities = client.config.modalities
        self.format = client.config.format_of(client.model)
        self.shots: tuple[Turn, ...] = ()  # conversations that come before those of the episodes
        self._chats: list[_Chat] = []

    def new_session(self) -> "VlmPolicy":
        """Return a policy with the same client and its own episodes."""
        return VlmPolicy(self.client, self.extractor)

    @property
    def answers(self) -> list[Answer | None]:
        """The last answer in each episode."""
        return [chat.answer for chat in self._chats]

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        """Start a batch of episodes; nothing is asked yet."""
        self._chats = [_Chat(prompt, []) for prompt in prompts]

    def act(self, observations: Sequence[Mapping | None]) -> list[Any]:
        """Ask for the next action of every episode, of several at a time.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
            ServerError, LimitReachedError: As for `ChatClient.ask`.
        """
        if len(observations) != len(self._chats):
            raise PolicyError(f"got {len(observations)} observations for {len(self._chats)} prompts.")
        with ThreadPoolExecutor(self.client.config.options.concurrency) as pool:
            return list(pool.map(self._act, self._chats, observations))

    def explain(self) -> list[Explanation | None]:
        """Return the last action and words of each episode."""
        return [
            Explanation(chat.action, (), {}, words=chat.answer.text) if chat.action and chat.answer else None
            for chat in self._chats
        ]

    def _act(self, chat: _Chat, observation: Mapping | None) -> dict[str, np.ndarray] | AnswerError | None:
        chat.answer = chat.action = None
        if observation is None:
            return None
        tool = tool_in(observation)
        if chat.turns:
            chat.turns.append(self.format.next_turn(observation, self.extractor))
        else:
            chat.turns.append(self.format.first_turn(chat.prompt, observation, self.extractor))
        chat.answer = self.client.ask([*self.shots, *chat.turns], self.format.schema(tool))
        try:
            action = self.format.read_answer(chat.answer.text, tool)
        except AnswerError as error:
            return error
        # What the model thought is not sent back: it costs tokens, and no model was trained on it.
        chat.turns.append(Turn("assistant", (self.format.answer(action, tool),)))
        chat.action = action.to_arrays()
        return chat.action
