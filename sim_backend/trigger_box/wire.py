"""The wire between host and box: a pseudo-terminal, its thread, and what can go wrong on it."""

from __future__ import annotations

import contextlib
import os
import select
import tempfile
import threading
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass
class WireFaults:
    """What goes wrong, settable at any time; the numbers count down by themselves.

    Parameters
    ----------
    silent
        Nothing that the box says arrives.
    garble_replies, halve_replies, repeat_replies
        So many lines to come have one flipped bit, end in their middle, come twice.
    garble_commands
        So many writes of the host to come have one flipped bit.
    swallow_commands
        So many writes of the host to come do not arrive.
    """

    silent: bool = False
    garble_replies: int = 0
    halve_replies: int = 0
    repeat_replies: int = 0
    garble_commands: int = 0
    swallow_commands: int = 0

    def sent(self, line: bytes) -> bytes:
        """What arrives at the host of a line."""
        if self.silent:
            return b""
        if self.garble_replies > 0:
            self.garble_replies -= 1
            return _flip(line)
        if self.halve_replies > 0:
            self.halve_replies -= 1
            return line[: len(line) // 2]
        if self.repeat_replies > 0:
            self.repeat_replies -= 1
            return line * 2
        return line

    def received(self, data: bytes) -> bytes:
        """What arrives at the box."""
        if self.swallow_commands > 0:
            self.swallow_commands -= 1
            return b""
        if self.garble_commands > 0:
            self.garble_commands -= 1
            return _flip(data)
        return data


def _flip(line: bytes) -> bytes:
    middle = (len(line) - 1) // 2
    return line[:middle] + bytes([line[middle] ^ 0x04]) + line[middle + 1 :]


class Wire:
    """A pseudo-terminal with a name that outlives it, as udev's links by serial number do, and a thread at its far end.

    Parameters
    ----------
    received
        Called in the thread with what the host has sent.
    wake
        Called in the thread when the time is due; returns in how many seconds to be called again, None for never.
    """

    def __init__(self, received: Callable[[bytes], None], wake: Callable[[], float | None]) -> None:
        self.faults = WireFaults()
        self._received = received
        self._wake = wake
        self._folder = tempfile.TemporaryDirectory(prefix="trigger-box-")
        self.port = str(Path(self._folder.name) / "port")
        # The box's end, and the host's end, which is held open too: without it the box's end reports errors until the
        # host has opened it.
        self._ends: tuple[int, int] | None = None
        self._ear, self._mouth = os.pipe()
        self._ending = False
        self._lock = threading.Lock()
        self.plug_in()
        self._thread = threading.Thread(target=self._run, name="trigger box emulator")
        self._thread.start()

    def plug_in(self) -> None:
        """Bring the port back; does nothing where it is there."""
        with self._lock:
            if self._ends is not None:
                return
            box, host = os.openpty()
            tty.setraw(host)
            os.set_blocking(box, False)
            os.symlink(os.ttyname(host), self.port)
            self._ends = box, host
        self.kick()

    def unplug(self) -> None:
        """Take the port away; does nothing where it is not there."""
        with self._lock:
            ends, self._ends = self._ends, None
            if ends is None:
                return
            os.unlink(self.port)
            for end in ends:
                os.close(end)
        self.kick()

    def send(self, line: bytes) -> None:
        """Send a line to the host; what does not fit into its buffer is lost, as on a real line."""
        arriving = self.faults.sent(line)
        with self._lock, contextlib.suppress(BlockingIOError):
            if self._ends is not None:
                os.write(self._ends[0], arriving)

    def kick(self) -> None:
        """Have the thread look at the time, and at the port, anew."""
        os.write(self._mouth, b".")

    def is_own_thread(self) -> bool:
        """True in the thread of the wire, which needs no kick."""
        return threading.current_thread() is self._thread

    def close(self) -> None:
        """Unplug, and end the thread."""
        self._ending = True
        self.unplug()
        self.kick()
        self._thread.join()
        os.close(self._ear)
        os.close(self._mouth)
        self._folder.cleanup()

    def _run(self) -> None:
        while not self._ending:
            patience = self._wake()
            with self._lock:
                listening = [self._ear] if self._ends is None else [self._ear, self._ends[0]]
            # Unplugging may close the descriptor meanwhile: the kick that follows it ends the wait.
            with contextlib.suppress(OSError, ValueError):
                ready, _, _ = select.select(listening, [], [], patience)
                if self._ear in ready:
                    os.read(self._ear, 4096)
            data = b""
            with self._lock, contextlib.suppress(BlockingIOError):
                if self._ends is not None:
                    data = os.read(self._ends[0], 4096)
            if data and (data := self.faults.received(data)):
                self._received(data)
