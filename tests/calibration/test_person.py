"""A person at a simulated bench, led by the window alone: from the first step to the certificate."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from requirements import require

from calibration.folder import RIG, read_steps
from calibration.guide.guidance import Guidance
from calibration.guide.window import GuideWindow
from calibration.looking import Looking, glimpsed
from calibration.operators import Answer, Outcome, StoppedError
from calibration.person import PersonOperator
from calibration.settings import CalibrationSettings
from calibration.work import StepFailedError
from drivers import FrameFormat
from scanner.config import load_config
from scanner.rig import Rig
from scanner.terminal import Terminal

SESSION = """
import json, sys
from pathlib import Path
from hands import person
from calibration.wizard import begin, run_steps
from drivers import OperatorError

config, out, days = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])
told = []
with person((1280, 800)) as hand:
    for presses in days:
        hand.comes({int(number): key for number, key in presses.items()})
        try:
            with begin(config, {"calibration.geometry.poses": 4}, out, quiet=True) as work:
                ended = run_steps(work)
        except OperatorError as error:
            ended = error.exit_code
        seen = [
            (g.step, g.title, g.zone is not None, g.curve is not None, [bar.label for bar in g.bars], g.nearness)
            for g in hand.shown
        ]
        kept = len(list((out / "poses").glob("pose-*.npz")))
        told.append({"ended": ended, "kept": kept, "decisions": hand.decisions, "seen": seen})
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def led(bench_file, tmp_path_factory):
    """A person who stops in the geometry, comes back, skips a pose, takes one back, and finishes."""
    require(shutil.which("Xvfb"), "the guide's window needs Xvfb: apt install xvfb")
    out = tmp_path_factory.mktemp("person") / "calibration"
    root = Path(__file__).parents[2]
    # Each of the four steps before is a look and a result: decision 8 is the first pose, 10 the third.
    days = [{10: "q"}, {0: "s", 2: "b"}]
    done = subprocess.run(
        [sys.executable, "-c", SESSION, bench_file, out, json.dumps(days)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(root), str(root / "tests")])},
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out, *json.loads(done.stdout.splitlines()[-1])


def test_person_is_led_through_all_steps_and_may_leave_and_come_back(led, bench_file):
    out, first, second = led
    assert first["ended"] == 130
    steps = [step for step, _, _ in first["decisions"]]
    assert steps == [s for s in ("focus", "exposure", "latency", "response") for _ in "12"] + ["geometry"] * 3
    assert first["kept"] == 2
    assert second["ended"] is True
    asked = [(title.split(" · ")[0], key) for step, title, key in second["decisions"] if step == "geometry"]
    assert asked[:4] == [("pose 3 of 4", "s"), ("pose 3 of 4", "space"), ("pose 4 of 4", "b"), ("pose 3 of 4", "space")]
    assert asked[4:] == [("pose 4 of 4", "space"), ("done", "space")]
    assert [step for step, _, _ in second["decisions"]][-2:] == ["acceptance", "acceptance"]
    assert list(read_steps(out)["steps"])[-1] == "acceptance"
    rig, true = Rig.load(out / RIG), load_config(bench_file, {}).bench_settings.rig()
    notes = rig.metadata["calibration"]
    sigma = notes["standard_uncertainty"][notes["parameters"].index("camera.fx")]
    assert abs(rig.camera.matrix[0, 0] - true.camera.matrix[0, 0]) < 4 * sigma
    assert sigma < 0.01 * true.camera.matrix[0, 0]


def test_screen_shows_what_each_step_needs(led):
    _, first, second = led
    seen = first["seen"] + second["seen"]
    magnified = {step for step, _, zone, *_ in seen if zone}
    assert magnified == {"focus"}
    curves = {(step, title) for step, title, _, curve, *_ in seen if curve}
    assert {("latency", "done"), ("response", "done")} <= curves
    result = next(bars for step, title, _, _, bars, _ in seen if (step, title) == ("geometry", "done"))
    assert {"camera: focal length", "projector: focal length", "baseline"} <= set(result)
    assert any("sharpness" in bar for step, _, _, _, bars, _ in seen if step == "focus" for bar in bars)
    counted = {title.split(":")[0] for _, title, _, _, bars, _ in seen if bars == [title]}
    assert {"latency", "response", "pose-01"} <= counted, "the window lives while pictures are taken"
    pose = [nearness for step, title, *_, nearness in second["seen"] if title.startswith("pose 3 of 4")]
    assert {"near", "far"} & set(pose), "the screen sees that the board is not there yet"


def test_live_search_finds_the_board_on_a_shrunk_picture(bench_file):
    """Corners of a drawn board against where they were drawn; a shrunk pixel is what a live picture may be off by."""
    from calibration.boards import load_board

    board = load_board(bench_file.parent / "board.yaml")
    px_per_mm, scale = 5, 2
    width, height = (round(px_per_mm * side) for side in board.size_mm)
    sheet = np.full((height, width), 230, np.uint8)
    square, first = board.square_mm * px_per_mm, np.array([width, height]) / 2 - (np.array([9, 6]) * 110) / 2
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            if (row + column) % 2 == 0:
                x, y = (first + np.array([column, row]) * square).astype(int)
                sheet[y : y + int(square), x : x + int(square)] = 20
    view = glimpsed(sheet, board)
    assert view is not None
    assert len(view.ids) == len(board.points)
    expected = board.points[view.ids, :2] * px_per_mm + np.array([width, height]) / 2 - 0.5
    assert np.abs(view.xy - expected).max() < 2 * scale
    assert view.sigma[0] == scale
    assert glimpsed(np.full((240, 320), 100, np.uint8), board) is None


def test_looks_are_at_the_newest_picture_and_do_not_hold_up_the_live_one():
    import threading

    may_go = threading.Event()

    def slow(frame):
        assert may_go.wait(10)
        return int(frame[0, 0])

    with Looking(slow) as looking:
        frame = np.zeros((2, 2), np.uint8)
        for number in range(5):
            frame[:] = number
            assert looking.at(frame) is None, "nothing is seen before the first look is over"
        may_go.set()
        seen = []
        while 7 not in seen:
            frame[:] = 7
            found = looking.at(frame)
            seen += [] if found is None else [found]
    assert set(seen) == {0, 7}, "what came while the first was looked at was not waited for"


class Screen(GuideWindow):
    """A window that nobody sees: gives one list of keys after the other."""

    def __init__(self, *keys):
        self.keys, self.shown, self.flashes = list(keys), [], []

    def show(self, guidance):
        self.shown.append(guidance)
        return self.keys.pop(0)

    def flash(self, good, text):
        self.flashes.append((good, text))


def before(screen):
    """A person who has already seen a picture on a screen."""
    settings = CalibrationSettings(board="board.yaml")
    operator = PersonOperator(settings, None, Terminal(quiet=True))
    operator._guide = screen
    frame = np.zeros((24, 32), np.uint8)
    operator._shown = Guidance("focus", "title", "do this", frame, FrameFormat(32, 24, 8), True)
    return operator


def test_fault_is_shown_with_its_remedy_until_it_is_mended_or_the_person_leaves():
    fault = StepFailedError("focus: edges are 9 px wide", "Turn the ring.")
    # The first keys were typed before the fault could be read.
    for keys, mended in (((["space"], [], ["space"]), True), ((["q", "space"], ["x"], ["q"]), False)):
        screen = Screen(*keys)
        assert before(screen).again("focus", fault, "try again") is mended
        assert screen.flashes == [(False, "focus: not yet")]
        assert screen.shown[-1].hints == ("Turn the ring.",)
        assert "9 px wide" in screen.shown[-1].instruction
        assert ("space", "try again") in screen.shown[-1].keys
    assert PersonOperator.again(before(None), "focus", fault, "try again") is False, "nobody has seen a screen yet"


def test_results_are_read_before_it_goes_on():
    screen = Screen([], [], ["space"])
    before(screen).learn(Outcome("focus", "all is sharp", ("a warning",)))
    assert screen.shown[-1].instruction == "all is sharp"
    assert screen.shown[-1].hints == ("a warning",)
    with pytest.raises(StoppedError):
        before(Screen([], ["q"])).learn(Outcome("focus", "all is sharp"))


def test_captures_can_be_stopped_from_the_window_and_other_keys_do_nothing():
    screen = Screen(["space", "b"], ["q"])
    operator = before(screen)
    operator.wait("pose-03: frame", 30, 30)
    assert screen.shown[-1].bars[0].share == 1
    with pytest.raises(StoppedError, match="stopped"):
        operator.wait("pose-03: frame", 30, 30)


class Still:
    """A bench before which nothing happens."""

    projector_size, frame_format, simulated = (16, 10), FrameFormat(32, 24, 8), True

    def __init__(self):
        self.levels, self.is_dark = [], False

    def prepare(self, pictures):
        self.levels.append(int(pictures[0][0, 0]))

    def expose(self, index, out):
        out[:] = min(self.levels[-1], 255)

    def darken(self):
        self.is_dark = True

    def describe(self):
        return {}


def test_keys_typed_before_a_picture_was_seen_are_forgotten_and_light_follows_the_arrows():
    bench = Still()
    screen = Screen(["space"], ["up"], ["down", "down"], [], ["space"])
    assert before(screen).place(bench, "Place the ball.", {}) is Answer.TAKE
    assert bench.levels == [160, 255, 160, 80]
    assert bench.is_dark
    assert any("too bright" in hint for hint in screen.shown[2].hints), "white saturates this camera"
    assert screen.shown[-1].hints == ()
    assert before(Screen([], ["q"])).place(Still(), "Place the ball.", {}) is Answer.STOP
