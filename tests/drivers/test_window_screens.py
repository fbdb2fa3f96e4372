"""Which screens there are and where the window comes up: X servers with several monitors, a window manager too."""

import shutil
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from desktop import Desktop
from pydantic import ValidationError
from requirements import require
from windows import PACKAGES, OneWindow, require_display, settings_for, within

from drivers import DeviceLostError, DeviceNotFoundError, DeviceSettingError, SystemClock
from drivers.window import Screen, WindowProjector, WindowSettings, list_screens
from drivers.window.screens import choose_screen
from sim_backend.xserver import Area, XServer

WIDTH, HEIGHT = 360, 120
MONITORS = {"desk": Area(0, 0, 160, HEIGHT), "beam": Area(160, 0, 200, HEIGHT)}


@pytest.fixture(scope="module")
def server():
    require_display()
    require(shutil.which("xrandr"), f"xrandr is not installed: {PACKAGES}")
    with XServer(WIDTH, HEIGHT, monitors=MONITORS) as server:
        yield server


@contextmanager
def window_manager(server, tmp_path, rule=""):
    require(shutil.which("openbox"), "openbox is not installed: apt install openbox")
    configuration = tmp_path / "rc.xml"
    configuration.write_text(
        '<?xml version="1.0"?><openbox_config xmlns="http://openbox.org/3.4/rc">'
        f"<applications>{rule}</applications></openbox_config>"
    )
    ready = tmp_path / "ready"
    program = subprocess.Popen(
        ["openbox", "--sm-disable", "--config-file", str(configuration), "--startup", f"touch {ready}"],
        env=server.environment() | {"XDG_CACHE_HOME": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert within(10.0, ready.exists)
        yield
    finally:
        program.terminate()
        program.wait()


def projector_on(server, name, **changes):
    area = MONITORS[name]
    size = {"width_px": area.width, "height_px": area.height}
    return WindowProjector(settings_for(server, **size, **{"screen": name} | changes), SystemClock())


def assert_fills(device, server, name):
    """Show noise and find it on that monitor, and nothing on the rest of the desktop."""
    area = MONITORS[name]
    picture = np.random.default_rng(3).integers(1, 256, (area.height, area.width), np.uint8)
    device.load([picture])
    device.show(0)
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    expected[:, area.x : area.x + area.width] = picture
    assert np.array_equal(server.channel(), expected)


@pytest.mark.parametrize(
    ("name", "screen", "fullscreen"), [("beam", "beam", True), ("beam", 1, False), ("desk", None, True)]
)
def test_comes_up_on_the_screen_that_is_meant(server, name, screen, fullscreen):
    device = projector_on(server, name, screen=screen, fullscreen=fullscreen)
    try:
        device.open()
        device.configure()
        assert device.describe()["screen"]["name"] == name
        assert_fills(device, server, name)
    finally:
        device.close()


MISPLACED = '<application title="projector"><position force="yes"><x>7</x><y>9</y></position></application>'


@pytest.mark.parametrize(
    ("name", "fullscreen", "rule"), [("beam", True, ""), ("desk", False, ""), ("beam", True, MISPLACED)]
)
def test_comes_up_there_under_a_window_manager(server, tmp_path, name, fullscreen, rule):
    device = projector_on(server, name, fullscreen=fullscreen)
    try:
        with window_manager(server, tmp_path, rule):
            device.open()
            device.configure()
            assert_fills(device, server, name)
            with Desktop(server.display) as desktop:
                # Only what the window manager puts in the wrong place is taken away from it.
                assert desktop.is_managed() == (fullscreen and not rule)
            device.close()
    finally:
        device.close()


def test_minimised_by_a_window_manager(server, tmp_path):
    one_window = OneWindow(server)
    try:
        with window_manager(server, tmp_path):
            device = one_window(screen="beam", width_px=200)
            assert_fills(device, server, "beam")
            with Desktop(server.display) as desktop:
                desktop.minimise()
                with pytest.raises(DeviceLostError, match="it was minimised or hidden"):
                    within(5.0, lambda: device.show(0) is None)
            device.close()
            device.open()
            device.configure()
            assert_fills(device, server, "beam")
            with Desktop(server.display) as desktop:
                desktop.move(0, 0)
                with pytest.raises(DeviceLostError, match="does not fill its screen any more"):
                    within(5.0, lambda: device.show(0) is None)
            one_window.close()
    finally:
        one_window.close()


def test_an_x_screen_of_its_own():
    require_display()
    with XServer(64, 48, screens=2) as server:
        device = WindowProjector(settings_for(server, display=f"{server.display}.1"), SystemClock())
        try:
            device.open()
            device.configure()
            picture = np.random.default_rng(4).integers(1, 256, (48, 64), np.uint8)
            device.load([picture])
            device.show(0)
            assert np.array_equal(server.channel(screen=1), picture)
            assert not server.surface(0).any()
        finally:
            device.close()


def test_screens_are_listed(server):
    screens, reason = list_screens(server.display)
    assert reason == ""
    assert [(screen.index, screen.name, screen.area) for screen in screens] == [
        (0, "desk", (0, 0, 160, 120)),
        (1, "beam", (160, 0, 200, 120)),
    ]
    assert str(screens[1]) == "1: beam 200 × 120 px at (160, 0), rate unknown"


def test_rates_and_grey_curves_are_listed():
    require_display()
    require(shutil.which("xrandr"), f"xrandr is not installed: {PACKAGES}")
    with XServer(WIDTH, HEIGHT) as server:

        def randr(*arguments):
            subprocess.run(["xrandr", "--display", server.display, *arguments], check=True)

        # 2.4 MHz in 400 × 100 px: 60 Hz; interlaced, half of the lines at a time.
        timing = ["2.4", "320", "340", "350", "400", "90", "92", "95", "100"]
        for name, flags, rate in (("60", [], 60.0), ("120i", ["Interlace"], 120.0)):
            randr("--newmode", name, *timing, *flags)
            randr("--addmode", "screen", name)
            randr("--output", "screen", "--mode", name)
            [screen] = list_screens(server.display)[0]
            assert screen.refresh_hz == pytest.approx(rate)
            assert (screen.width_px, screen.height_px) == (320, 90)
            assert not screen.scaled
            assert screen.gamma_linear
        randr("--output", "screen", "--gamma", "1:0.9:0.8", "--primary")
        [screen] = list_screens(server.display)[0]
        assert not screen.gamma_linear
        assert screen.primary
        randr("--output", "screen", "--gamma", "1:1:1")
        assert list_screens(server.display)[0][0].gamma_linear


def test_no_screens_come_with_a_reason(monkeypatch):
    require_display()
    assert list_screens(":4093")[0] == []
    assert "the X display :4093 cannot be opened" in list_screens(":4093")[1]
    monkeypatch.delenv("DISPLAY", raising=False)
    assert "DISPLAY is not set" in list_screens()[1]
    monkeypatch.setattr(sys, "platform", "darwin")
    assert list_screens()[0] == []
    assert "darwin" in list_screens()[1]


def screen(index, name, width, **changes):
    return Screen(index, name, 0, 0, width, 800, 60.0, **changes)


SCREENS = [screen(0, "eDP-1", 1920), screen(1, "HDMI-1", 1280), screen(2, "DP-2", 1280)]


def test_a_screen_is_chosen_by_number_name_or_size():
    assert choose_screen(SCREENS, 1, (1280, 800)).name == "HDMI-1"
    assert choose_screen(SCREENS, "DP-2", (1280, 800)).index == 2
    assert choose_screen(SCREENS, None, (1920, 800)).name == "eDP-1"


@pytest.mark.parametrize(
    ("wanted", "size", "said"),
    [
        ("HDMI-2", (1280, 800), "there is no screen named HDMI-2; known are: 0: eDP-1 1920 × 800 px at .*HDMI-1.*DP-2"),
        (7, (1280, 800), "there is no screen number 7; known are"),
        (None, (912, 1140), "there is no screen of 912 × 1140 px"),
        (None, (1280, 800), "there are 2 screens of 1280 × 800 px"),
    ],
)
def test_a_screen_that_is_not_there_names_those_that_are(wanted, size, said):
    with pytest.raises(DeviceNotFoundError, match=said):
        choose_screen(SCREENS, wanted, size)


@pytest.mark.parametrize(
    ("changes", "size", "said", "remedy"),
    [
        ({}, (1920, 1080), "shows 1280 × 800 px, not the projector's own 1920 × 1080", "--mode 1920x1080"),
        ({"scaled": True}, (1280, 800), "scaled on screen HDMI-1", "--scale 1"),
        ({"gamma_linear": False}, (1280, 800), "bends grey values on screen HDMI-1", "--gamma 1:1:1"),
    ],
)
def test_a_screen_that_would_change_pixels_is_refused(changes, size, said, remedy):
    with pytest.raises(DeviceSettingError, match=said) as caught:
        choose_screen([screen(0, "HDMI-1", 1280, **changes)], 0, size)
    assert remedy in caught.value.remedy


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"pacing": "timer"}, "pacing timer needs refresh_hz"),
        ({"sync_patch": {"x_px": 60, "y_px": 0, "width_px": 5, "height_px": 5}}, "does not lie within the picture"),
        ({"vsync": True}, "vsync"),
        ({"hold": 0}, "hold"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, said):
    with pytest.raises(ValidationError, match=said):
        WindowSettings.model_validate({"width_px": 64, "height_px": 48} | changes)
