"""What an operator, a desktop and a crash do to the projector window, done by another program on the same X server."""

import os
import shutil
import signal
import subprocess
import time

import locked_screen
import numpy as np
import psutil
import pytest
from desktop import Desktop
from requirements import require
from windows import OneWindow, require_display, settings_for, within

from drivers import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    SequenceFaultError,
    SystemClock,
)
from drivers.window import WindowProjector
from sim_backend.xserver import XServer

SIZE = 131, 97


@pytest.fixture(scope="module")
def server():
    require_display()
    with XServer(*SIZE) as server:
        yield server


def sequence(count=4):
    return [np.full((SIZE[1], SIZE[0]), 40 + 40 * (number % 4), np.uint8) for number in range(count)]


def prepare(device, count=4):
    device.open()
    device.configure()
    device.load(sequence(count))
    device.show(0)


@pytest.fixture(scope="module")
def one_window(server):
    window = OneWindow(server)
    yield window
    window.close()


@pytest.fixture
def device(one_window):
    """A window with four pictures, the first of them shown."""
    device = one_window()
    device.load(sequence())
    device.show(0)
    return device


def shown_until_it_fails(device, index, within_s=5.0):
    """Show a picture again and again: what happens to a window reaches its process a moment later."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        device.show(index)


def recover(device, server):
    """What a bench does with a lost device; seconds it took."""
    begin = time.monotonic()
    device.close()
    prepare(device)
    device.show(2)
    assert np.array_equal(server.channel(), sequence()[2])
    return time.monotonic() - begin


CLOSED = "it was closed"
HIDDEN = "it was minimised or hidden"
SERVER_GONE = "the X server has ended or dropped the connection"
LOST = {
    "close": (lambda desktop: desktop.ask_to_close(), CLOSED),
    "destroy": (lambda desktop: desktop.destroy(), CLOSED),
    "kill": (lambda desktop: desktop.kill(), SERVER_GONE),
    "hide": (lambda desktop: desktop.hide(), HIDDEN),
    "move": (lambda desktop: desktop.move(5, 3), r"does not fill its screen any more, it has 131 × 97 px at \(5, 3\)"),
    "resize": (lambda desktop: desktop.resize(60, 50), r"does not fill its screen any more, it has 60 × 50 px"),
}


@pytest.mark.parametrize("name", LOST)
def test_a_window_that_is_lost_is_said_and_opened_again(device, server, name):
    act, said = LOST[name]
    with Desktop(server.display) as desktop:
        act(desktop)
    with pytest.raises(DeviceLostError, match=said) as caught:
        shown_until_it_fails(device, 1)
    assert caught.value.repeatable
    assert caught.value.remedy
    assert device.state is DeviceState.FAULT
    device.darken()
    assert not server.surface().any()
    assert device.describe()["state"] == "FAULT"
    assert recover(device, server) < 15.0


@pytest.mark.parametrize("name", ["close", "move"])
def test_a_playing_sequence_ends_when_the_window_is_lost(device, server, name):
    act, said = LOST[name]
    device.load(sequence(1000))
    begin = time.monotonic()
    device.play()
    with Desktop(server.display) as desktop:
        assert within(5.0, lambda: server.channel()[0, 0] == 80), "the second picture never came"
        act(desktop)
    with pytest.raises(DeviceLostError, match=said):
        device.finish(20.0)
    assert time.monotonic() - begin < 1000 * device.period_s
    assert device.state is DeviceState.FAULT


def test_loss_after_the_last_picture_is_seen_on_request(device, server):
    device.verify()
    with Desktop(server.display) as desktop:
        desktop.move(5, 3)
    with pytest.raises(DeviceLostError, match="does not fill its screen"):
        device.verify()


def test_a_covered_window_breaks_the_sequence_and_not_the_device(device, server):
    with Desktop(server.display) as desktop:
        cover = desktop.cover(100, 0, 40, 20)
        for _ in range(2):
            with pytest.raises(SequenceFaultError, match="it was covered by: mail has come"):
                shown_until_it_fails(device, 1)
        with pytest.raises(SequenceFaultError, match="mail has come"):
            device.load(sequence())
        assert device.state is DeviceState.ARMED
        desktop.uncover(cover)
        device.load(sequence())
        device.show(1)
    assert np.array_equal(server.channel(), sequence()[1])


def test_a_window_beside_the_screen_does_not_matter(device, server):
    with Desktop(server.display) as desktop:
        desktop.cover(SIZE[0], 0, 40, 20)
        device.verify()
        device.show(1)


def test_a_cover_that_is_gone_again_breaks_the_sequence_it_was_in(device, server):
    device.load(sequence(1000))
    device.play()
    with Desktop(server.display) as desktop:
        desktop.uncover(desktop.cover(0, 0, 40, 20))
    with pytest.raises(SequenceFaultError, match="it was covered by"):
        device.finish(20.0)
    assert device.state is DeviceState.ARMED
    # Nothing of it is left for the next one.
    device.load(sequence(5))
    device.play()
    assert len(device.finish(10.0).shown_s) == 5


def test_what_was_covered_while_nobody_looked_is_drawn_again(device, server):
    device.darken()
    with Desktop(server.display) as desktop:
        desktop.uncover(desktop.cover(0, 0, 40, 20))
        desktop.uncover(desktop.cover(50, 50, 40, 20))
    assert within(10.0, lambda: not server.surface().any())


def test_a_process_that_is_killed_is_a_lost_device(device, server):
    os.kill(device.pid, signal.SIGKILL)
    with pytest.raises(DeviceLostError, match="its process was ended by SIGKILL"):
        device.show(1)
    device.darken()
    # The server takes the window away when it sees that its owner is gone.
    assert within(5.0, lambda: not server.surface().any())
    recover(device, server)


def test_a_process_that_is_killed_while_it_plays(device):
    device.load(sequence(400))
    device.play()
    os.kill(device.pid, signal.SIGKILL)
    with pytest.raises(DeviceLostError, match="its process was ended by SIGKILL"):
        device.finish(10.0)


def test_a_process_that_hangs_while_it_plays_is_ended(device):
    device.load(sequence(400))
    device.play()
    process = psutil.Process(device.pid)
    os.kill(device.pid, signal.SIGSTOP)
    with pytest.raises(DeviceLostError, match=r"400 pictures were not played within 0\.3 s"):
        device.finish(0.3)
    device.close()
    assert not process.is_running()


PAUSED_S = 0.1


def played_with_a_pause(device, server):
    """Play a hundred pictures; once the second is on, the window's process stands still for a while."""
    device.load(sequence(100))
    device.play()
    assert within(5.0, lambda: server.channel()[0, 0] == 80), "the second picture never came"
    os.kill(device.pid, signal.SIGSTOP)
    time.sleep(PAUSED_S)
    os.kill(device.pid, signal.SIGCONT)
    return device.finish(10.0)


def assert_late(record):
    gaps = np.diff(record.shown_s)
    longest = int(gaps.argmax())
    # A flip may still be done in the moment in which the process is told to stand still.
    assert gaps[longest] > 0.95 * PAUSED_S
    assert longest + 1 in record.late
    assert len(record.shown_s) == 100


def test_a_flip_that_comes_late_is_told(device, server):
    assert_late(played_with_a_pause(device, server))
    assert device.describe()["counts"]["late"] >= 1


def locked(settings, clock):
    return WindowProjector(settings, clock, server=locked_screen.serve)


def test_screen_with_a_refresh(one_window, server):
    device = one_window(make=locked, pacing="vsync", refresh_hz=None, max_jitter_ms=12)
    assert device.period_s == pytest.approx(locked_screen.REFRESH_S, rel=0.04)
    assert device.describe()["timing"]["locked"] is True
    assert_late(played_with_a_pause(device, server))


def test_a_rate_that_flips_cannot_keep_is_refused(one_window):
    # The next refresh is 13.3 ms away, or more of them where the machine is busy.
    with pytest.raises(DeviceSettingError, match=r"a flip takes (1[3-9]|[2-9]\d|\d{3,})\.\d ms, too long for 1000 Hz"):
        one_window(make=locked, refresh_hz=1000)


def test_flips_out_of_step_with_the_screen_play_nothing_but_show(one_window, server):
    device = one_window(pacing="vsync", refresh_hz=60)
    assert device.period_s == pytest.approx(1 / 60)
    device.load(sequence())
    with pytest.raises(DeviceSettingError, match="a sequence cannot be played"):
        device.play()
    assert device.state is DeviceState.ARMED
    device.show(1)
    assert np.array_equal(server.channel(), sequence()[1])
    drawn, played = device.describe()["warnings"]
    assert "drawn by the processor (llvmpipe)" in drawn
    assert "sequences cannot be played: " in played


def test_a_screen_without_any_rate_is_refused(one_window):
    with pytest.raises(DeviceSettingError, match="does not tell its refresh rate"):
        one_window(pacing="vsync", refresh_hz=None)


def randr(server, *arguments):
    require(shutil.which("xrandr"), "xrandr is not installed: apt install x11-xserver-utils")
    # Xvfb cannot have a screen of no size, and xrandr says so after it has switched the last output off.
    subprocess.run(["xrandr", "--display", server.display, *arguments], stderr=subprocess.DEVNULL)


MODES = (
    # width height rate: 0.5 MHz in 100 × 83 px, 1.2 MHz in 200 × 100 px
    ("--newmode", "small", "0.5", "80", "85", "90", "100", "60", "65", "70", "83"),
    ("--newmode", "60", "1.2", "131", "140", "150", "200", "97", "98", "99", "100"),
    ("--addmode", "screen", "small"),
    ("--addmode", "screen", "60"),
)


@pytest.fixture
def own_server(one_window):
    require_display()
    one_window.close()
    with XServer(*SIZE) as server:
        for arguments in MODES:
            randr(server, *arguments)
        yield server


@pytest.mark.parametrize(
    ("arguments", "said", "then"),
    [
        (("--output", "screen", "--off"), "screen screen is not there any more", "known are: none"),
        (
            ("--output", "screen", "--mode", "small"),
            r"screen screen has changed to 80 × 60 px at \(0, 0\)",
            "known are: 0: screen 80 × 60 px",
        ),
        (
            ("--output", "screen", "--gamma", "1:0.8:0.6"),
            "began to bend grey values",
            "bends grey values on screen screen",
        ),
    ],
)
def test_a_screen_that_is_lost_is_said_until_it_is_back(own_server, arguments, said, then):
    device = WindowProjector(settings_for(own_server), SystemClock())
    try:
        prepare(device)
        randr(own_server, *arguments)
        with pytest.raises(DeviceLostError, match=said):
            device.verify()
        device.darken()
        device.close()
        with pytest.raises((DeviceNotFoundError, DeviceSettingError), match=then):
            device.open()
        assert device.state is DeviceState.CLOSED
        randr(own_server, "--output", "screen", "--mode", "131x97", "--gamma", "1:1:1")
        recover(device, own_server)
    finally:
        device.close()


def test_a_screen_at_another_rate_is_refused(own_server):
    randr(own_server, "--output", "screen", "--mode", "60")
    device = WindowProjector(settings_for(own_server, pacing="vsync", refresh_hz=59), SystemClock())
    with pytest.raises(DeviceSettingError, match=r"screen screen refreshes at 60\.00 Hz, not at 59 Hz"):
        device.open()


def test_the_end_of_the_x_server_is_a_lost_device(own_server):
    device = WindowProjector(settings_for(own_server), SystemClock())
    try:
        prepare(device)
        os.kill(own_server.pid, signal.SIGKILL)
        with pytest.raises(DeviceLostError, match=SERVER_GONE):
            shown_until_it_fails(device, 1)
        device.darken()
    finally:
        device.close()
