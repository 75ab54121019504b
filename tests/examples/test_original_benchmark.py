"""The client for the original benchmark, against a stand-in of that benchmark's interface."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from openvima.scene import RenderedPrompt
from openvima.serving import serve_in_thread

ROOT = Path(__file__).parents[2]
CLIENT = ROOT / "examples" / "score_in_original_benchmark.py"
STAND_IN = ROOT / "tests" / "original_benchmark"


class Picker:
    """Picks object 5 where the segmentation shows it, if the prompt is as the benchmark gave it."""

    def __init__(self) -> None:
        self.prompts: list[RenderedPrompt] = []
        self.arm_pixels: set[int] = set()

    def reset(self, prompts: Sequence[RenderedPrompt]) -> None:
        self.prompts.extend(prompts)

    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        return [observation and self._pick(observation) for observation in observations]

    def _pick(self, seen: Mapping) -> dict[str, np.ndarray]:
        assert set(np.unique(seen["segm"]["front"])) == {0, 1, 5, 6} and seen["ee"] == 0
        self.arm_pixels.add(int(seen["rgb"]["top"][0, 1, 0]))
        assert np.array_equal(seen["segm"]["front"], seen["segm"]["top"])
        column = np.argwhere(seen["segm"]["top"] == 5)[0, 1]
        position, rotation = np.array([column / 100 + 0.005, 0.0]), np.array([0.0, 0, 0, 1])  # float64
        poses = {f"pose{n}_position": position for n in (0, 1)}
        return poses | {f"pose{n}_rotation": rotation for n in (0, 1)}


@pytest.fixture
def picker() -> Picker:
    return Picker()


@pytest.fixture
def url(picker: Picker) -> Iterator[str]:
    with serve_in_thread(picker, about={"policy": {"name": "picker"}}) as url:
        yield url


def client(*words: object, benchmark: Path = STAND_IN) -> tuple[str, str]:
    done = subprocess.run(
        [sys.executable, str(CLIENT), *map(str, words)],
        env={**os.environ, "PYTHONPATH": str(benchmark)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Traceback" not in done.stderr or done.returncode == 0, done.stderr
    assert bool(done.stdout) == (done.returncode == 0), done.stderr
    return done.stdout, done.stderr


def test_a_served_policy_is_scored_and_a_second_run_plays_what_is_missing(
    picker: Picker, url: str, tmp_path: Path
) -> None:
    words = ("--url", url, "--out", tmp_path, "--levels", "L2,L4", "--tasks", "twist,same_texture")
    table, problem = client(*words, "--episodes", 5, "--seed", 40000)
    assert table.splitlines()[2:] == [
        "| L2 | twist | 3 of 5 | 23% to 88% |",
        "| L2 | **mean** | **60.0%** | |",
        "| L4 | same_texture | 3 of 5 | 23% to 88% |",
        "| L4 | **mean** | **60.0%** | |",
    ], problem
    prompt = picker.prompts[1]  # of seed 40001
    assert prompt.text == "Put the {dragged_obj_1} as in {scene}, not the {dragged_obj_1}."
    shown = {name: [(o.object_id, o.object) for o in image.objects] for name, image in prompt.images.items()}
    assert shown == {"dragged_obj_1": [(0, "bowl")], "scene": [(5, "bowl"), (6, "block")]}
    assert [image.kind for image in prompt.images.values()] == ["object", "scene"]
    assert prompt.images["scene"].rgb["top"].max() == 40001 % 256 and len(picker.prompts) == 10
    record = json.loads((tmp_path / "L4" / "same_texture" / "40001.json").read_text())
    outcome = {"success": True, "failure": False, "steps": 2, "redraws": 1}
    assert record == {"seed": 40001, **outcome, "prompt": prompt.text}
    assert picker.arm_pixels == {0}

    (tmp_path / "L2" / "twist" / "40003.json").unlink()
    again, _ = client(*words, "--episodes", 7, "--seed", 40000)
    assert "| L2 | twist | 4 of 7 | 25% to 84% |" in again and len(picker.prompts) == 15
    _, problem = client(*words, "--show-arm")
    assert "records of another policy or with other options" in problem and len(picker.prompts) == 15


def test_what_is_wrong_is_said_in_a_line(url: str, tmp_path: Path) -> None:
    out = ("--out", tmp_path, "--url", url)
    assert (
        "there is no task 'rotat'; allowed: rotate, same_texture, twist."
        in client(*out, "--tasks", "rotat")[1]
    )
    assert "no policy server at ws://127.0.0.1:1" in client("--out", tmp_path, "--url", "ws://127.0.0.1:1")[1]
    assert "docs/original_benchmark.md" in client(*out, benchmark=tmp_path)[1]
    assert not list(tmp_path.iterdir())
