"""`calibrate` as an operator gets it wrong: every answer says what, where and what to do, and nothing is written."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from small_bench import calibrate

from calibration.folder import CalibrationFolder
from drivers import SteppedBench
from sim_backend import stage

BENCH_WITHOUT = "bench: {kind: simulated, scene: {name: plane}}\n"


def refused(ran, *words, code=2):
    assert ran.code == code, ran
    said = ran.err
    assert "Traceback" not in said + ran.out
    for word in words:
        assert word in said, said
    return said


def test_help_says_how_it_goes_on_and_comes_at_once():
    script = (
        "import sys; sys.argv = ['calibrate', '--help']\n"
        "from calibration.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: code = end.code\n"
        "heavy = {'cv2', 'scipy', 'numba', 'open3d', 'matplotlib', 'pyglet'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    for word in ("--config", "--headless", "--step", "board", "verify", "check", "done steps are not repeated"):
        assert word in done.stdout


def test_without_a_bench_file_it_explains_itself():
    ran = calibrate()
    assert ran.code == 2
    assert "Usage" in ran.out + ran.err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: BENCH_WITHOUT, ("no section `calibration:`", "board:", "configs/bench.yaml")),
        (
            lambda text: text.replace("board.yaml", "nothere.yaml"),
            ("calibration.board", "nothere.yaml", "configs/boards"),
        ),
        (lambda text: text.replace("board.yaml", "bench.yaml"), ("kind",)),
        (lambda text: text.replace("poses: 5", "poses: 2"), ("calibration.geometry.poses", "≥ 3")),
        (lambda text: text.replace("poses: 5", "pose: 5"), ("calibration.geometry.pose", "did you mean")),
        (lambda text: text.replace("nearest_mm: 600", "nearest_mm: 800"), ("nearest_mm 800", "farthest_mm 720")),
        (lambda text: text.replace("kind: plane", "kind: cube"), ("calibration.acceptance.artefacts",)),
    ],
)
def test_wrong_bench_files_are_explained(bench_file, tmp_path, change, words):
    (tmp_path / "bench.yaml").write_text(change(bench_file.read_text()))
    (tmp_path / "board.yaml").write_text((bench_file.parent / "board.yaml").read_text())
    out = tmp_path / "out"
    said = refused(calibrate("--config", tmp_path / "bench.yaml", "--headless", "--out", out), *words)
    assert "→" in said
    assert not out.exists()


def test_wrong_usage_is_explained_and_nothing_is_made(bench_file, tmp_path):
    out = tmp_path / "out"
    common = ("--config", bench_file, "--headless", "--out", out)
    refused(calibrate(*common, "--step", "geo"), "geo", "geometry")
    refused(calibrate(*common, "--set", "calibration.geometry.poses"), "KEY=VALUE")
    refused(calibrate("--config", tmp_path / "none.yaml", "--headless", "--out", out), "none.yaml")
    for command in ("verify", "check"):
        refused(calibrate(command, *common), "holds no rig.json", "--rig")
        refused(calibrate(command, *common, "--rig", tmp_path / "none.json"), "none.json does not exist")
    assert not out.exists()


def test_folders_in_use_and_of_others_are_refused(bench_file, tmp_path):
    common = ("--config", bench_file, "--headless")
    with CalibrationFolder(tmp_path / "other", {"name": "another one"}):
        pass
    refused(calibrate(*common, "--out", tmp_path / "other"), "another board: another one", "--out")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    refused(calibrate(*common, "--out", tmp_path / "photos"), "something else", "--out")


@dataclass
class Unattended(SteppedBench):
    """The simulated bench without a way to present anything."""

    settings: Any = field(kw_only=True)
    transports: Any = field(kw_only=True)


def test_bench_before_which_nobody_holds_anything_says_so(bench_file, tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "SimulatedBench", Unattended)
    ran = calibrate("--config", bench_file, "--headless", "--out", tmp_path / "out")
    refused(ran, "has nobody who holds things before it", "without --headless")


def test_where_nobody_can_press_a_key_it_says_so(bench_file, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with open("/dev/null") as nobody:
        monkeypatch.setattr(sys, "stdin", nobody)
        ran = calibrate("--config", bench_file, "--out", tmp_path / "out")
    refused(ran, "neither a screen", "in a terminal", "--headless")


def test_board_is_printed_to_true_scale_or_refused(bench_file, tmp_path):
    board = bench_file.parent / "board.yaml"
    for name, start in (("board.pdf", b"%PDF"), ("board.svg", b"<?xml")):
        ran = calibrate("board", board, "--out", tmp_path / name, "--paper", "A3")
        assert ran.code == 0
        assert "100 %" in ran.out
        assert (tmp_path / name).read_bytes().startswith(start)
    refused(calibrate("board", board, "--out", tmp_path / "board.png"), ".pdf or .svg")
    refused(calibrate("board", board, "--out", tmp_path / "none" / "board.pdf"), "none/board.pdf")
    large = Path(__file__).parents[2] / "configs" / "boards" / "charuco_12x9_20mm.yaml"
    refused(calibrate("board", large, "--out", tmp_path / "small.pdf", "--paper", "A4"), "A3")
    refused(calibrate("board", tmp_path / "none.yaml", "--out", tmp_path / "b.pdf"), "none.yaml")
    assert not (tmp_path / "small.pdf").exists()
