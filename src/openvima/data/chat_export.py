"""Export of demonstrations as conversations, for the fine-tuning of vision-language models.

An example is a step: what `openvima evaluate --policy vlm:MODEL` asks before it, and the oracle's answer.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import numpy as np

from openvima.data.chat import (
    DEFAULT_FORMAT,
    ChatFormat,
    Part,
    Turn,
    demo_turns,
    encode_picture,
    point_meaning,
    wording_hash,
)
from openvima.data.reader import Dataset
from openvima.data.records import Demonstration
from openvima.data.subsets import new_folder
from openvima.input_files import as_path
from openvima.multiprocess import Report
from openvima.perception.objects import ObjectExtractor

ExportFormat = Literal["messages", "llava"]
EXAMPLES_NAME, SOURCE_NAME = "train.jsonl", "source.json"
_IMAGES = "images"
_SPEAKERS = {"user": "human", "assistant": "gpt"}  # of llava


def export_chat(
    data: Path | str,
    out: Path | str,
    *,
    format: ExportFormat = "messages",
    tasks: Sequence[str] | None = None,
    form: ChatFormat = DEFAULT_FORMAT,
    extractor: ObjectExtractor | None = None,
    questions: int = 0,
    seed: int = 0,
    report: Report | None = None,
) -> Path:
    """Write `train.jsonl` and its images; the folder appears whole, or not at all.

    Args:
        data: Folder of demonstrations.
        out: Folder of the export.
        format: "messages": roles and contents, as TRL reads them; "llava": conversations with <image>.
        tasks: Keep the episodes of these tasks only; None keeps all.
        form: How views are shown and points are written.
        extractor: Finds the objects whose boxes are listed; None lists none.
        questions: Auxiliary questions on the scene for each demonstration.
        seed: Of the choice of questions.
        report: Called as `report(episodes done, episodes in all, task)`.

    Returns:
        The folder.

    Raises:
        DatasetError: There are no such demonstrations, or the folder has content.
        DatasetError: A shard is damaged.
    """
    dataset, out = Dataset(data, tasks=tasks), as_path(out)
    with new_folder(out, [dataset.path], force=False) as folder:
        (folder / _IMAGES).mkdir()
        with (folder / EXAMPLES_NAME).open("w", encoding="utf-8") as lines:
            for number, demo in enumerate(dataset, 1):
                name = f"{demo.task}-{demo.level}-{demo.domain}-{demo.seed}"
                turns = demo_turns(demo, form, extractor)
                paths = _save(folder, name, turns)
                for end in range(2, len(turns) + 1, 2):
                    lines.write(_line(format, f"{name}-{end // 2}", turns[:end], paths))
                rng = np.random.default_rng([seed, number])
                for index, question in enumerate(_questions(demo, questions, form, rng)):
                    asked = f"{name}-question{index}"
                    lines.write(_line(format, asked, question, _save(folder, asked, question)))
                if report:
                    report(number, len(dataset), demo.task)
        source = {
            "command": "openvima data export-chat",
            "config": {**asdict(form), "questions": questions, "seed": seed},
            "boxes": extractor is not None,
            "wording": wording_hash(),
            "content_hash": dataset.manifest["content_hash"],
        }
        (folder / SOURCE_NAME).write_text(json.dumps(source, indent=1) + "\n", encoding="utf-8")
    return out


def _save(folder: Path, name: str, turns: Sequence[Turn]) -> list[str]:
    """Save the images of a conversation; return their paths in the folder, in reading order."""
    paths = []
    for part in itertools.chain.from_iterable(turn.parts for turn in turns):
        if isinstance(part, bytes):
            paths.append(f"{_IMAGES}/{name}-{len(paths)}.png")
            (folder / paths[-1]).write_bytes(part)
    return paths


def _line(format: ExportFormat, name: str, turns: Sequence[Turn], paths: Sequence[str]) -> str:
    """Write an example; `paths` are those of its images, and may go on."""
    shown = paths[: sum(isinstance(part, bytes) for turn in turns for part in turn.parts)]
    if format == "messages":
        said = [{"role": turn.role, "content": [_block(part) for part in turn.parts]} for turn in turns]
        example = {"id": name, "messages": said, "images": shown}
    else:
        said = [{"from": _SPEAKERS[turn.role], "value": "\n".join(map(_text, turn.parts))} for turn in turns]
        example = {"id": name, "image": shown, "conversations": said}
    return json.dumps(example, ensure_ascii=False) + "\n"


def _block(part: Part) -> dict[str, str]:
    return {"type": "text", "text": part} if isinstance(part, str) else {"type": "image"}


def _text(part: Part) -> str:
    return part if isinstance(part, str) else "<image>"


def _questions(
    demo: Demonstration, count: int, form: ChatFormat, rng: np.random.Generator
) -> Iterator[tuple[Turn, Turn]]:
    """Ask on the scene: where an object is, which there are, how two lie to each other, what has changed."""
    kinds = (_where, _which, _relation, _change) if demo.scenes else ()
    for _ in range(count if kinds else 0):
        kind = kinds[rng.integers(len(kinds))]
        step = int(rng.integers(demo.num_steps))
        if found := kind(demo, step, form, rng):
            asked, answer = found
            steps = (step, step + 1) if kind is _change else (step,)
            views = [encode_picture(demo.rgb[form.views[0]][each], form.enlarge) for each in steps]
            yield Turn("user", (*views, asked)), Turn("assistant", (answer,))


Asked = tuple[str, str] | None  # question and answer; None where the scene has no such thing


def _where(demo: Demonstration, step: int, form: ChatFormat, rng: np.random.Generator) -> Asked:
    points = _points(demo, step, form)
    if not points:
        return None
    name = sorted(points)[rng.integers(len(points))]
    asked = f'Where is the {name}? Answer with JSON: {{"point": POINT}}. {point_meaning(form)}'
    return asked, json.dumps({"point": points[name]})


def _which(demo: Demonstration, step: int, form: ChatFormat, rng: np.random.Generator) -> Asked:
    points = _points(demo, step, form)
    asked = 'Which objects are on the table? Answer with JSON: {"objects": {NAME: POINT}}. '
    return asked + point_meaning(form), json.dumps({"objects": dict(sorted(points.items()))})


def _relation(demo: Demonstration, step: int, form: ChatFormat, rng: np.random.Generator) -> Asked:
    points = _points(demo, step, ChatFormat("pixels-xy", form.view, form.enlarge))
    if len(points) < 2:
        return None
    one, other = (sorted(points)[index] for index in rng.choice(len(points), 2, replace=False))
    across, down = np.subtract(points[one], points[other])
    where = (
        ("left", "right")[int(across > 0)] if abs(across) > abs(down) else ("above", "below")[int(down > 0)]
    )
    return f"Where in the picture is the {one}, from the {other}? Answer left, right, above or below.", where


def _change(demo: Demonstration, step: int, form: ChatFormat, rng: np.random.Generator) -> Asked:
    before, after = _points(demo, step, form), _points(demo, step + 1, form)
    moved = [name for name in sorted(before) if name in after and before[name] != after[name]]
    asked = (
        'What was moved between these pictures? Answer with JSON: {"moved": {NAME: [POINT, POINT]}}, from '
        f"and to. {point_meaning(form)}"
    )
    return asked, json.dumps({"moved": {name: [before[name], after[name]] for name in moved}})


def _points(demo: Demonstration, step: int, form: ChatFormat) -> dict[str, list[float]]:
    """Return the points of the objects whose name, texture and object, no other has."""
    placements = demo.scenes[step].placements
    names = [f"{placement.texture} {placement.object}" for placement in placements]
    count = Counter(names)
    return {
        name: form.point(placement.pose.position)
        for name, placement in zip(names, placements, strict=True)
        if count[name] == 1
    }
