"""Pages quote their examples, their Python blocks run, and docs/performance.md is made of the results."""

import json
import re
from pathlib import Path

import pytest
from PIL import Image

from openvima.data import GenerateConfig, generate
from openvima.tasks import registry
from performance_table import PAGE
from performance_table import page as performance_page
from user_shapes import restored_assets

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```python(.*?)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXAMPLES = {file.read_text(encoding="utf-8") for file in ROOT.glob("examples/*.py")}
# Pages whose blocks run in tests of their own, which also check what they give.
ELSEWHERE = {"format", "policies", "reinforcement_learning", "studies"}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BEGINNINGS = {  # page to the example that it begins with
    "compose": "compose_a_scene",
    "explain": "explain_a_decision",
    "your_own_objects": "custom_object",
    "your_own_policy": "own_network",
    "your_own_task": "custom_task",
    "your_own_training": "own_training_loop",
}


def blocks(page: Path) -> list[str]:
    """Return the code of a page that runs as it stands; without examples that do work, which run as such."""
    found = BLOCK.findall(page.read_text(encoding="utf-8"))
    return [
        code
        for mark, code in found
        if mark.strip() != "no-run" and (code not in EXAMPLES or "__main__" in code)
    ]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Demonstrations of two tasks, a batch in all."""
    out = tmp_path_factory.mktemp("data") / "demos"
    generate(GenerateConfig(out=out, tasks=("rotate", "twist"), episodes=32, workers=1))
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.stem not in ELSEWHERE and blocks(page)],
    ids=lambda page: page.stem,
)
def test_the_code_of_a_page_runs(
    page: Path, demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    Path("examples").symlink_to(ROOT / "examples")
    if page.stem != "generating":
        Path("demos").symlink_to(demos)
    Image.new("RGB", (48, 48), (200, 30, 30)).save("photo.png")
    for name, scene in re.findall(r"^```yaml\n# (\S+)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        Path(name).write_text(scene, encoding="utf-8")
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))  # pages register tasks
    # Below its guard stands all that this page does; the others have examples there, which run as such.
    names: dict[str, object] = {"__name__": "__main__" if page.stem == "generating" else "page"}
    with restored_assets():
        for code in blocks(page):
            exec(compile(code, str(page), "exec"), names)


def test_blocks_that_do_not_run_are_few_and_begin_like_python() -> None:
    marked = [code for page in PAGES for mark, code in BLOCK.findall(page.read_text("utf-8")) if mark.strip()]
    assert len(marked) <= 15
    for code in marked:
        compile(code, "page", "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_that_starts_worker_processes_has_a_guard(page: Path) -> None:
    for _, code in BLOCK.findall(page.read_text(encoding="utf-8")):
        starts = re.search(r"(?<!num_)workers=(?!1\b)|make_vec\(.*num_workers=(?!0\b)", code)
        assert not starts or 'if __name__ == "__main__":' in code, code


@pytest.mark.parametrize(("page", "example"), BEGINNINGS.items())
def test_the_page_begins_with_its_example(page: str, example: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    code = (ROOT / "examples" / f"{example}.py").read_text(encoding="utf-8")
    assert len(code.splitlines()) <= 55
    assert text.split("```")[1] == f"python\n{code}"


ENTRY = {
    "what": "decision",
    "value": 12.5,
    "unit": "ms",
    "command": "python benchmarks/sim.py",
    "commit": "abc",
}


def record(folder: Path, name: str, *entries: dict) -> None:
    (folder / name).write_text(json.dumps({"performance": entries}), encoding="utf-8")


def test_the_page_is_made_from_the_results() -> None:
    made = performance_page(ROOT / "results")
    assert PAGE.read_text(encoding="utf-8") == made, "run python benchmarks/performance_table.py"


def test_a_newer_result_replaces_the_row(tmp_path: Path) -> None:
    gone = {"what": "gone", "command": "python benchmarks/that_is_gone.py"}
    record(tmp_path, "2026-01-01_a.json", ENTRY, ENTRY | {"what": "other", "value": "9 to 27"}, ENTRY | gone)
    ratio = {"what": "in turns", "unit": "×", "against": "def"}
    record(tmp_path, "2026-01-02_b.json", ENTRY | {"value": 1.5, "unit": "×"}, ENTRY | ratio)
    assert performance_page(tmp_path).splitlines()[-3:] == [
        "|---|---:|",
        "| other | [9 to 27 ms](../results/2026-01-01_a.md) |",
        "| decision | [1.5×](../results/2026-01-02_b.md) |",
    ]
