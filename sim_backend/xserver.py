"""An X server without a screen, whose frame buffer can be read as the surface that a projector lights.

What is read is the memory of the server itself, mapped from the file it keeps it in: it shows what a real screen would
show, other programs' windows and mistakes of placement included, and owes nothing to the program under test.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceLostError, HardwareError, MissingLibraryError

_PATIENCE_S = 15.0
_PACKAGES = "apt install xvfb x11-xserver-utils libgl1 libglx-mesa0 libgl1-mesa-dri libxrandr2 libxss1"


class Area(NamedTuple):
    """A part of an X screen, px from its upper left corner."""

    x: int
    y: int
    width: int
    height: int


class XServer:
    """Xvfb on a display number of its own, for as long as the ``with`` block lasts.

    Parameters
    ----------
    width, height
        Size of each X screen, px.
    screens
        Number of separate X screens; number n is reached as ``f"{display}.{n}"``.
    monitors
        Names and places of the monitors that share screen 0, as RandR reports them; None for one that fills it.

    Notes
    -----
    The server ends with the block, and when this process dies in whatever way. It has no refresh: a swap of buffers is
    a copy to the frame buffer, and whoever reads at that moment sees a torn picture, as a camera would.

    Raises
    ------
    MissingLibraryError
        Xvfb (or, for ``monitors``, xrandr) is not installed.
    HardwareError
        It does not start.
    """

    def __init__(
        self, width: int, height: int, *, screens: int = 1, monitors: Mapping[str, Area] | None = None
    ) -> None:
        self.width = width
        self.height = height
        self.display = ""
        """Its name, such as ``:7``; known inside the ``with`` block."""
        self._screens = screens
        self._monitors = dict(monitors or {})
        self._pictures: list[NDArray[np.uint8]] = []
        self._channels: list[tuple[int, int, int]] = []
        self._stack = contextlib.ExitStack()
        self._server: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(tempfile.mkdtemp(prefix="xserver-"))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            self._start(folder, stack)
            for number in range(self._screens):
                picture, channels = _map_xwd(folder / f"Xvfb_screen{number}")
                self._pictures.append(picture)
                self._channels.append(channels)
            stack.callback(self._pictures.clear)
            stack.callback(self._channels.clear)
            self._divide()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def pid(self) -> int:
        """Process number of the server."""
        assert self._server is not None, "inside the with block only"
        return self._server.pid

    def environment(self) -> dict[str, str]:
        """The environment of this process with DISPLAY set to this server, for programs to be started on it."""
        session = ("WAYLAND_DISPLAY", "XDG_SESSION_TYPE", "XAUTHORITY")
        kept = {name: value for name, value in os.environ.items() if name not in session}
        return {**kept, "DISPLAY": self.display}

    def surface(self, screen: int = 0) -> NDArray[np.uint8]:
        """What is shown now: a copy (height, width, 3), red, green, blue."""
        return np.ascontiguousarray(self._alive(screen)[..., self._channels[screen]])

    def channel(self, name: str = "green", screen: int = 0) -> NDArray[np.uint8]:
        """One channel (height, width): a read-only view that changes with the screen, made without copying.

        Parameters
        ----------
        name
            ``red``, ``green`` or ``blue``; a grey picture is the same in all three.
        screen
            Number of the X screen.
        """
        return self._alive(screen)[..., self._channels[screen][("red", "green", "blue").index(name)]]

    def _alive(self, screen: int) -> NDArray[np.uint8]:
        if self._server is None or self._server.poll() is not None:
            raise DeviceLostError(
                f"the X server {self.display} is not running", "Read its screen inside the with block only."
            )
        return self._pictures[screen]

    def _start(self, folder: Path, stack: contextlib.ExitStack) -> None:
        program = shutil.which("Xvfb")
        if program is None:
            raise MissingLibraryError("Xvfb, an X server without a screen, is not installed", _PACKAGES)
        listen, tell = os.pipe()
        stack.callback(os.close, listen)
        with contextlib.ExitStack() as told, (folder / "log").open("wb") as log:
            told.callback(os.close, tell)
            command = [program, "-displayfd", str(tell), "-fbdir", str(folder)]
            for number in range(self._screens):
                command += ["-screen", str(number), f"{self.width}x{self.height}x24"]
            # Never reset when the last program leaves, no TCP, no cursor in the picture, no screen saver.
            command += ["-noreset", "-nolisten", "tcp", "-nocursor", "-s", "0"]
            server = subprocess.Popen(
                command, pass_fds=[tell], stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        self._server = server
        stack.callback(_end, server)
        # Reads from a pipe that closes when this process dies, even by SIGKILL.
        guard = subprocess.Popen(
            ["/bin/sh", "-c", 'read line; kill "$1"; rm -rf "$2"', "guard", str(server.pid), str(folder)],
            stdin=subprocess.PIPE,
            start_new_session=True,
        )
        stack.callback(_dismiss, guard)
        display = _first_line(listen, _PATIENCE_S)
        if not display:
            said = (folder / "log").read_text(errors="replace").strip().splitlines()
            raise HardwareError(
                f"Xvfb did not start within {_PATIENCE_S:g} s: {said[-1] if said else 'it said nothing'}",
                f"Start `Xvfb :99 -screen 0 {self.width}x{self.height}x24` by hand to see why.",
            )
        self.display = f":{display}"

    def _divide(self) -> None:
        if not self._monitors:
            return
        program = shutil.which("xrandr")
        if program is None:
            raise MissingLibraryError("xrandr, which divides a screen into monitors, is not installed", _PACKAGES)
        # The only output of Xvfb goes to the first monitor; RandR allows others without one.
        for output, (name, area) in zip(
            ["screen", *["none"] * len(self._monitors)], self._monitors.items(), strict=False
        ):
            x, y, width, height = area
            geometry = f"{width}/{width // 4}x{height}/{height // 4}+{x}+{y}"
            subprocess.run(
                [program, "--display", self.display, "--setmonitor", name, geometry, output],
                check=True,
                stdout=subprocess.DEVNULL,
                timeout=_PATIENCE_S,
            )


def _first_line(descriptor: int, patience_s: float) -> str:
    deadline = time.monotonic() + patience_s
    text = b""
    while not text.endswith(b"\n"):
        ready, _, _ = select.select([descriptor], [], [], max(deadline - time.monotonic(), 0.0))
        piece = os.read(descriptor, 64) if ready else b""
        if not piece:
            return ""
        text += piece
    return text.decode().strip()


def _end(server: subprocess.Popen[bytes]) -> None:
    server.terminate()
    try:
        server.wait(5.0)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()


def _dismiss(guard: subprocess.Popen[bytes]) -> None:
    guard.kill()
    guard.wait()
    assert guard.stdin is not None
    guard.stdin.close()


def _map_xwd(file: Path) -> tuple[NDArray[np.uint8], tuple[int, int, int]]:
    """Map an X window dump: pixels (height, width, 4) as they lie in memory, and where red, green and blue are in them.

    Source: ``X11/XWDFile.h``, version 7: 25 big-endian words, the window's name up to ``header_size``, the colour map
    in entries of 12 bytes, then lines of ``bytes_per_line``.
    """
    memory = np.asarray(np.memmap(file, np.uint8, mode="r"))
    words = struct.unpack(">25I", memory[:100].tobytes())
    header_size, version, _, _, width, height, _, byte_order = words[:8]
    bits_per_pixel, bytes_per_line, _, red, green, blue, _, _, colours = words[11:20]
    if version != 7 or bits_per_pixel != 32:
        raise HardwareError(
            f"the frame buffer file of Xvfb is version {version} with {bits_per_pixel} bits per pixel, not 7 with 32",
            "Use an X.Org Xvfb and a screen of depth 24.",
        )
    begin = header_size + 12 * colours
    lines = memory[begin : begin + height * bytes_per_line].reshape(height, bytes_per_line)
    pixels = lines[:, : 4 * width].reshape(height, width, 4)
    least_first = byte_order == 0

    def place(mask: int) -> int:
        byte = (mask.bit_length() - 1) // 8
        return byte if least_first else 3 - byte

    return pixels, (place(red), place(green), place(blue))
