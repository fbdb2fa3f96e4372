"""The folder of a calibration: what it refuses, what it keeps, and that nothing in it is ever lost."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from calibration.folder import RIG, STEPS, CalibrationFolder, CalibrationFolderError, read_steps
from calibration.observations import PoseObservation

BOARD = {"kind": "chessboard", "name": "mine", "columns": 8}


def pose(name, shift=0.0):
    rng = np.random.default_rng(1)
    n = 12
    points = np.column_stack([rng.normal(0, 50, (n, 2)), np.zeros(n)])
    projector = rng.normal(300, 50, (n, 2))
    projector[3] = np.nan
    return PoseObservation(
        name, np.arange(n), points, points[:, :2] + shift, np.full((n, 2), 0.1), projector, np.full((n, 2), 0.05)
    )


def refused(path, board=BOARD):
    with pytest.raises(CalibrationFolderError) as caught, CalibrationFolder(path, board):
        pass
    assert caught.value.remedy
    return caught.value.message


def test_findings_are_kept_and_former_ones_are_history(tmp_path):
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        assert folder.finding("focus") is None
        folder.finish("focus", {"edge_px": 1.5})
        folder.finish("focus", {"edge_px": 1.2})
        folder.finish("latency", {"latency": None})
        folder.forget("latency")
        folder.forget("never done")
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        found = folder.finding("focus")
        assert found is not None
        assert found["edge_px"] == 1.2
        assert folder.finding("latency") is None
    history = read_steps(tmp_path / "new")["history"]
    assert [(old["step"], old.get("edge_px")) for old in history] == [("focus", 1.5), ("latency", None)]


def test_poses_come_back_to_the_bit_in_order_and_numbers_are_not_used_twice(tmp_path):
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        for expected in ("pose-01", "pose-02", "pose-03"):
            name = folder.next_pose()
            assert name == expected
            folder.add_pose(name, pose(name, shift=float(name[-1])))
        folder.drop_pose("pose-03")
        (folder.path / "takes" / "pose-07").mkdir()
        assert folder.next_pose() == "pose-08", "the number of a take that was cut off is used up"
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        read = folder.poses()
        assert [p.name for p in read] == ["pose-01", "pose-02"]
        for name, found in zip(("pose-01", "pose-02"), read, strict=True):
            for field in fields(PoseObservation):
                wanted = getattr(pose(name, shift=float(name[-1])), field.name)
                np.testing.assert_array_equal(getattr(found, field.name), wanted)
        folder.drop_all_poses()
        assert folder.poses() == []
    kept = sorted(place.name for place in (tmp_path / "new" / "poses").iterdir())
    assert kept == ["dropped-pose-01.npz", "dropped-pose-02.npz", "dropped-pose-03.npz"]


def test_what_is_made_anew_keeps_its_former_version(tmp_path):
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        for number in (1, 2, 3):
            place = folder.new_take("focus")
            place.mkdir()
            (place / "frames.bin").write_text(str(number))
        for number in (1, 2):
            (folder.path / RIG).write_text(str(number))
            folder.drop_all_poses()
        (folder.path / "acceptance" / "01-plane-1").mkdir()
        assert folder.new_scan("01-plane-1") == folder.path / "acceptance" / "01-plane-1"
        folder.drop_scans()
    takes = {place.name: (place / "frames.bin").read_text() for place in (tmp_path / "new" / "takes").iterdir()}
    assert takes == {"focus": "3", "focus.cut-off": "1", "focus.cut-off-2": "2"}
    assert (tmp_path / "new" / "rig.former.json").read_text() == "1"
    assert (tmp_path / "new" / "rig.former-2.json").read_text() == "2"
    assert (tmp_path / "new" / "acceptance.former" / "01-plane-1.former").is_dir()
    assert not any((tmp_path / "new" / "acceptance").iterdir())


def test_folders_of_others_are_refused_and_left_as_they_are(tmp_path):
    other = tmp_path / "photos"
    other.mkdir()
    (other / "holiday.jpg").write_bytes(b"x")
    assert "something else" in refused(other)
    assert [place.name for place in other.iterdir()] == ["holiday.jpg"]
    with CalibrationFolder(tmp_path / "new", BOARD):
        pass
    assert "another board: mine" in refused(tmp_path / "new", {**BOARD, "columns": 9})
    file = tmp_path / "file"
    file.write_text("")
    assert str(file) in refused(file)


def test_folder_that_cannot_be_made_is_refused():
    assert "/proc/calibration cannot be used" in refused(Path("/proc/calibration"))


@pytest.mark.parametrize(
    ("change", "word"), [({"format": "a letter"}, "not what a calibration"), ({"version": 9}, "version 9")]
)
def test_steps_of_others_are_refused(tmp_path, change, word):
    with CalibrationFolder(tmp_path, BOARD):
        pass
    document = json.loads((tmp_path / STEPS).read_text()) | change
    (tmp_path / STEPS).write_text(json.dumps(document))
    assert word in refused(tmp_path)
    (tmp_path / STEPS).write_text('{"format": ')
    assert "not what a calibration" in refused(tmp_path)


def test_pose_file_that_is_damaged_is_named(tmp_path):
    with CalibrationFolder(tmp_path, BOARD) as folder:
        folder.add_pose("pose-01", pose("pose-01"))
        place = folder.path / "poses" / "pose-01.npz"
        place.write_bytes(place.read_bytes()[:200])
        with pytest.raises(CalibrationFolderError, match=r"pose-01\.npz"):
            folder.poses()


def test_only_one_process_works_in_it_and_a_dead_one_does_not_lock(tmp_path):
    script = (
        "import sys, json; from calibration.folder import CalibrationFolder\n"
        f"with CalibrationFolder({str(tmp_path / 'new')!r}, {BOARD!r}):\n    print('in', flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "in\n"
        assert "another process" in refused(tmp_path / "new")
    finally:
        process.kill()
        process.communicate()
    with CalibrationFolder(tmp_path / "new", BOARD) as folder:
        assert folder.poses() == []
