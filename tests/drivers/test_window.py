"""The projector window under Xvfb; what it shows is read from the X server's own frame buffer."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from desktop import Desktop
from windows import OneWindow, require_display, settings_for, within

from drivers import DeviceNotFoundError, DeviceSettingError, DeviceState, MissingLibraryError, SystemClock
from drivers.window import WindowProjector, WindowSettings, projector
from sim_backend.xserver import XServer

SIZE = 131, 97


class Shifted(SystemClock):
    """The clock of a bench that is not the machine's."""

    def now(self):
        return super().now() + 1000.0


CLOCK = Shifted()
PLAIN = {"refresh_hz": 50, "timer_phase_ms": 5, "clock": CLOCK}
PATCH = {"x_px": 100, "y_px": 10, "width_px": 20, "height_px": 5}
HELD = PLAIN | {"hold": 3, "sync_patch": PATCH}


@pytest.fixture(scope="module")
def server():
    require_display()
    with XServer(*SIZE) as server:
        yield server


@pytest.fixture(scope="module")
def one_window(server):
    window = OneWindow(server)
    yield window
    window.close()


@pytest.fixture
def window(one_window):
    """Make a configured window with changed settings."""

    def make(**changes):
        return one_window(**(changes or PLAIN))

    return make


def noise(count, *, seed=0, channels=()):
    return np.random.default_rng(seed).integers(0, 256, (count, SIZE[1], SIZE[0], *channels), np.uint8)


def codes(count):
    """Pictures of one grey value each: 1, 2, 3 …"""
    return [np.full((SIZE[1], SIZE[0]), number + 1, np.uint8) for number in range(count)]


class Sampler:
    """Looks at some pixels of the surface a thousand times a second; ``runs`` is what it has seen, each change once.

    ``times`` says when each was first seen, ``former`` when the one before was last seen; ``longest_s`` is the longest
    time it did not look, since the machine did something else.
    """

    def __init__(self, server, *pixels):
        self._views = [server.channel()[y, x : x + 1] for x, y in pixels]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self.runs = []
        self.times = []
        self.former = []
        self.longest_s = 0.0

    def _look(self):
        last = time.monotonic()
        while not self._stop.wait(1e-3):
            before = time.monotonic()
            seen = tuple(int(view[0]) for view in self._views)
            after = time.monotonic()
            if not self.runs or seen != self.runs[-1]:
                self.runs.append(seen)
                self.times.append(after)
                self.former.append(last)
            self.longest_s = max(self.longest_s, after - last)
            last = before

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        time.sleep(0.02)
        self._stop.set()
        self._thread.join()


def played_under_watch(device, server, *pixels):
    """Play what is loaded, again where the machine was too busy for a look at each picture; (record, sampler)."""
    for _ in range(10):
        with Sampler(server, *pixels) as sampler:
            device.play()
            record = device.finish(20.0)
        if sampler.longest_s < device.period_s - 0.01:
            return record, sampler
        device.darken()
    raise AssertionError("this machine is never quiet for as long as a sequence takes")


def test_every_pixel_after_many_shows(window, server):
    device, pictures = window(), noise(12)
    device.load(pictures)
    for index in np.random.default_rng(1).integers(0, 12, 60):
        device.show(int(index))
        assert np.array_equal(server.surface(), np.repeat(pictures[index][..., None], 3, axis=2))


def test_pictures_of_three_channels_and_grey_ones_in_one_sequence(window, server):
    device = window()
    packed, grey = noise(2, channels=(3,)), noise(1)
    device.load([packed[0], grey[0], packed[1]])
    for index, expected in enumerate((packed[0], grey[0][..., None], packed[1])):
        device.show(index)
        assert np.array_equal(server.surface(), np.broadcast_to(expected, (SIZE[1], SIZE[0], 3)))


def test_time_stamps_are_on_the_clock_of_the_bench(window):
    device = window()
    device.load(codes(2))
    before = CLOCK.now()
    shown = device.show(0)
    device.play()
    played = device.finish(5.0).shown_s
    assert before < shown < played[0] < played[1] < CLOCK.now()


def test_refuses_more_than_its_memory_limit(window):
    picture = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    with pytest.raises(DeviceSettingError, match="170000 pictures fill 2060 MiB, allowed are 2048"):
        window().load([picture] * 170_000)


def test_an_empty_sequence_is_played_at_once(window):
    device = window()
    device.load([])
    device.play()
    assert device.finish(1.0).shown_s == ()


def test_says_who_and_where_it_is(window, server):
    device = window()
    device.load(codes(3))
    device.show(1)
    former = device.describe()["counts"]
    device.play()
    device.finish(5.0)
    said = json.loads(json.dumps(device.describe()))
    assert said["screen"] == {"index": 0, "name": "screen", "area_px": [0, 0, *SIZE], "mode_hz": None}
    assert said["settings"]["display"] == server.display
    assert former["shown"] >= 1
    assert said["counts"]["played"] - former["played"] == 3
    assert said["timing"]["flip_s"] > 0
    assert said["simulated"] is False
    assert "." in said["renderer"]
    assert said["warnings"] == []


@pytest.mark.parametrize("lit", ["green", "blue"])
def test_one_channel_lights_no_other(window, server, lit):
    device, pictures = window(channels=lit), noise(12)
    device.load(pictures)
    for index in np.random.default_rng(1).integers(0, 12, 30):
        device.show(int(index))
        expected = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        expected[..., ("red", "green", "blue").index(lit)] = pictures[index]
        assert np.array_equal(server.surface(), expected)
    with pytest.raises(DeviceSettingError, match=r"picture 0 is uint8 \(97, 131, 3\), not uint8 \(97, 131\)"):
        device.load(noise(1, channels=(3,)))


def test_plays_each_picture_once_in_order_at_the_times_it_says(window, server):
    device = window(**HELD)
    device.load(codes(20))
    record, sampler = played_under_watch(device, server, (0, 0), (SIZE[0] - 1, SIZE[1] - 1))
    assert len(record.shown_s) == 20
    for corner in (0, 1):
        seen = [run[corner] for run in sampler.runs]
        changes = [value for value, former in zip(seen[1:], seen, strict=False) if value != former]
        assert changes == list(range(1, 21))
    both = np.array([run[0] == run[1] != 0 for run in sampler.runs])
    shown_s = np.array(record.shown_s) - 1000.0
    # The server copies before the swap is reported, soon before; others share the machine.
    assert (shown_s > np.array(sampler.former)[both]).all()
    assert np.median(shown_s - np.array(sampler.times)[both]) < 5e-3
    # Flips are at the multiples of a refresh, plus the phase.
    assert np.median(np.mod(shown_s - 0.005, 1 / 50)) < 8e-3


def test_holds_pictures_and_toggles_the_patch(window, server):
    device = window(**HELD)
    device.load([np.full((SIZE[1], SIZE[0]), value, np.uint8) for value in (50, 50, 60, 60, 70)])
    assert device.period_s == pytest.approx(0.06)
    assert device.refresh_s == pytest.approx(0.02)
    record, sampler = played_under_watch(device, server, (0, 0), (100, 10))
    # Back to black at the end, so that the next sequence begins with a rising edge again.
    assert sampler.runs[-6:] == [(50, 255), (50, 0), (60, 255), (60, 0), (70, 255), (70, 0)]
    assert (np.diff(record.shown_s) > 0.04).all()
    expected = np.full((SIZE[1], SIZE[0]), 70, np.uint8)
    expected[10:15, 100:120] = 0
    assert np.array_equal(server.channel(), expected)
    device.show(4)
    assert np.array_equal(server.channel(), expected)
    device.darken()
    assert not server.surface().any()


def test_long_sequences_pass_through_a_small_memory(window, server, monkeypatch):
    monkeypatch.setattr(projector, "_STAGED_BYTES", 5 * SIZE[0] * SIZE[1])
    device, pictures = window(hold=2), noise(216)
    assert not Path("/dev/shm", device._staging.name.strip("/")).exists()
    device.load(pictures)
    for index in (0, 4, 5, 99, 214, 215):
        device.show(index)
        assert np.array_equal(server.channel(), pictures[index])


def test_warns_of_what_it_cannot_rule_out(one_window, server, monkeypatch):
    one_window.close()
    monkeypatch.setenv("DISPLAY", server.display)
    monkeypatch.setenv("XDG_SESSION_TYPE", "wayland")
    subprocess.run(["xrandr", "-display", server.display, "--newmode", "60", *MODE_60], check=True)
    subprocess.run(["xrandr", "-display", server.display, "--addmode", "screen", "60"], check=True)
    subprocess.run(["xrandr", "-display", server.display, "--output", "screen", "--mode", "60"], check=True)
    try:
        warnings = one_window(display=None).describe()["warnings"]
    finally:
        one_window.close()
        subprocess.run(["xrandr", "-display", server.display, "--output", "screen", "--mode", "131x97"], check=True)
    assert any("Wayland" in warning for warning in warnings)
    assert any("pacing timer on a screen with a refresh of its own" in warning for warning in warnings)
    assert len(warnings) == 2


# A mode of 131 × 97 px with 200 × 100 px in all at 1.2 MHz: 60 Hz.
MODE_60 = ["1.2", "131", "140", "150", "200", "97", "98", "99", "100"]


def test_no_display_is_a_clear_error(monkeypatch):
    require_display()
    monkeypatch.delenv("DISPLAY", raising=False)
    device = WindowProjector(WindowSettings(width_px=8, height_px=8), SystemClock())
    with pytest.raises(DeviceNotFoundError, match=r"DISPLAY is not set") as caught:
        device.open()
    assert "display: ':0'" in caught.value.remedy
    assert device.state is DeviceState.CLOSED
    assert device.pid is None


def test_no_opengl_is_a_clear_error(one_window, server, monkeypatch):
    one_window.close()
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", "/nonexistent")
    device = WindowProjector(settings_for(server), SystemClock())
    with pytest.raises(MissingLibraryError, match="apt install libgl1 libglx-mesa0 libgl1-mesa-dri"):
        device.open()
    assert device.pid is None


def test_missing_pyglet_is_a_clear_error(server, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyglet", None)
    with pytest.raises(MissingLibraryError, match="pip install 'pyglet"):
        projector.serve_window(lambda message: None, settings_for(server))


def test_another_system_is_a_clear_error(server, monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(MissingLibraryError, match="this is darwin"):
        projector.serve_window(lambda message: None, settings_for(server))


def test_naming_the_driver_loads_no_graphics():
    program = "import sys, drivers.window; print([m for m in sys.modules if m.split('.')[0] == 'pyglet'])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_keeps_the_screen_saver_away(one_window, server):
    saver = ["xset", "-display", server.display, "s"]
    subprocess.run([*saver, "1", "1"], check=True)
    try:
        with Desktop(server.display) as desktop:
            one_window()
            assert not within(2.5, desktop.screen_saver_is_on)
            one_window.close()
            # Without the window it comes.
            assert within(15.0, desktop.screen_saver_is_on)
    finally:
        subprocess.run([*saver, "reset"], check=True)
        subprocess.run([*saver, "off"], check=True)
