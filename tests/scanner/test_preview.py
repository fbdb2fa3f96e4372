"""The live picture: its figures against arithmetic, its window against what the X server shows."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from itertools import pairwise

import cv2
import numpy as np
import pytest
from desktop import Desktop
from PIL import Image
from requirements import require
from scipy.ndimage import gaussian_filter

from drivers import DisplayLatency, FrameFormat, FrameTimeoutError
from scanner.config import ScanSection
from scanner.preview.canvas import draw, false_colours
from scanner.preview.lines import histogram_line, reading_line
from scanner.preview.live import Live, PreviewError, pattern_picture
from scanner.preview.measures import exposure_hint, focus_measure, read_frame
from scanner.preview.window import Area, projected_areas

EIGHT, TWELVE = FrameFormat(320, 240, 8), FrameFormat(320, 240, 12)


def fringe(omega, contrast=0.5, mean=1000.0, sigma_px=0.0):
    """(240, 320) cos fringes along x; a Gaussian blur of σ lowers their contrast by exp(-σ²ω²/2)."""
    x = np.arange(320)
    return np.tile(mean * (1 + contrast * math.exp(-((sigma_px * omega) ** 2) / 2) * np.cos(omega * x)), (240, 1))


def frame(values, rng=None, noise=0.0, fmt=TWELVE):
    noisy = values if rng is None else values + rng.normal(0, noise, values.shape)
    return np.clip(np.rint(noisy), 0, fmt.saturated_dn).astype(fmt.dtype)


@pytest.mark.parametrize("sigma_px", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("turned", [False, True])
def test_focus_of_a_blurred_fringe_is_the_analytic_one(sigma_px, turned):
    omega = 2 * np.pi / 16
    expected = 0.5 * math.sin(omega) * math.exp(-((sigma_px * omega) ** 2) / 2) / math.sqrt(2)
    picture = frame(fringe(omega, sigma_px=sigma_px))
    if turned:
        picture = np.ascontiguousarray(picture.T)
    assert focus_measure(picture, picture, 4095) == pytest.approx(expected, rel=0.01)


def test_focus_falls_with_blur_and_is_blind_to_noise_and_exposure():
    rng = np.random.default_rng(0)
    texture = 1000 * (1 + 0.2 * gaussian_filter(rng.normal(size=(240, 320)), 1.0) * 3)
    sharp_to_blurred = [gaussian_filter(texture, sigma) for sigma in (0, 0.7, 1, 1.5, 2, 3, 5, 8)]
    clean = [focus_measure(frame(t), frame(t), 4095) for t in sharp_to_blurred]
    assert all(a > 1.05 * b for a, b in pairwise(clean))
    # Noise of 5 % of the light has more gradient than the texture, and is not taken for it.
    noise = 50.0
    noisy = [focus_measure(frame(t, rng, noise), frame(t, rng, noise), 4095) for t in sharp_to_blurred]
    same = frame(sharp_to_blurred[4], rng, noise)
    assert focus_measure(same, same, 4095) > 1.4 * clean[4], "without its remedy noise would pass for sharpness"
    np.testing.assert_allclose(noisy, clean, rtol=0.1, atol=1e-3)
    assert focus_measure(frame(0.3 * texture), frame(0.3 * texture), 4095) == pytest.approx(clean[0], rel=0.01)


def test_focus_leaves_out_saturated_pixels():
    picture = frame(fringe(2 * np.pi / 16))
    expected = focus_measure(picture, picture, 4095)
    glints = picture.copy()
    glints[::12, 4::20] = 4095
    assert focus_measure(glints, glints, 4095) == pytest.approx(expected, rel=0.02)
    assert focus_measure(glints, glints, 65535) > 1.3 * expected, "the glints would count"
    assert math.isnan(focus_measure(np.full_like(picture, 4095), picture, 4095))
    assert math.isnan(focus_measure(np.zeros_like(picture), np.zeros_like(picture), 4095))


@pytest.mark.parametrize("fmt", [EIGHT, TWELVE])
def test_shares_and_counts_are_exact(fmt):
    full = fmt.saturated_dn
    picture = np.full((240, 320), full // 2, fmt.dtype)
    flat = picture.reshape(-1)
    flat[:137] = full
    flat[137:1000] = full - 1
    flat[1000:3000] = 1
    reading = read_frame(picture, fmt)
    assert reading.saturated == 137
    assert reading.saturated_share == 137 / 76800
    assert reading.dark_share == 2000 / 76800
    assert reading.mean == pytest.approx(picture.mean() / full)
    assert reading.brightest == pytest.approx(np.quantile(picture, 0.995, method="inverted_cdf") / full)
    assert reading.histogram.sum() == pytest.approx(1)
    assert reading.histogram[-1] == pytest.approx(1000 / 76800)
    assert reading.histogram[0] == pytest.approx(2000 / 76800)
    assert reading.histogram[31] == pytest.approx((76800 - 3000) / 76800)


def level(share, saturated=0.0):
    picture = np.full((100, 100), round(share * 255), np.uint8)
    picture.reshape(-1)[: round(saturated * 10_000)] = 255
    return read_frame(picture, FrameFormat(100, 100, 8))


@pytest.mark.parametrize(
    ("share", "saturated", "exposure_ms", "period_ms", "words"),
    [
        (0.63, 0.0, 18.0, None, ["at 63 % of full scale", "lengthen to 25.66 ms"]),
        (0.85, 0.0, 18.0, None, ["at 85 %", "good"]),
        (0.30, 0.001, 20.0, None, ["lengthen to 60"]),  # a few glints say nothing about the rest
        (0.60, 0.10, 20.0, None, ["10.0 % of the pixels are saturated", "shorten to 10 ms"]),
        # Whole periods of the projector only: 25 ms would be right, 33.3 would saturate.
        (0.60, 0.0, 16.667, 16.667, ["open the aperture", "1.5 ×", "16.67 ms"]),
        (0.30, 0.0, 16.667, 16.667, ["lengthen to 50 ms"]),
        (0.60, 0.10, 33.333, 16.6665, ["shorten to 16.67 ms"]),
        (0.60, 0.10, 16.667, 16.667, ["close the aperture", "0.5 ×"]),
        (0.45, 0.0, None, None, ["lengthen the exposure to 2 ×"]),
    ],
)
def test_exposure_hint(share, saturated, exposure_ms, period_ms, words):
    exposure_s, period_s = (None if v is None else v / 1000 for v in (exposure_ms, period_ms))
    said = exposure_hint(level(share, saturated), 0.02, exposure_s, period_s)
    for word in words:
        assert word in said


def test_pictures_are_the_levels_of_the_scan():
    scan = ScanSection(mean=0.45, amplitude=0.4)
    for name, grey in (("white", round(0.85 * 255)), ("grey", round(0.45 * 255)), ("black", round(0.05 * 255))):
        picture = pattern_picture(name, scan, (64, 48))
        assert picture.shape == (48, 64)
        assert picture.dtype == np.uint8
        assert (picture == grey).all()
    fringes = pattern_picture("fringes", scan, (1280, 800))
    assert fringes.shape == (800, 1280)
    assert abs(int(fringes.min()) - 0.05 * 255) < 2
    assert abs(int(fringes.max()) - 0.85 * 255) < 2
    with pytest.raises(PreviewError, match="stripes"):
        pattern_picture("stripes", scan, (64, 48))


def test_live_takes_what_may_pass_again_and_raises_what_does_not(array_bench):
    failing = {13, 16}

    def on_expose(number, index):
        if number in failing:
            raise FrameTimeoutError("no frame within 2 s", "Check the trigger.")

    bench = array_bench(on_expose=on_expose)
    live = Live(bench, "white", ScanSection())
    live.begin()
    focus = [live.reading.focus]
    troubles = []
    while bench.exposures < 20:
        live.take()
        focus.append(live.reading.focus)
        troubles.append(live.trouble)
    assert sum("no frame within" in t for t in troubles) >= 1
    assert troubles[-1] == ""
    assert live.best_focus == max(focus)
    failing.update(range(bench.exposures, bench.exposures + 3))
    with pytest.raises(FrameTimeoutError):
        live.take()


def test_a_bench_that_waits_for_its_latency_can_be_previewed_before_it_is_measured(array_bench):
    bench = array_bench()
    told = []
    bench.latency, bench.use_latency, bench.measure_latency = None, told.append, None.__class__
    Live(bench, "white", ScanSection()).begin()
    assert told == [DisplayLatency(0.0, 0.0, 0)]


def test_focus_zone_follows_the_operator_and_stays_inside(array_bench):
    live = Live(array_bench(), "white", ScanSection())
    live.begin()
    for centre, rows, columns in (
        ((0.5, 0.5), slice(30, 90), slice(40, 120)),
        ((0.0, 0.0), slice(0, 60), slice(0, 80)),
        ((1.0, 0.9), slice(60, 120), slice(80, 160)),
    ):
        live.look_at(centre)
        assert live.zone == (rows, columns)
        assert math.isnan(live.best_focus)


def test_one_saturated_pixel_is_red_however_much_the_picture_shrinks():
    frame = np.full((1024, 1280), 2000, np.uint16)
    frame[517, 733] = 4095
    shown = false_colours(frame, FrameFormat(1280, 1024, 12), (320, 256))
    red = (shown == (255, 0, 0)).all(axis=2)
    assert red.sum() == 1
    assert red[517 // 4, 733 // 4]
    rest = shown[~red]
    assert (rest == round(2000 / 4095 * 255)).all()
    dark = np.zeros((64, 64), np.uint8)
    dark[:, 32:] = 5
    shown = false_colours(dark, FrameFormat(64, 64, 8), (128, 128))
    assert (shown[:, :64] == (0, 0, 160)).all()
    assert (shown[:, 64:] == (0, 0, 160)).all(), "5 of 255 is below 2 %"
    plain = false_colours(dark, FrameFormat(64, 64, 8), (128, 128), coloured=False)
    assert (plain[:, 64:] == 5).all()


@pytest.mark.parametrize("size", [(640, 480), (1280, 800), (1000, 2000), (4000, 700)])
def test_canvas_fits_any_window(array_bench, size):
    live = Live(array_bench(), "white", ScanSection())
    live.begin()
    canvas = draw(live, size, note="frozen")
    assert canvas.shape == (size[1], size[0], 3)
    assert canvas.dtype == np.uint8


def test_lines_for_terminals(array_bench):
    live = Live(array_bench(), "white", ScanSection())
    live.begin()
    line = reading_line(live)
    assert f"({live.reading.saturated} px)" in line
    assert "focus" in line
    shares = np.zeros(64)
    shares[0], shares[62:] = 0.75, 0.125
    assert histogram_line(shares, 4) == "█  ▅"  # sqrt(0.25 / 0.75) = 0.58, of eight blocks the fifth


def test_the_window_keeps_off_what_is_projected(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    desktop = Area(0, 0, 3200, 1080)
    assert desktop.without(Area(1920, 0, 1280, 800)) == [Area(0, 0, 1920, 1080), Area(0, 800, 3200, 280)]
    assert Area(0, 0, 1280, 800).without(Area(0, 0, 1280, 800)) == []
    assert desktop.without(Area(3200, 0, 10, 10)) == [desktop]
    screen = {"index": 1, "name": "HDMI-1", "area_px": [1920, 0, 1280, 800]}
    document = {"camera": {}, "projector": {"settings": {"display": None}, "screen": screen}}
    assert projected_areas(document) == [Area(1920, 0, 1280, 800)]
    inside = {"projector": {"chip": "DLPC350", "window": document["projector"]}}
    assert projected_areas(inside) == [Area(1920, 0, 1280, 800)]
    document["projector"]["settings"]["display"] = ":7"
    assert projected_areas(document) == [], "another X server is another desktop"


# A bench whose camera always sees the same; it writes down when it is darkened and closed.
BENCH = """
from contextlib import contextmanager
from pathlib import Path
import time
import numpy as np
from pydantic import BaseModel
from drivers import FrameFormat, FrameStamp, SystemClock

FRAME = np.full((120, 160), 100, np.uint8)
FRAME[2:6, 4:12] = 255
FRAME[110:118, 0:20] = 1
FRAME[:, 60] = 140

class Settings(BaseModel):
    log: str
    projected: list[int] = [0, 0, 1, 1]

class Still:
    name, simulated, rig, noise, projector_size = "still", True, None, None, (64, 48)
    frame_format, clock = FrameFormat(160, 120, 8), SystemClock()

    def __init__(self, settings):
        self.settings, self.count = settings, 0

    def say(self, word):
        with Path(self.settings.log).open("a") as log:
            log.write(word + "\\n")

    def prepare(self, patterns):
        self.say(f"prepared {len(patterns)} of {int(patterns[0].max())}")

    def expose(self, index, out):
        time.sleep(0.01)
        out[...] = FRAME
        self.count += 1
        return FrameStamp(self.count, 0.0, 0.0)

    def darken(self):
        self.say("dark")

    def describe(self):
        return {"projector": {"settings": {}, "screen": {"area_px": self.settings.projected}}}

class Kind:
    settings = Settings

    @contextmanager
    def open(self, settings):
        bench = Still(settings)
        try:
            yield bench
        finally:
            bench.say("closed")

kind = Kind()
"""
SCAN = [sys.executable, "-c", "from scanner.cli import main; main()"]


@pytest.fixture
def still(tmp_path):
    """Start a preview of the bench above; gives (start, log)."""
    info = tmp_path / "site" / "still-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: still\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text("[scanner.benches]\nstill = still:kind\n", encoding="utf-8")
    (tmp_path / "site" / "still.py").write_text(textwrap.dedent(BENCH).replace("\\\\n", "\\n"), encoding="utf-8")
    log = tmp_path / "log"
    processes = []

    def start(*args, projected=(0, 0, 1, 1), environment=None):
        text = f"bench: {{kind: still, log: {log}, projected: {list(projected)}}}\n"
        (tmp_path / "still.yaml").write_text(text, encoding="utf-8")
        process = subprocess.Popen(
            [*SCAN, "preview", "--config", "still.yaml", *args],
            cwd=tmp_path,
            env={**(environment or without_display()), "PYTHONPATH": str(tmp_path / "site")},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        return process

    yield start, lambda: log.read_text(encoding="utf-8").split("\n")[:-1] if log.exists() else []
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


def without_display():
    return {name: value for name, value in os.environ.items() if name != "DISPLAY"}


def wait_until(condition, patience_s=60.0):
    deadline = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.02)


def test_once_prints_a_reading_and_saves_the_picture(still, tmp_path):
    start, log = still
    process = start("--once", "--save", "picture.png", "--pattern", "grey")
    said, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "saturated 0.17 % (32 px)" in said
    assert log()[0] == "prepared 1 of 128"
    assert log()[-2:] == ["dark", "closed"]
    frame = cv2.imread(str(tmp_path / "picture-frame.png"), cv2.IMREAD_UNCHANGED)
    assert frame.shape == (120, 160)
    assert (frame == 255).sum() == 32
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.size == (1280, 800)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_preview_darkens_the_projector_and_ends_with_130(still, number):
    start, log = still
    process = start()
    assert "figures only" in process.stdout.readline()
    assert "saturated 0.17 % (32 px)" in process.stdout.readline()
    assert "dark" not in log()
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert log()[-2:] == ["dark", "closed"]


def test_bad_pattern_is_refused_by_name(still):
    start, log = still
    process = start("--pattern", "stripes")
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "white, grey, black, fringes" in errors
    assert log()[-2:] == ["dark", "closed"]


def test_window_shows_the_frame_beside_the_projected_part_and_obeys_keys(still, tmp_path):
    from sim_backend.xserver import XServer

    require(shutil.which("Xvfb"), "the preview window needs Xvfb: apt install xvfb")
    start, log = still
    with XServer(1500, 900) as server:
        process = start(projected=(0, 0, 400, 900), environment=server.environment())

        def picture():
            # 1100 × 900 px are free; the window takes 85 % of the width in their middle, and what its figures need.
            top, left, width = (900 - 640) // 2, 400 + (1100 - 935) // 2, 935
            surface = server.surface()
            assert not surface[:, :400].any(), "what is projected was covered"
            # 595 × 640 px beside the figures hold the frame three times as large.
            return surface[top : top + 360, left : left + 480], surface[top, left : left + width]

        def is_shown():
            with contextlib.suppress(AssertionError):
                return (picture()[0][3 * 50 + 1, 3 * 5] == 100).all()

        wait_until(is_shown)
        time.sleep(0.3)
        seen, line = picture()
        assert (line.max(axis=1) > 0).all(), "the window is as wide as it should be"
        grey = np.full((120, 160), 100, np.uint8)
        grey[:, 60] = 140
        expected = np.kron(np.repeat(grey[..., None], 3, axis=2), np.ones((3, 3, 1), np.uint8))
        expected[6:18, 12:36] = (255, 0, 0)
        expected[330:354, 0:60] = (0, 0, 160)
        outline = np.zeros((360, 480), bool)
        outline[3 * 30 : 3 * 90, 3 * 40 : 3 * 120] = True
        outline[3 * 30 + 1 : 3 * 90 - 1, 3 * 40 + 1 : 3 * 120 - 1] = False
        np.testing.assert_array_equal(seen[~outline], expected[~outline])

        desktop = Desktop(server.display, "scan preview")
        desktop.press("c")
        wait_until(lambda: (picture()[0][6:18, 12:36] == 255).all())
        desktop.press("s")
        wait_until(lambda: list(tmp_path.glob("preview-*-frame.png")))
        desktop.press("q")
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        assert log()[-2:] == ["dark", "closed"]
        assert not server.surface().any(), "the window is gone"
    (saved,) = tmp_path.glob("preview-*-frame.png")
    assert (cv2.imread(str(saved), cv2.IMREAD_UNCHANGED) == 255).sum() == 32


def test_window_is_moved_off_the_projected_part_where_a_window_manager_puts_it_there(still):
    from sim_backend.xserver import XServer

    require(shutil.which("Xvfb") and shutil.which("openbox"), "needs a window manager: apt install xvfb openbox")
    start, _ = still
    with XServer(1500, 900) as server:
        manager = subprocess.Popen(
            ["openbox", "--sm-disable"],
            env=server.environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            process = start(projected=(0, 0, 600, 900), environment=server.environment())

            def is_placed():
                surface = server.surface()
                return (surface[:, 600:] == (255, 0, 0)).all(axis=2).any() and not surface[:, :600].any()

            wait_until(is_placed)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
            assert process.returncode == 130, errors
        finally:
            manager.terminate()
            manager.wait(5)
