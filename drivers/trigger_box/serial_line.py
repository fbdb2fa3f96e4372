"""Lines of text over a serial port: pyserial, with its failures told in this project's errors."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
from typing import Any

from drivers.devices import Clock, Lifecycle
from drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    HardwareError,
    MissingLibraryError,
    ProtocolError,
)
from drivers.trigger_box.discovery import permission_remedy

_LONGEST_LINE = 4096
_UDEV_S = 0.5
_FORBIDDEN = (errno.EACCES, errno.EPERM)


class SerialLine:
    """One open serial port.

    Parameters
    ----------
    device
        The name that errors mention.
    port
        Path of the port.
    baud
        bit/s.
    clock
        Real time.
    write_timeout_s
        After which a port that takes no more bytes counts as lost, s.

    Raises
    ------
    DeviceNotFoundError
        There is no such port.
    DeviceBusyError
        Another program has it.
    HardwareError
        It may not be opened.
    MissingLibraryError
        pyserial is not installed.
    """

    def __init__(self, device: str, port: str, baud: int, clock: Clock, write_timeout_s: float = 1.0) -> None:
        try:
            import serial
        except ImportError:
            raise MissingLibraryError(f"{device}: pyserial is not installed", "pip install pyserial") from None
        self.device = device
        self.port = port
        self._clock = clock
        self._partial = bytearray()

        def opened() -> Any:
            # Exclusive: two programs on one port would each get half of the answers.
            return serial.Serial(port, baud, exclusive=True, timeout=0, write_timeout=write_timeout_s)

        try:
            try:
                self._serial = opened()
            except OSError as error:  # SerialException is one
                if error.errno not in _FORBIDDEN:
                    raise
                # A port that has just been plugged in belongs to root until udev has dealt with it.
                clock.sleep(_UDEV_S)
                self._serial = opened()
        except (OSError, ValueError) as error:
            raise self._cannot_open(error) from error

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises
        ------
        DeviceLostError
            The port is gone or takes nothing.
        """
        with self._loss_is_told():
            self._serial.write(data)

    def read_line(self, deadline_s: float) -> bytes | None:
        """Wait for the next line that is not empty, without its end; None where none is complete by ``deadline_s``.

        Raises
        ------
        DeviceLostError
            The port is gone.
        """
        while True:
            if line := self._pop():
                return line
            left = deadline_s - self._clock.now()
            with self._loss_is_told():
                self._serial.timeout = max(left, 0.0)
                data = self._serial.read(max(self._serial.in_waiting, 1))
            if not data:
                return None
            self._partial += data
            # A port at the wrong speed, or no box at all, may never send a line feed.
            if len(self._partial) > _LONGEST_LINE:
                del self._partial[:-_LONGEST_LINE]

    def pending(self) -> Iterator[bytes]:
        """Lines that have arrived already; forgets the beginning of an unfinished one after them."""
        while line := self.read_line(float("-inf")):
            yield line
        self._partial.clear()

    def close(self) -> None:
        """Let the port go; never fails."""
        with contextlib.suppress(Exception):
            self._serial.close()

    def _pop(self) -> bytes:
        while b"\n" in self._partial:
            end = self._partial.index(b"\n")
            line = bytes(self._partial[:end]).rstrip(b"\r")
            del self._partial[: end + 1]
            if line:
                return line
        return b""

    @contextlib.contextmanager
    def _loss_is_told(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            # pyserial raises SerialException, OSError, termios.error or TypeError, as the port happens to vanish.
            raise DeviceLostError(
                f"{self.device} at {self.port} was lost: {error}",
                "Plug the box's USB cable in again, check it for looseness, then repeat the scan.",
            ) from error

    def _cannot_open(self, error: Exception) -> HardwareError:
        number = getattr(error, "errno", None)
        where = f"{self.device} at {self.port}"
        if number in (errno.EAGAIN, errno.EBUSY):
            return DeviceBusyError(
                f"{where}: another program holds the port",
                f"Close the other scan, terminal or IDE that has it open; `fuser {self.port}` names it.",
            )
        if number in _FORBIDDEN:
            return HardwareError(f"{where}: this user may not open the port", permission_remedy(self.port))
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            return DeviceNotFoundError(
                f"{where}: there is no such port",
                "Plug the box in; `scan doctor` lists the serial ports that are there.",
            )
        return HardwareError(f"{where}: the port cannot be opened: {error}", "Check port and baud of the trigger box.")


@contextlib.contextmanager
def fault_on_loss(life: Lifecycle) -> Iterator[None]:
    """Move a device to FAULT where what is inside loses it, or cannot understand it any more."""
    try:
        yield
    except (DeviceLostError, ProtocolError):
        life.move("fail")
        raise
