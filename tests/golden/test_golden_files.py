"""What the comparisons with recordings of the public benchmark say about recordings that they cannot read.

These tests need no recordings, but the scripts in `benchmarks/`, which have `golden` in their names.
"""

import gzip
import json
import sys

import numpy as np
import pytest

import dynamics
import fidelity
from dynamics import read_steps
from fidelity import RecordingError, ious, read_scene, scene_files


@pytest.fixture
def scene_record() -> dict:
    return {"task": "rotate", "seed": 1, "end_effector": "suction", "objects": [], "assets": {}}


def test_golden_folder_without_scenes_is_named(tmp_path) -> None:
    with pytest.raises(RecordingError, match="holds no recorded scenes"):
        scene_files(tmp_path)


def test_golden_scene_without_images_is_named(tmp_path, scene_record) -> None:
    path = tmp_path / "rotate-1.json"
    path.write_text(json.dumps(scene_record))
    with pytest.raises(RecordingError, match=r"rotate-1.*No such file"):
        read_scene(path)


def test_golden_scene_with_damaged_images_is_named(tmp_path, scene_record) -> None:
    path = tmp_path / "rotate-1.json"
    path.write_text(json.dumps(scene_record))
    path.with_suffix(".npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(RecordingError, match="rotate-1"):
        read_scene(path)


@pytest.mark.parametrize("missing", ["task", "end_effector", "objects"])
def test_golden_scene_that_lacks_an_entry_says_which(tmp_path, scene_record, missing) -> None:
    del scene_record[missing]
    path = tmp_path / "rotate-1.json"
    path.write_text(json.dumps(scene_record))
    blank = {
        f"{kind}_{view}": np.zeros((1, 1), np.uint8) for kind in ("rgb", "segm") for view in ("top", "front")
    }
    np.savez(path.with_suffix(".npz"), **blank)
    with pytest.raises(RecordingError, match=missing):
        read_scene(path)


def test_golden_episodes_that_are_no_recording_are_named(tmp_path) -> None:
    path = tmp_path / "episodes.json.gz"
    with pytest.raises(RecordingError, match="No such file"):
        list(read_steps(path))
    path.write_bytes(b"no archive")
    with pytest.raises(RecordingError, match="episodes"):
        list(read_steps(path))
    path.write_bytes(gzip.compress(b'[{"task": "rotate"}]'))
    with pytest.raises(RecordingError, match="lacks the entry"):
        list(read_steps(path))


@pytest.mark.parametrize("script", [fidelity, dynamics])
def test_golden_scripts_name_a_missing_pack_in_one_line(script, tmp_path, monkeypatch, capsys) -> None:
    data = "--scenes" if script is fidelity else "--episodes"
    monkeypatch.setattr(sys, "argv", [script.__name__, data, str(tmp_path), "--assets", str(tmp_path)])
    with pytest.raises(SystemExit) as caught:
        script.main()
    assert caught.value.code == 2
    assert "holds no original asset pack" in capsys.readouterr().err.splitlines()[-1]


def test_golden_bodies_of_few_pixels_are_not_compared() -> None:
    ours, theirs = np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8)
    ours[0, :10], theirs[0, 5:15] = 5, 5
    ours[2:5, :10], theirs[2:5, 1:11] = 6, 6
    assert ious(ours, theirs, first_id=5, groups=[]) == {(6,): 27 / 33}
