"""Vision-language models in evaluations, against a server whose answers are known."""

import itertools
import json
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.chat_server import ChatServer, chat_server, images_of, refused, text_of

from openvima.cli.main import main
from openvima.data.chat import ChatFormat
from openvima.data.chat_settings import VlmOptions
from openvima.env import EnvConfig
from openvima.errors import LimitReachedError, MissingExtraError, PolicyError, ServerError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.sources import PolicySource
from openvima.policies.naming import PolicyRef
from openvima.serving.chat import VlmConfig

KEY = "sk-secret-of-a-test"
SURE = '{"pick": [500, 500], "place": [600, 500], "rotate": 0}'
GARBAGE = (  # more of it is read in the tests of chats
    *("", "x" * 10_000_000, "\x00\x1b[31m\u202e"),
    *('{"pick": [NaN, 1], "place": [1, 1]}', '{"pick": [5000, 1], "place": [1, 1]}'),
)


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("openai")
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def config(
    server: ChatServer, out: Path, *, tasks: tuple[str, ...] = ("rotate",), **settings: Any
) -> EvaluationConfig:
    options = {name: settings.pop(name) for name in VlmOptions.__slots__ if name in settings}
    settings = {"levels": ("L1",), "episodes": 2, "workers": 1} | settings
    vlm = VlmConfig(server.url, settings.pop("view", "top"), VlmOptions(**options))
    return EvaluationConfig(("vlm:some/model-7b",), tasks=tasks, out=out, vlm=vlm, **settings)


def oracle_reply(
    cells: list[tuple[str, str]], episodes: int, form: ChatFormat
) -> Callable[[dict[str, Any]], str]:
    """Answer as the oracle does, with some words before; an episode is known by its first view."""
    answers: dict[bytes, list[str]] = {}
    for task, level in cells:
        env = EnvConfig().make(task, level, domain="eval")
        for seed in range(episodes):
            observation, _ = env.reset(seed=seed)
            said = answers[_view(observation["rgb"][form.views[0]].transpose(1, 2, 0))] = []
            while not env.outcome.is_over:
                action = env.oracle_decision().action
                said.append(form.answer(action, env.scene.end_effector))
                env.advance(action)

    def reply(body: dict[str, Any]) -> str:
        views = [image for image in images_of(body) if image.shape[:2] == form.size[::-1]]
        steps = next(answers[_view(view[:: form.enlarge, :: form.enlarge])] for view in views if _known(view))
        number = sum(message["role"] == "assistant" for message in body["messages"])
        return f"I see it.\n{steps[min(number, len(steps) - 1)]}"

    def _known(view: Any) -> bool:
        return _view(view[:: form.enlarge, :: form.enlarge]) in answers

    return reply


def _view(pixels: Any) -> bytes:
    return pixels.tobytes()


def test_oracle_answers_over_the_network_solve_the_episodes(tmp_path: Path) -> None:
    tasks = ("rotate", "pick_in_order_then_restore", "sweep_without_exceeding")
    form = ChatFormat()
    with chat_server(oracle_reply([(task, "L1") for task in tasks], 2, form), KEY) as server:
        path = evaluate(config(server, tmp_path, tasks=tasks))
        first = path.read_bytes()
        results = Results.read(path)
        assert [row.successes for row in results.rows] == [2, 2, 2]
        asked = len(server.bodies)
        evaluate(config(server, tmp_path, tasks=tasks))
        (tmp_path / "results.json").unlink()
        evaluate(config(server, tmp_path, tasks=tasks))
        assert len(server.bodies) == asked and path.read_bytes() == first
    record = results.policies["model-7b"]
    assert record["answers"] == {
        "requests": asked, "tokens_in": 100 * asked, "tokens_out": 10 * asked,
        "models": ["served-model-7"], "left_out": [], "mistakes": [],
    }  # fmt: skip
    assert (record["kind"], record["model"], record["points"]) == ("vlm", "some/model-7b", "1000-xy")
    assert record["modalities"] == ["rgb"] and len(record["wording"]) == 8
    said = [json.loads(line) for line in (tmp_path / "answers.jsonl").read_text().splitlines()]
    assert len(said) == asked and said[0]["text"].startswith("I see it.")
    assert "median_answer_s" in json.loads((tmp_path / "evaluation_log.json").read_text())
    assert main(["verify-results", str(tmp_path)]) == 0


def test_a_conversation_goes_on_with_what_was_done(tmp_path: Path) -> None:
    with chat_server(lambda body: SURE) as server:
        evaluate(config(server, tmp_path, tasks=("pick_in_order_then_restore",), episodes=1))
    roles = [[message["role"] for message in body["messages"]] for body in server.bodies]
    assert roles[:3] == [["user"], ["user", "assistant", "user"], ["user", "assistant"] * 2 + ["user"]]
    assert text_of(server.bodies[1]).startswith(text_of(server.bodies[0]))
    assert server.bodies[1]["messages"][1]["content"][0]["text"] == SURE
    schema = server.bodies[0]["response_format"]["json_schema"]["schema"]
    assert schema["required"] == ["pick", "place", "rotate"] and server.bodies[0]["temperature"] == 0


def test_garbage_is_a_failed_episode_each(tmp_path: Path) -> None:
    said = itertools.cycle(GARBAGE)
    lock = threading.Lock()

    def reply(body: dict[str, Any]) -> str:
        with lock:
            return next(said)

    with chat_server(reply) as server:
        path = evaluate(config(server, tmp_path, episodes=3 * len(GARBAGE)))
    (row,) = Results.read(path).rows
    assert row.successes == 0 and sum(row.failures.values()) == 3 * len(GARBAGE)
    assert all(kind.startswith("unreadable answer: ") for kind in row.failures)
    assert len(row.failures) >= 4
    (mistakes,) = Results.read(path).policies["model-7b"]["answers"]["mistakes"]
    assert mistakes == {"kind": "unreadable answer", "episodes": 3 * len(GARBAGE)}
    assert main(["verify-results", str(tmp_path)]) == 0


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        *(
            (content, "application/json")
            for content in (b"", b"[]", b"3", b'{"choices": 3}', b'{"choices": [{}]}')
        ),
        (b"<html></html>", "text/html"),
    ],
)
def test_a_response_that_is_none_is_an_unreadable_answer(content: bytes, kind: str, tmp_path: Path) -> None:
    with chat_server(lambda body: (200, {"Content-Type": kind}, content)) as server:
        path = evaluate(config(server, tmp_path, episodes=1))
    assert Results.read(path).rows[0].failures == {"unreadable answer: it is empty": 1}


def test_mistakes_are_grouped(tmp_path: Path) -> None:
    form, oracle = ChatFormat(), oracle_reply([("rotate", "L1")], 3, ChatFormat())
    first_messages: list[Any] = []

    def reply(body: dict[str, Any]) -> str:
        values = json.loads(oracle(body).partition("\n")[2])
        first_messages.extend(body["messages"] if len(body["messages"]) == 1 else [])
        if len(first_messages) == 1:
            values["rotate"] += 90
        elif len(first_messages) == 2:
            values["place"] = [values["place"][0], 100 if values["place"][1] > 500 else 900]
        else:
            values["pick"] = form.point((0.26, -0.49))
        return json.dumps(values)

    with chat_server(reply) as server:
        path = evaluate(config(server, tmp_path, episodes=3, concurrency=1))
    found = {m["kind"]: m for m in Results.read(path).policies["model-7b"]["answers"]["mistakes"]}
    assert (
        found["rotation off"]["median"] == pytest.approx(90, abs=20)
        and found["rotation off"]["unit"] == "degrees"
    )
    assert found["place off"]["median"] > 10
    assert found.keys() == {"rotation off", "place off", "picked nothing"}


def test_busy_servers_are_asked_again(tmp_path: Path) -> None:
    count = itertools.count()
    busy = [
        refused(429, "slow down", **{"Retry-After": "0.01"}),
        refused(503, "loading", **{"Retry-After": "0.01"}),
    ]

    with chat_server(lambda body: busy[n] if (n := next(count)) < len(busy) else SURE) as server:
        evaluate(config(server, tmp_path, episodes=1, concurrency=1))
        assert len(server.bodies) == 2 + len(server.answered)


def test_settings_that_a_server_refuses_are_left_out(tmp_path: Path) -> None:
    def reply(body: dict[str, Any]) -> Any:
        return refused(400, "unknown field response_format") if "response_format" in body else SURE

    with chat_server(reply) as server:
        path = evaluate(config(server, tmp_path, concurrency=1))
    assert Results.read(path).policies["model-7b"]["answers"]["left_out"] == ["response_format"]
    assert sum("response_format" in body for body in server.bodies) == 1
    assert all("temperature" in body for body in server.bodies)


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (
            refused(400, "this model does not support images"),
            r"HTTP 400: .*support images.*sees and takes as many images",
        ),
        (refused(413, "too large"), "HTTP 413"),
        (refused(404, "no such model"), "whether 'some/model-7b' sees"),
    ],
)
def test_refusals_are_errors_of_one_line(reply: Any, message: str, tmp_path: Path) -> None:
    with chat_server(lambda body: reply) as server, pytest.raises(ServerError, match=message) as caught:
        evaluate(config(server, tmp_path))
    assert "\n" not in str(caught.value)


def test_a_server_that_is_away_and_a_wrong_key_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with chat_server(lambda body: SURE, key="another") as server:
        words = ["evaluate", "--policy", "vlm:m", "--tasks", "rotate", "--levels", "L1", "--episodes", "1"]
        words += ["--no-report", "--out", str(tmp_path), "--base-url"]
        assert main([*words, server.url]) == 1
    assert "HTTP 401" in (said := capsys.readouterr().err) and "OPENAI_API_KEY" in said and KEY not in said
    assert main([*words, server.url]) == 1
    assert "no chat server answers at 127.0.0.1" in capsys.readouterr().err


def test_limits_end_with_the_finished_part_of_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (
        f"evaluate --policy vlm:m --tasks rotate,novel_noun --levels L1 --episodes 1 --out {tmp_path}".split()
    )
    words += ["--no-report", "--vlm.concurrency", "1"]
    with chat_server(lambda body: SURE) as server:
        assert main([*words, "--base-url", server.url, "--vlm.max-requests", "7"]) == 1
        said = capsys.readouterr()
        assert "7 requests and 770 tokens are used" in said.err
        assert len(server.bodies) == 7 and not (tmp_path / "results.json").exists()
        assert "rotate" in said.out and "novel_noun" not in said.out
        with pytest.raises(LimitReachedError):
            evaluate(config(server, tmp_path / "b", max_tokens=100, concurrency=1))
        assert main([*words, "--base-url", server.url]) == 0
        assert len(server.answered) == len({*server.answered})


def test_the_key_is_in_no_file(tmp_path: Path) -> None:
    with chat_server(lambda body: f"{KEY} {SURE}", KEY) as server:
        evaluate(config(server, tmp_path))
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert len(files) > 4 and not any(KEY.encode() in path.read_bytes() for path in files)


def test_shots_are_of_the_task_and_of_training(tmp_path: Path) -> None:
    with chat_server(lambda body: SURE) as server:
        evaluate(config(server, tmp_path / "a", episodes=1, shots=2))
        assert [m["role"] for m in server.bodies[0]["messages"]] == ["user", "assistant"] * 2 + ["user"]
        texts = [m["content"][0]["text"] for m in server.bodies[0]["messages"][::2]]
        assert all(text.startswith("You control a robot arm") for text in texts)
        server.bodies.clear()
        path = evaluate(
            config(server, tmp_path / "b", tasks=("follow_motion",), levels=("L4",), episodes=1, shots=2)
        )
        assert len(server.bodies[0]["messages"]) == 1
    assert Results.read(path).policies["model-7b"]["shots"] == 2


def test_boxes_are_listed_and_said(tmp_path: Path) -> None:
    with chat_server(lambda body: SURE) as server:
        path = evaluate(config(server, tmp_path, episodes=1, boxes="segmentation"))
    assert "Objects in it, [left, top, right, bottom]: [" in text_of(server.bodies[0])
    assert Results.read(path).policies["model-7b"]["modalities"] == ["rgb", "segm"]


@pytest.mark.slow
def test_threads_change_nothing(tmp_path: Path) -> None:
    tasks = ("rotate", "novel_adj", "follow_order")
    with chat_server(lambda body: SURE) as server:
        one = evaluate(config(server, tmp_path / "one", tasks=tasks, episodes=8, concurrency=1))
    twelve, number = threading.Barrier(12), itertools.count()

    def reply(body: dict[str, Any]) -> str:
        if next(number) < 12:
            twelve.wait(120)  # raises unless all of them are on their way
        return SURE

    with chat_server(reply) as server:
        many = evaluate(config(server, tmp_path / "many", tasks=tasks, episodes=8, concurrency=12))
    records = [json.loads(path.read_text()) for path in (one, many)]
    for record in records:
        del record["sha256"], record["policies"]["model-7b"]["server"]  # another port
    assert records[0] == records[1]


def test_a_dry_run_shows_the_message_and_asks_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("jinja2")
    words = (
        f"evaluate --policy vlm:gemini-x --tasks rotate --levels L1 --episodes 20 --dry-run --out {tmp_path}"
    )
    assert main([*words.split(), "--base-url", "http://127.0.0.1:9/v1"]) == 0
    said = capsys.readouterr().out
    assert "20 requests" in said
    page = (tmp_path / "first_message.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "[y, x]" in page and "Rotate the" in page


def test_names_of_models() -> None:
    assert (
        PolicyRef.parse("vlm:a/b:free").kind == "vlm" and PolicyRef.parse("vlm:a/b:free").model == "a/b:free"
    )
    with pytest.raises(PolicyError, match="lacks the name of a model"):
        _ = PolicyRef.parse("vlm:").model


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(MissingExtraError, match=r"openvima\[vlm\]"):
        PolicySource("a", "vlm:a").check()
