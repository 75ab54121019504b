"""Faults on purpose: every verb that writes is covered, broken promises are found, and a sample holds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import fault_cases
from fault_campaign import chosen, spread
from fault_cases import CASES, READ_ONLY, all_verbs
from fault_injection import is_supported
from fault_states import damage, differences, is_hidden, key, visible
from reliability_page import PAGE, PROMISES, page

ROOT = Path(__file__).parents[1]
needs_notices = pytest.mark.skipif(not is_supported(), reason="the system gives no notice of system calls")
LIGHT = "data merge demos others out --force,assets import"
SAMPLES = (  # of `CASES`: two jobs of like length; all are played by benchmarks/faults.py
    "generate,data ,verify-results,report evaluation --out out.html",
    "train,policies convert,detector convert,demo rotate --out,studio",
)

# Commands that break the promises, run as a case is.
CARELESS = """
import sys
from pathlib import Path
from unittest.mock import patch

import faults
from fault_cases import Case
from openvima.atomic_io import atomic_write

TEXT = "{" + 9000 * " " + "}"

def in_place():
    Path("out.json").write_text(TEXT)
    return 0

def unsynced():
    Path("new.json").write_text(TEXT)
    Path("new.json").rename("out.json")
    return 0

def silent():
    try:
        in_place()
    except OSError:
        pass
    return 0

def careful():
    with atomic_write(Path("out.json")) as file:
        file.write(TEXT.encode())
    return 0

cases = [Case(f.__name__, run=f) for f in (in_place, unsynced, silent, careful)]
with patch.object(faults, "CASES", cases), patch.object(faults, "import_everything", lambda **_: None):
    sys.exit(faults.main())
"""


def run_program(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    paths = [str(ROOT / name) for name in ("src", "tests", "benchmarks")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    memory = Path("/dev/shm")  # where syncing takes no time
    environment["TMPDIR"] = str(memory if memory.is_dir() else folder)
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, env=environment
    )


def campaign(file: Path, *options: str) -> list[dict]:
    words = [str(ROOT / "benchmarks" / "faults.py"), "--json", str(file), *options]
    ended = run_program(words, file.parent)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return json.loads(file.read_text())["cases"]


def test_every_verb_is_under_faults_or_writes_nothing() -> None:
    covered = {case.verb for case in CASES}
    assert covered | set(READ_ONLY) == set(all_verbs())
    assert not covered & set(READ_ONLY)


def test_a_new_verb_without_a_case_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fault_cases.VERBS, "polish", "make things shine")
    assert set(all_verbs()) - {case.verb for case in CASES} - set(READ_ONLY) == {"polish"}


@needs_notices
def test_careless_writers_are_found_and_careful_ones_are_not(tmp_path: Path) -> None:
    script = tmp_path / "careless.py"
    script.write_text(CARELESS)
    file = tmp_path / "faults.json"
    kinds = "kill,torn write,power cut,full disk,I/O error"
    assert run_program([str(script), "--json", str(file), "--kinds", kinds], tmp_path).returncode == 1
    found = {case["case"]: case for case in json.loads(file.read_text())["cases"]}
    broken = {
        name: {kind for kind, count in case["kinds"].items() if count["failed"]}
        for name, case in found.items()
    }
    assert {"kill", "torn write", "full disk"} <= broken["in_place"]
    assert "power cut" in broken["unsynced"]
    assert "I/O error" in broken["silent"]
    assert found["careful"]["failures"] == []


@needs_notices
@pytest.mark.slow
@pytest.mark.parametrize("cases", SAMPLES)
def test_verbs_hold_their_promises_at_a_sample_of_points(tmp_path: Path, cases: str) -> None:
    kinds = "kill,power cut,full disk"
    options = ("--cases", cases, "--max-points", "2", "--kinds", kinds)
    for case in campaign(tmp_path / "faults.json", *options):
        assert case["points"] == 2
        assert sum(count["injected"] for count in case["kinds"].values()) >= 3


@needs_notices
def test_light_verbs_hold_their_promises_at_a_sample_of_points(tmp_path: Path) -> None:
    kinds = "kill,full disk"
    found = campaign(
        tmp_path / "faults.json", "--cases", LIGHT, "--max-points", "2", "--kinds", kinds, "--light"
    )
    assert [case["kinds"]["kill"]["injected"] for case in found] == [2, 2]


def test_points_are_the_first_the_last_and_some_between() -> None:
    labels = ["open a", *["write a"] * 5, "rename a"]
    assert chosen(labels, 2, 0) == [0, 1, 5, 6]
    assert chosen(labels, 0, 0) == list(range(7))
    assert chosen(labels, 0, 3) == [0, 3, 6]
    assert spread(5, 1) == [2]


def test_trees_that_differ_by_process_ids_and_logs_are_the_same_state() -> None:
    one = {"out": None, "out/.a.json.12.tmp": b"x", "out/.lock.host.12": b"1", "out/timings_log.jsonl": b"1"}
    other = {"out": None, "out/.a.json.345.tmp": b"x", "out/.lock.host.345": b"2"}
    assert key(one) == key(other)
    assert key(one) != key({**one, "out/.a.json.12.tmp": b"y"})
    assert visible(one) == {}
    assert not is_hidden("out/a.json")
    assert (
        differences({"a": b"1", "b": b"2"}, {"a": b"0", "c": b"3"}) == "c is missing, b is there, a differs"
    )


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.json", b'{"a": 1'), ("a.html", b"<html>"), ("a.arrow", b"ARROW1"), ("a.png", b"P"), ("a.tex", b"")],
)
def test_a_file_that_is_cut_is_no_whole_file(name: str, content: bytes) -> None:
    assert damage(name, content).startswith(f"{name} is not whole")


def test_a_cut_last_line_is_repaired_by_readers_and_one_before_is_damage() -> None:
    assert damage("metrics.jsonl", b'{"a": 1}\n{"a"') == ""
    assert damage("metrics.jsonl", b'{"a"\n{"a": 1}\n')


def test_the_page_is_made_from_the_results_and_names_tests_that_exist() -> None:
    made = page(ROOT / "results")
    assert PAGE.read_text(encoding="utf-8") == made, "run python benchmarks/reliability_page.py"
    for _, places in PROMISES:
        assert all((ROOT / place).is_file() for place in places if "/" in place)
