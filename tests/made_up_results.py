"""Made-up results, prompts and films."""

import numpy as np
import pytest
from PIL import Image

from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.video.encoder import Clip, png

VERSIONS = {"openvima": "9.8.7", "mujoco": "1.2.3"}
CONFIG = {"policies": ["mine", "oracle", "random"], "tasks": ["all"], "levels": ["L1", "L3"], "episodes": 10}


def outcomes(num_solved: int) -> tuple[EpisodeOutcome, ...]:
    failed = ("object 6 (red <swirl> letter A) left the workspace", "object left the workspace")
    return tuple(EpisodeOutcome(i, i < num_solved, 2, *(() if i < num_solved else failed)) for i in range(10))


@pytest.fixture
def results() -> Results:
    """Three policies on two tasks at L1 and one at L3; `mine` solves 9 and 6 of 10 at L1."""
    solved = {
        "mine": {("rotate", "L1"): 9, ("stack<b>", "L1"): 6, ("rotate", "L3"): 3},
        "oracle": {("rotate", "L1"): 10, ("stack<b>", "L1"): 10, ("rotate", "L3"): 10},
        "random": {("rotate", "L1"): 0, ("stack<b>", "L1"): 1, ("rotate", "L3"): 0},
    }
    rows = tuple(
        Row(policy, task, level, 1, outcomes(number))
        for policy, cells in solved.items()
        for (task, level), number in cells.items()
    )
    policies = {
        "mine": {"kind": "run", "sha256": "ab" * 32},
        "oracle": {"kind": "oracle"},
        "random": {"kind": "random"},
    }
    return Results(rows, CONFIG, VERSIONS, policies)


def prompt_image(name: str, rows: slice, columns: slice, colour: tuple[int, int, int]) -> PromptImage:
    rgb = np.full((3, 128, 256), 255, np.uint8)
    segm = np.full((128, 256), 255, np.uint8)
    rgb[:, rows, columns] = np.array(colour, np.uint8)[:, None, None]
    segm[rows, columns] = 0
    views = ("front", "top")
    record = ObjectRecord(0, "block", "red")
    return PromptImage(name, "object", dict.fromkeys(views, rgb), dict.fromkeys(views, segm), (record,))


@pytest.fixture
def prompt() -> RenderedPrompt:
    """A prompt with a green and a red picture."""
    images = {
        "a": prompt_image("a", slice(50, 80), slice(100, 130), (0, 200, 0)),
        "b": prompt_image("b", slice(40, 90), slice(90, 170), (200, 0, 0)),
    }
    return RenderedPrompt("Put the {a} into the {b}.", images)


@pytest.fixture
def clip() -> Clip:
    """A filmed failure; the film itself is not a real one."""
    picture = png(Image.new("RGB", (40, 20), (10, 120, 200)))
    prompt = ("Put the", picture, "into the", picture, ".")
    return Clip("mine", "rotate", "L1", 9, False, 2, "object <6> left", prompt, b"not a film", picture)
