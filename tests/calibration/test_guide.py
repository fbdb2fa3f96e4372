"""The guide of the calibration: what is drawn against arithmetic, its window against what the X server shows."""

from __future__ import annotations

import io
import math
import os
import pickle
import pty
import select
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from desktop import Desktop
from requirements import require
from rich.console import Console
from scipy.spatial.transform import Rotation
from windows import within

from calibration.guide import lines as guide_lines
from calibration.guide.canvas import LEAST_SIZE, compose, draw, flashed, letters_of, picture_area
from calibration.guide.guidance import STEPS, Bar, Curve, Guidance, coverage
from calibration.guide.lines import GuideLines
from calibration.guide.maps import CELLS, ENOUGH_POINTS, draw_coverage, draw_depths, draw_tilts
from calibration.guide.sheet import Box, Sheet
from calibration.guide.window import GuideError, GuideWindow, guide_for
from calibration.observations import BoardView
from drivers import FrameFormat
from scanner.preview.measures import read_frame
from scanner.preview.style import BAD, GOOD, GROUND, TRACK, ZONE, font

SIZES = [(800, 600), (1024, 768), (1280, 800), (1280, 1024), (1920, 1080)]
FMT = FrameFormat(640, 512, 8)
TARGET = np.array([(100.0, 80.0), (300.0, 60.0), (320.0, 230.0), (90.0, 200.0)])
LONG = (
    "Hold the board nearer to the camera in the upper left of its picture with the right edge turned towards you by "
    "about a quarter of a right angle, print upright, and keep your fingers off the white margin until the tone"
)


def guidance(**changes):
    frame = np.full(FMT.shape, 90, np.uint8)
    values = {"step": "geometry", "title": "pose 6 of 10", "instruction": "Hold the board nearer, upper left"}
    return Guidance(**values | {"frame": frame, "frame_format": FMT, "simulated": True} | changes)


def view(xy):
    return BoardView(np.arange(len(xy)), np.asarray(xy, float), np.full(len(xy), 0.1))


def full(instruction="Hold the board nearer, upper left"):
    """Guidance with everything there is to show."""
    rng = np.random.default_rng(1)
    held = TARGET + np.array((150, 120))
    return guidance(
        instruction=instruction,
        view=view(rng.uniform(0, 500, (88, 2))),
        target=TARGET,
        outline=held,
        seen=rng.uniform(0, 512, (300, 2)),
        tilts=rng.uniform(-40, 40, (5, 2)),
        held_tilt=(5.0, 2.0),
        wanted_tilt=(-25.0, 20.0),
        distances_mm=rng.uniform(500, 700, 5),
        held_distance_mm=640.0,
        wanted_distance_mm=520.0,
        bars=tuple(
            Bar(name, 0.6, good, "± 0.048 %, wanted 0.03 %")
            for name, good in (("camera focal length", True), ("projector focal length", False), ("baseline", True))
        ),
        reading=read_frame(np.full(FMT.shape, 90, np.uint8), FMT, 0.02),
        hints=("2.3 % of the paper is saturated: shorten the exposure or close the aperture by one stop",),
        keys=(("space", "take it"), ("s", "skip"), ("b", "back"), ("q", "stop; resume later")),
    )


def is_colour(pixels, colour, tolerance=30):
    return np.abs(pixels.astype(int) - colour).max(axis=-1) <= tolerance


@pytest.mark.parametrize("size", SIZES)
def test_ghost_and_its_first_corner_are_where_the_target_is(size):
    canvas = draw(guidance(target=TARGET), size)
    assert canvas.shape == (size[1], size[0], 3)
    box = picture_area(FMT, size)
    assert box.width / box.height == pytest.approx(640 / 512, rel=0.005)
    scale = box.width / 640
    places = (TARGET + 0.5) * scale - 0.5 + (box.left, box.top)
    for column, row in places:
        near = canvas[round(row) - 1 : round(row) + 2, round(column) - 1 : round(column) + 2]
        assert is_colour(near, ZONE).any(), "a corner of the ghost is not where it should be"
    # A little inside of a corner the ghost is translucent, and full only in the wedge of the first.
    inside = places + 0.05 * (places.mean(axis=0) - places) * 2
    full = [is_colour(canvas[round(row), round(column)], 0.8 * np.array(ZONE) + 0.2 * 90, 40) for column, row in inside]
    assert full == [True, False, False, False]
    outside = np.ones(canvas.shape[:2], bool)
    outside[round(places[:, 1].min()) - 4 : round(places[:, 1].max()) + 5] = False
    outside[:, box.right :] = False
    outside[: box.top] = outside[round(box.bottom - 0.15 * size[1]) :] = False
    assert (canvas[outside] == 90).all(), "the frame is shown as it is where nothing is drawn over it"


@pytest.mark.parametrize("size", SIZES)
def test_points_of_the_board_are_drawn_where_they_are_found(size):
    xy = np.array([(400.0, 300.0), (500.5, 110.25)])
    box = picture_area(FMT, size)
    canvas = draw(guidance(view=view(xy)), size)
    drawn = (canvas[box.top : box.bottom, : box.width] != 90).any(axis=2)
    for x, y in (xy + 0.5) * (box.width / 640) - 0.5:
        rows, columns = np.nonzero(drawn[int(y) - 12 : int(y) + 13, int(x) - 12 : int(x) + 13])
        assert columns.mean() + int(x) - 12 == pytest.approx(x, abs=0.5)
        assert rows.mean() + int(y) - 12 == pytest.approx(y, abs=0.5)


@pytest.mark.parametrize("tilt", [(20.0, -10.0), (-35.0, 5.0), (0.0, 40.0)])
def test_tilt_map_shows_where_the_front_looks(tilt):
    sheet = Sheet((260, 240))
    box = Box(10, 20, 201, 201)
    draw_tilts(sheet, box, guidance(tilts=np.array([tilt])), 12)
    rows, columns = np.nonzero(is_colour(sheet.pixels, GOOD, 3))
    middle = np.array((columns.mean() - 110, rows.mean() - 120))
    expected = np.array((-tilt[0], tilt[1])) / 50 * 100  # ± 50° across ± 100 px
    np.testing.assert_allclose(middle, expected, atol=0.7)
    # The same side as the normal of a print that faces the camera at zero: -z, by R = Rx(pitch) Ry(yaw).
    normal = Rotation.from_euler("XY", (tilt[1], tilt[0]), degrees=True).apply((0.0, 0.0, -1.0))
    assert np.sign(np.round(normal[:2], 6)).tolist() == np.sign(expected).tolist()


def test_depth_strip_has_the_far_end_above():
    sheet = Sheet((100, 400))
    draw_depths(
        sheet, Box(20, 40, 24, 321), guidance(distances_mm=np.array([700.0]), depth_range_mm=(400.0, 800.0)), 12
    )
    rows = np.flatnonzero(is_colour(sheet.pixels[:, 32], GOOD, 3))
    assert rows.mean() == pytest.approx(40 + 80, abs=0.5)  # a quarter of 320 px from the far end


def test_coverage_counts_points_by_cell():
    rng = np.random.default_rng(2)
    seen = rng.uniform(-50, 700, (400, 2))
    counted = np.zeros((6, 8), int)
    for x, y in seen:
        across, down = math.floor((x + 0.5) / 80), math.floor((y + 0.5) / (512 / 6))
        if 0 <= across < 8 and 0 <= down < 6:
            counted[down, across] += 1
    assert CELLS == (8, 6)
    np.testing.assert_array_equal(coverage(seen, FMT, CELLS), counted)
    corner = np.full((ENOUGH_POINTS, 2), 3.0)
    sheet = Sheet((160, 128))
    draw_coverage(sheet, Box(0, 0, 160, 128), guidance(seen=corner))
    brightest = sheet.pixels[..., 1].astype(int)
    assert (brightest[2:20, 2:19] > 120).all()
    assert (brightest[:, 21:] < 60).all()


def boxes_of(sheet):
    """Boxes (left, top, right, bottom) that the ink of each line of text covers."""
    found = []
    for word in sheet.words:
        left, top, right, bottom = font(word.points, bold=word.bold).getbbox(word.text)
        found.append((word.left + left, word.top + top, word.left + right, word.top + bottom))
    return found


CURVE = Curve("response of projector and camera", np.arange(9.0), np.arange(9.0) ** 2, "projected", "camera grey value")
CONTENTS = {
    "everything": full(),
    "long": replace(
        full(LONG + ", " + LONG),
        title=LONG,
        hints=(LONG, LONG, "/a/path/without/any/space/" * 8),
        keys=tuple((key, f"{what} and what else there is to say") for key, what in full().keys),
        bars=full().bars * 3 + (Bar(LONG, 2.0, True, LONG),),
    ),
    "nothing": guidance(simulated=False),
    "unseen": guidance(target=TARGET, hints=(LONG,)),
    "focus": guidance(
        step="focus",
        zone=(slice(128, 384), slice(160, 480)),
        reading=full().reading,
        bars=full().bars,
        keys=(*full().keys, ("n", "best anew"), ("m", "another part"), ("c", "camera")),
    ),
    "upright camera": replace(full(), frame_format=FrameFormat(240, 640, 8), frame=np.full((640, 240), 90, np.uint8)),
    "response": guidance(step="response", curve=CURVE, bars=(Bar("gamma", math.nan, True, "2.2"),), hints=(LONG,)),
    "constant": guidance(step="latency", curve=replace(CURVE, y=np.full(9, 0.25), fitted=np.full(9, math.nan))),
}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("content", CONTENTS)
def test_no_text_leaves_its_place_or_runs_into_another(content, size):
    shown = CONTENTS[content]
    sheet = compose(shown, size)
    boxes = boxes_of(sheet)
    picture = picture_area(shown.frame_format, size)
    assert picture.right < 0.75 * size[0]
    for (left, top, right, bottom), word in zip(boxes, sheet.words, strict=True):
        assert left >= 0, word
        assert top >= 0, word
        assert right <= size[0] - 2, word
        assert bottom <= size[1], word
        if picture.top < top < picture.bottom:
            assert right <= picture.right or left >= picture.right, f"on the edge of the picture: {word}"
        if left > picture.right and picture.top < top < picture.bottom and word.points == letters_of(size):
            behind = sheet.pixels[top:bottom, left:right]
            assert (behind == GROUND).all(), f"on something else: {word}"
    for (one, a), (other, b) in combinations(zip(boxes, sheet.words, strict=True), 2):
        apart = one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
        assert apart or not (a.text and b.text), f"{a} runs into {b}"
    said = " ".join(word.text for word in sheet.words)
    assert ("SIMULATED DATA" in said) == shown.simulated
    assert all(step in said for step in STEPS)
    if content != "long":
        assert all(word in said for word in shown.instruction.split())
        assert all(what in said for _, what in shown.keys)


@pytest.mark.parametrize("size", [(640, 480), (400, 300), (120, 90), (3000, 500), (600, 1600)])
@pytest.mark.parametrize("content", CONTENTS)
def test_any_other_window_is_filled_as_far_as_it_goes(content, size):
    assert draw(CONTENTS[content], size).shape == (size[1], size[0], 3)


def test_instruction_is_read_from_two_metres():
    # A 24-inch screen of 1920 px is 531 mm wide; letters of a 200th of the distance, 10 mm, are read with ease.
    sheet = compose(full(), (1920, 1080))
    (points,) = {word.points for word in sheet.words if "board nearer" in word.text}
    _, top, _, bottom = font(points).getbbox("H")
    assert (bottom - top) * 531 / 1920 >= 10
    assert LEAST_SIZE == (800, 600)


def test_saturated_pixel_is_marked_and_darkness_is_not():
    frame = np.zeros(FMT.shape, np.uint8)
    frame[100, 200] = 255
    size = (800, 600)
    box = picture_area(FMT, size)
    picture = draw(guidance(frame=frame), size)[box.top : box.bottom, : box.width]
    red = (picture == (255, 0, 0)).all(axis=2)
    rows, columns = np.nonzero(red)
    assert rows.mean() == pytest.approx(100.5 * box.height / 512 - 0.5, abs=1)
    assert columns.mean() == pytest.approx(200.5 * box.width / 640 - 0.5, abs=1)
    assert (picture[~red] == 0).all()


def moved(shift=(0.0, 0.0), scale=1.0, turn_deg=0.0):
    """The outline from which this move leads to the target."""
    angle = math.radians(turn_deg)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = TARGET.mean(axis=0)
    return (TARGET - middle) @ turn / scale + middle - shift  # rows: the transpose is the inverse


@pytest.mark.parametrize(
    ("outline", "words", "nearness"),
    [
        (moved(), (), "there"),
        (moved(shift=(6.4, 0)), (), "there"),
        (moved(shift=(64, 0)), ("right 10 %",), "near"),
        (moved(shift=(-64, -102.4)), ("up 20 %", "left 10 %"), "far"),
        (moved(scale=1.3), ("nearer",), "near"),
        (moved(scale=0.6), ("farther",), "far"),
        (moved(turn_deg=15), ("turn clockwise 15°",), "near"),
        (moved(turn_deg=-180), ("turn",), "far"),
        (None, (), "unseen"),
    ],
)
def test_moves_lead_from_the_outline_to_the_target(outline, words, nearness):
    shown = guidance(target=TARGET, outline=outline)
    assert len(shown.moves) == len(words)
    for move, word in zip(shown.moves, words, strict=True):
        assert move.startswith(word)
    assert shown.nearness == nearness


def test_tilt_counts_where_it_is_known():
    shown = guidance(target=TARGET, outline=TARGET, held_tilt=(0.0, 0.0), wanted_tilt=(25.0, -12.0))
    assert shown.moves == ("front to the left 25°", "front up 12°")
    assert shown.nearness == "near"
    assert replace(shown, held_tilt=(22.0, -9.0)).nearness == "there"


def badge_colour(shown):
    """Colour in the middle of the left of the badge's disc."""
    box, points = picture_area(FMT, (1280, 800)), 16
    radius, pad = 1.2 * points, 0.5 * points
    row, column = box.bottom - 2 * pad - radius, box.left + 2 * pad + 0.25 * radius
    return draw(shown, (1280, 800))[round(row), round(column)]


def test_badge_says_by_its_colour_how_near_the_board_is():
    assert is_colour(badge_colour(guidance(target=TARGET)), BAD, 3)
    assert is_colour(badge_colour(guidance(target=TARGET, outline=TARGET)), GOOD, 3)
    assert is_colour(badge_colour(guidance(board_wanted=True, view=view([(5, 5)]))), GOOD, 3)
    far = badge_colour(guidance(target=TARGET, outline=TARGET + 200))
    assert not is_colour(far, GOOD)
    assert not is_colour(far, GROUND)
    assert (badge_colour(guidance()) == 90).all(), "no badge where no board is asked for"


def test_bar_is_as_long_as_its_share():
    size = (1280, 800)
    for share, expected in ((0.0, 0.0), (0.25, 0.25), (1.0, 1.0), (7.0, 1.0), (-1.0, 0.0)):
        pixels = compose(guidance(bars=(Bar("baseline", share, True, ""),)), size).pixels
        panel = pixels[:, picture_area(FMT, size).right :]
        row = panel[is_colour(panel, TRACK, 0).any(axis=1) | is_colour(panel, GOOD, 0).any(axis=1)][0]
        filled, track = is_colour(row, GOOD, 0).sum(), is_colour(row, TRACK, 0).sum()
        assert filled / (filled + track) == pytest.approx(expected, abs=0.005)


def test_flash_frames_the_picture():
    picture = draw(full(), (800, 600))
    before = picture.copy()
    for good, colour in ((True, GOOD), (False, BAD)):
        shown = flashed(picture, good, "taken")
        edge = np.concatenate((shown[:15].reshape(-1, 3), shown[:, -15:].reshape(-1, 3), shown[300, :15]))
        assert (edge == colour).all()
        np.testing.assert_array_equal(shown[25:150, 25:-25], before[25:150, 25:-25])
    np.testing.assert_array_equal(picture, before)


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=200)


def test_lines_say_what_is_new_once(console, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(guide_lines.time, "monotonic", lambda: now[0])
    with GuideLines(console) as guide:
        for _ in range(5):
            assert guide.show(full()) == []
        said = console.file.getvalue()
        assert said.count("Hold the board nearer, upper left") == 1
        assert said.count("SIMULATED DATA · geometry · pose 6 of 10") == 1
        assert said.count("board seen, 88 points · ") == 1
        assert said.count("2.3 % of the paper") == 1
        assert "space take it · s skip" in said
        unseen = replace(full(), view=None, outline=None)
        guide.show(unseen)
        assert "no board seen" not in console.file.getvalue(), "at most one line a second"
        now[0] = 1.1
        guide.show(unseen)
        assert console.file.getvalue().count("no board seen") == 1
        guide.show(replace(unseen, instruction="Hold it farther away"))
        assert console.file.getvalue().count("no board seen") == 2
        guide.flash(True, "taken")
        guide.flash(False, "the board moved")
    said = console.file.getvalue()
    assert "✓ taken" in said
    assert "✗ the board moved" in said
    assert "\x1b" not in said


def test_lines_read_keys_of_a_terminal_without_waiting(console, monkeypatch):
    import termios

    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(slave)
        with GuideLines(console) as guide:
            assert guide.show(full()) == []
            os.write(master, b" S7\n\x1b[6~\x1b[5~\x1b[D\x1b[15~\xc3\xa4\x1b")
            expected = ["space", "s", "7", "space", "space", "b", "left", "q"]
            assert select.select([slave], [], [], 2)[0]
            assert guide.show(full()) == expected
        assert termios.tcgetattr(slave) == before
    os.close(master)


def test_without_a_screen_there_are_lines(console, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(GuideError) as caught:
        GuideWindow({})
    assert "DISPLAY" in caught.value.remedy
    assert isinstance(guide_for({}, console), GuideLines)
    assert "plain lines" in console.file.getvalue()


# Shows a guidance until x is pressed, and says which keys were.
SHOW = """
import pickle, sys, time
from pathlib import Path
from calibration.guide import window
from calibration.guide.window import GuideWindow

window.FLASH_S = 2.4  # long enough for whoever looks, on a busy machine too
guidance = pickle.loads(Path(sys.argv[1]).read_bytes())
document = {"projector": {"settings": {}, "screen": {"area_px": [0, 0, 500, 800]}}}
with GuideWindow(document) as guide:
    keys = []
    while "x" not in keys:
        keys = guide.show(guidance)
        if keys:
            print(*keys, flush=True)
        if "f" in keys:
            guide.flash(True, "taken")
        time.sleep(0.02)
"""


def test_window_shows_the_canvas_off_the_projected_part_and_gives_keys(tmp_path):
    from sim_backend.xserver import XServer

    require(shutil.which("Xvfb"), "the guide's window needs Xvfb: apt install xvfb")
    (tmp_path / "guidance").write_bytes(pickle.dumps(full()))
    # 1100 × 800 px are free of the projected part; the window takes 85 % of them in their middle.
    width, height, left, top = 935, 680, 500 + (1100 - 935) // 2, (800 - 680) // 2
    expected = draw(full(), (width, height))
    with XServer(1600, 800) as server:

        def shows(wanted):
            surface = server.surface()
            assert not surface[:, :500].any(), "what is projected was covered"
            return np.array_equal(surface[top : top + height, left : left + width], wanted)

        process = subprocess.Popen(
            [sys.executable, "-c", SHOW, tmp_path / "guidance"],
            env=server.environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            within(60, lambda: process.poll() is not None or shows(expected))
            assert process.poll() is None, process.communicate()[1]
            assert shows(expected), "the window shows what is drawn, to the pixel"
            desktop = Desktop(server.display, "calibrate")
            meanings = {"space": "space", "7": "7", "Return": "space", "Next": "space", "Prior": "b", "Escape": "q"}
            for key, meaning in meanings.items():
                desktop.press(key)
                assert process.stdout.readline().split() == [meaning]
            desktop.ask_to_close()
            assert process.stdout.readline().split() == ["q"]
            desktop.press("f")
            assert within(5, lambda: shows(flashed(expected, True, "taken"))), "a flash is seen"
            assert within(5, lambda: shows(expected)), "and goes"
            desktop.press("x")
            said, errors = process.communicate(timeout=60)
            assert process.returncode == 0, errors
            assert said.split() == ["f", "x"]
            assert within(10, lambda: not server.surface().any()), "the window is gone"
        finally:
            process.kill()
            process.communicate()
