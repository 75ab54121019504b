"""What evaluations of vision-language models need besides: shots before the task, mistakes, a preview.

What a model said in each step is in `answers.jsonl`; counts and groups of mistakes are in the results.
"""

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.data.chat import UNREADABLE, ChatFormat, Tokens, Turn, demo_turns, family_of
from openvima.data.records import rollout_oracle
from openvima.detector.plugins import chat_extractor
from openvima.env.tabletop import TabletopEnv
from openvima.errors import AnswerError, ConfigError, OracleError
from openvima.evaluation.config import EvaluationConfig, cells
from openvima.evaluation.prompt_ablations import settings_of
from openvima.evaluation.results import EpisodeOutcome
from openvima.html import render_page
from openvima.perception.objects import ObjectExtractor
from openvima.render.raycast import object_below
from openvima.scene import Action, AtPose
from openvima.scene.action import pose_after
from openvima.scene.goal import object_of, oracle_move
from openvima.serving.chat import Answer
from openvima.tasks import task_spec

ANSWERS_NAME, PREVIEW_NAME = "answers.jsonl", "first_message.html"
_CHARACTERS_PER_TOKEN = 4
Said = list[dict[str, Any]]  # what a model said in each step of an episode, as plain JSON values
_SHOT_LEVEL = "train"
_OTHER, _NOTHING = "picked another object", "picked nothing"
_PLACE, _ROTATION = "place off", "rotation off"
_UNITS = {_PLACE: "cm", _ROTATION: "degrees"}


def shot_turns(
    env: TabletopEnv, count: int, form: ChatFormat, extractor: ObjectExtractor | None = None
) -> tuple[Turn, ...]:
    """Return demonstrations of an environment's task, of domain train, as conversations one after another.

    Args:
        env: The environment that they come before.
        count: How many; a task that is held out for L4 gets none.
        form: How they are written.
        extractor: Finds the objects whose boxes are listed.
    """
    if not count or _SHOT_LEVEL not in task_spec(env.task).levels:
        return ()
    changed: dict[str, Any] = {"level": _SHOT_LEVEL, "domain": "train", "prompts": env.prompts}
    shown = TabletopEnv(env.task, **settings_of(env) | changed)
    turns: list[Turn] = []
    seed = 0
    while count:
        with suppress(OracleError):
            demo = rollout_oracle(shown, seed)
            if demo.outcome.success:
                count -= 1
                turns += demo_turns(demo, form, extractor)
        seed += 1
    return tuple(turns)


def said_in(env: TabletopEnv, answer: Answer, decision: Any) -> dict[str, Any]:
    """Describe an answer before it is carried out: who said what, what it cost, and what is wrong with it."""
    is_read = not isinstance(decision, AnswerError)
    mistake = mistake_in(env, Action.from_arrays(decision)) if is_read else {"kind": UNREADABLE}
    return {**asdict(answer), "mistake": mistake}


def mistake_in(env: TabletopEnv, action: Action) -> dict[str, Any] | None:
    """Say what is wrong with a pick and place, by the goals that can be met next; None: nothing is known.

    The environment is as before the action. What is wrong has a kind, and by how much in cm or degrees.
    """
    problem, progress, scene = env.episode.problem, env.progress, env.scene
    if scene.end_effector != "suction" or not progress.open_goals:
        return None
    stage = problem.stage_of(progress.open_goals[0])
    open_goals = [problem.goals[index] for index in progress.open_goals if index in stage]
    goals = [goal for goal in problem.prerequisites if not goal.is_met(scene)] or open_goals
    picked = object_below(scene.placements, action.pose0_position, env.assets)
    if picked not in {object_of(goal) for goal in goals}:
        return {"kind": _OTHER if picked else _NOTHING}
    move = next(oracle_move(goal, scene) for goal in goals if object_of(goal) == picked)
    placed = scene.with_poses({picked: pose_after(scene[picked].pose, action)})
    if not isinstance(move, AtPose) or move.is_met(placed):
        return None
    distance_m, angle_rad = move.distance(placed)
    if distance_m >= move.tolerance.position_m:
        return {"kind": _PLACE, "by": round(100 * distance_m, 1)}
    return {"kind": _ROTATION, "by": round(math.degrees(angle_rad), 1)}


def summarise(episodes: Sequence[tuple[EpisodeOutcome, Said]]) -> dict[str, Any]:
    """Count what the answers of a model cost, and group the failures by their first mistake, as JSON values.

    Equal requests are one: the second answer came from disk.
    """
    answers = {said["request"]: said for _, steps in episodes for said in steps}.values()
    groups: dict[str, list[float]] = {}
    for outcome, steps in episodes:
        if not outcome.success:
            found = (said["mistake"] for said in steps if said["mistake"])
            mistake: dict[str, Any] = next(found, {"kind": "another reason"})
            groups.setdefault(mistake["kind"], []).append(mistake.get("by", 0.0))
    return {
        "requests": len(answers),
        "tokens_in": sum(said["tokens_in"] for said in answers),
        "tokens_out": sum(said["tokens_out"] for said in answers),
        "models": sorted({said["model"] for said in answers}),
        "left_out": sorted({name for said in answers for name in said["left_out"]}),
        "mistakes": [
            {"kind": kind, "episodes": len(found)}
            | ({"median": statistics.median(found), "unit": _UNITS[kind]} if kind in _UNITS else {})
            for kind, found in sorted(groups.items(), key=lambda group: (-len(group[1]), group[0]))
        ],
    }


def write_answers(folder: Path, steps: Iterable[Mapping[str, Any]]) -> float | None:
    """Write what was said, a line a step, without times; return the median time of an answer in seconds."""
    records = list(steps)
    seconds = [record["seconds"] for record in records]
    lines = [
        json.dumps({name: value for name, value in record.items() if name != "seconds"}, ensure_ascii=False)
        for record in records
    ]
    if not lines:
        return None
    atomic_write_file(folder / ANSWERS_NAME, "\n".join(lines) + "\n")
    return statistics.median(seconds)


def write_preview(config: EvaluationConfig) -> tuple[Path, str]:
    """Write the first message of the first vision-language model as a page; no server is asked.

    Args:
        config: The evaluation.

    Returns:
        The page in `config.out`, and an estimate for that model.

    Raises:
        ConfigError: No policy is vlm:MODEL.
    """
    models = [source.ref.model for source in config.sources if source.kind == "vlm"]
    if not models:
        raise ConfigError("a dry run shows what a vision-language model is asked; name a policy vlm:MODEL.")
    form, tokens = config.vlm.format_of(models[0]), family_of(models[0]).image_tokens
    extractor = chat_extractor(config.vlm.options.boxes)
    first: tuple[Turn, ...] = ()
    requests, totals = 0, np.zeros(2, int)
    for task, level in cells(config):
        env = config.env_config.make(task, level, domain="eval")
        observation, _ = env.reset(seed=config.seed)
        shots = shot_turns(env, config.vlm.options.shots, form, extractor)
        begin = (*shots, form.first_turn(env.prompt, observation, extractor))
        first = first or begin
        steps = len(rollout_oracle(env, config.seed).actions)
        later = steps * (steps - 1) // 2  # messages after the first, in all requests of an episode
        more = _count([form.next_turn(observation, extractor)], tokens)
        requests += config.episodes * steps
        totals += config.episodes * (steps * _count(begin, tokens) + later * more)
    images, text = totals.tolist()
    estimate = (
        f"{requests:,} requests, {images:,} tokens of images and {text:,} of text, if episodes "
        "take as many steps as the oracle; failures take more, and answers come on top"
    )
    page = render_page("chat", model=models[0], turns=first, estimate=estimate, points=form.points)
    return atomic_write_file(config.out / PREVIEW_NAME, page), estimate


def _count(turns: Sequence[Turn], tokens: Tokens) -> np.ndarray:
    """Count the tokens of the images and of the text; shape (2,)."""
    parts = [part for turn in turns for part in turn.parts]
    sizes = [Image.open(BytesIO(part)).size for part in parts if isinstance(part, bytes)]
    images = sum(tokens(width, height) for width, height in sizes)
    text = sum(len(part) for part in parts if isinstance(part, str)) // _CHARACTERS_PER_TOKEN
    return np.array([images, text])
