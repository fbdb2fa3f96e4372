"""The X server's own frame buffer, against X programs that nobody here wrote and headers written by hand."""

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from requirements import require

from drivers import DeviceLostError, HardwareError, MissingLibraryError
from sim_backend import xserver
from sim_backend.xserver import Area, XServer


@pytest.fixture(autouse=True)
def _installed():
    require(shutil.which("Xvfb"), "Xvfb is not installed: apt install xvfb")


def paint(server: XServer, colour: str, screen: int = 0) -> None:
    require(shutil.which("xsetroot"), "xsetroot is not installed: apt install x11-xserver-utils")
    display = f"{server.display}.{screen}"
    subprocess.run(["xsetroot", "-display", display, "-solid", colour], check=True)
    # The program leaves before the server has painted.
    subprocess.run(["xset", "-display", display, "q"], check=True, stdout=subprocess.DEVNULL)


def test_colours_of_the_surface_are_those_that_were_painted():
    with XServer(64, 48) as server:
        paint(server, "#102030")
        assert np.array_equal(server.surface(), np.full((48, 64, 3), (0x10, 0x20, 0x30), np.uint8))
        for name, value in (("red", 0x10), ("green", 0x20), ("blue", 0x30)):
            assert np.array_equal(server.channel(name), np.full((48, 64), value, np.uint8))


def test_a_channel_is_live_and_cannot_be_written():
    with XServer(64, 48) as server:
        view = server.channel()
        paint(server, "#ffffff")
        assert view.min() == 255
        with pytest.raises(ValueError, match="read-only"):
            view[0, 0] = 1


def test_screens_are_separate():
    with XServer(64, 48, screens=2) as server:
        paint(server, "#010101", screen=0)
        paint(server, "#020202", screen=1)
        assert (server.surface(0).max(), server.surface(1).max()) == (1, 2)


def test_monitors_are_what_randr_reports():
    require(shutil.which("xrandr"), "xrandr is not installed: apt install x11-xserver-utils")
    with XServer(300, 100, monitors={"desk": Area(0, 0, 200, 100), "beam": Area(200, 0, 100, 80)}) as server:
        command = ["xrandr", "--listmonitors"]
        listed = subprocess.run(command, env=server.environment(), capture_output=True, text=True, check=True).stdout
    assert "desk 200/50x100/25+0+0" in listed
    assert "beam 100/25x80/20+200+0" in listed


def test_two_servers_have_displays_of_their_own():
    with XServer(16, 16) as one, XServer(16, 16) as other:
        assert one.display != other.display


def test_nothing_is_left_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(xserver.tempfile, "tempdir", str(tmp_path))
    before = psutil.Process().children(recursive=True)
    with XServer(16, 16) as server:
        pid = server.pid
        assert list(tmp_path.iterdir())
    assert not psutil.pid_exists(pid)
    assert not list(tmp_path.iterdir())
    assert psutil.Process().children(recursive=True) == before
    with pytest.raises(DeviceLostError, match="not running"):
        server.surface()


def test_it_ends_with_a_process_that_is_killed(tmp_path):
    program = (
        "import time\nfrom sim_backend.xserver import XServer\n"
        "with XServer(16, 16) as server:\n    print(server.pid, flush=True)\n    time.sleep(60)\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=environment) as parent:
        assert parent.stdout is not None
        server = psutil.Process(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
    psutil.wait_procs([server], timeout=5.0)
    assert not server.is_running() or server.status() == psutil.STATUS_ZOMBIE
    deadline = time.monotonic() + 5.0
    while list(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not list(tmp_path.iterdir())


def test_a_server_that_died_is_no_picture():
    with XServer(16, 16) as server:
        os.kill(server.pid, signal.SIGKILL)
        psutil.Process(server.pid).wait(5.0)
        with pytest.raises(DeviceLostError, match="is not running"):
            server.surface()


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(xserver.shutil, "which", lambda program: None)
    with pytest.raises(MissingLibraryError, match="apt install xvfb"), XServer(16, 16):
        pass


def test_a_server_that_does_not_start_says_why(monkeypatch, tmp_path):
    refusing = tmp_path / "Xvfb"
    refusing.write_text("#!/bin/sh\necho 'no room for a screen' >&2\nexit 1\n")
    refusing.chmod(0o755)
    monkeypatch.setattr(xserver.shutil, "which", lambda program: str(refusing))
    with pytest.raises(HardwareError, match="no room for a screen"), XServer(16, 16):
        pass


def window_dump(file: Path, byte_order: int, pixels: bytes) -> Path:
    """Write an X window dump of 2 × 1 px with one unused pixel at the end of the line and two colours in the map."""
    words = [108, 7, 2, 24, 2, 1, 0, byte_order, 32, 0, 32, 32, 12, 4, 0xFF0000, 0x00FF00, 0x0000FF, 8, 256, 2]
    file.write_bytes(struct.pack(">25I", *words, 2, 1, 0, 0, 0) + b"name\0\0\0\0" + bytes(24) + pixels)
    return file


@pytest.mark.parametrize(
    ("byte_order", "pixels"),
    [(0, b"\x03\x02\x01\x00\x06\x05\x04\x00" + bytes(4)), (1, b"\x00\x01\x02\x03\x00\x04\x05\x06" + bytes(4))],
)
def test_header_of_a_window_dump(tmp_path, byte_order, pixels):
    picture, channels = xserver._map_xwd(window_dump(tmp_path / "dump", byte_order, pixels))
    assert picture[..., channels].tolist() == [[[1, 2, 3], [4, 5, 6]]]


def test_another_dump_is_refused(tmp_path):
    file = window_dump(tmp_path / "dump", 0, bytes(12))
    file.write_bytes(file.read_bytes()[:4] + struct.pack(">I", 6) + file.read_bytes()[8:])
    with pytest.raises(HardwareError, match="version 6"):
        xserver._map_xwd(file)
