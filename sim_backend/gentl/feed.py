"""The world's end of the simulated producer: gives pictures, trigger edges and faults, hears of exposures.

The protocol is described in ``world.h``.
"""

from __future__ import annotations

import contextlib
import enum
import logging
import os
import select
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8] | NDArray[np.uint16]

_log = logging.getLogger(__name__)
_MAGIC = b"MFS1"
_PICT = b"PICT"
_HELLO = struct.Struct("<4sI64s")
_REQUEST = struct.Struct("<4sIQqq4Idd")
_ANSWER = struct.Struct("<4sIQ")
_MESSAGE = struct.Struct("<4Iq")
_EXPOSED = struct.Struct("<Qqq")
_PICTURES, _LINES = 1, 2
_EDGE, _FAULT = 1, 2
_NS = 1_000_000_000
_PATIENCE_S = 1.0


class Fault(enum.IntEnum):
    """What can go wrong with a frame; the order is that of ``faults.h``, where each is explained."""

    MISS_TRIGGER = 0
    DROP = enum.auto()
    INCOMPLETE = enum.auto()
    TRUNCATE = enum.auto()
    WRONG_SIZE = enum.auto()
    LATE = enum.auto()
    DUPLICATE = enum.auto()
    REPEAT = enum.auto()
    TEAR = enum.auto()
    ID_JUMP = enum.auto()
    STALE = enum.auto()
    DISCONNECT = enum.auto()
    CRASH = enum.auto()
    HANG = enum.auto()


@dataclass(frozen=True)
class ExposureRequest:
    """One exposure that a camera wants the picture of, after it has ended.

    Parameters
    ----------
    serial
        Of the camera.
    frame_id
        Number of the exposure in its acquisition, from 0.
    t_begin_s, exposure_s
        When it began, and for how long; s on the clock of `time.monotonic`.
    offset_x_px, offset_y_px, width_px, height_px
        The part of the sensor that is wanted.
    bits
        Significant bits of a grey value: 8, 10, 12 or 16.
    gain_db
        Amplification, dB.
    black_level_dn
        Grey value without light, DN.
    """

    serial: str
    frame_id: int
    t_begin_s: float
    exposure_s: float
    offset_x_px: int
    offset_y_px: int
    width_px: int
    height_px: int
    bits: int
    gain_db: float
    black_level_dn: float


class PictureSource(Protocol):
    """What a camera looks at."""

    def picture(self, request: ExposureRequest) -> Picture:
        """The picture (height_px, width_px): uint8 for 8 bits, else uint16 below ``2**bits``.

        Called from one thread for each camera. What it raises is kept in `PictureServer.failures`; the camera delivers
        an incomplete frame instead.
        """
        ...


@dataclass(frozen=True)
class Exposure:
    """What the line "exposure active" of a camera tells.

    Parameters
    ----------
    serial
        Of the camera.
    frame_id
        Number of the exposure in its acquisition, from 0; also the frame's id, unless ids were made to jump.
    t_begin_s, t_end_s
        When the line is active, s on the clock of `time.monotonic`. The end, and with a trigger delay the begin too, is
        yet to come when this is told.
    """

    serial: str
    frame_id: int
    t_begin_s: float
    t_end_s: float


class PictureServer:
    """Serves all simulated cameras of this machine that are given this path.

    Parameters
    ----------
    path
        Of the unix socket to make; what MFS_SIM_WORLD has to name. At most 100 bytes long.
    source
        What the cameras see.
    exposed
        Called for each exposure as soon as its trigger is accepted, from one thread for each camera.

    Notes
    -----
    Cameras connect while their stream runs: between DSStartAcquisition and DSStopAcquisition.
    """

    def __init__(self, path: Path, source: PictureSource, exposed: Callable[[Exposure], None] | None = None) -> None:
        if len(os.fsencode(path)) > 100:
            raise ValueError(f"{path} is too long for a unix socket: 100 bytes are allowed")
        self.path = path
        self.failures: list[Exception] = []
        self._source = source
        self._exposed = exposed
        self._door: _Door | None = None
        self._lock = threading.Lock()  # guards what follows
        self._connections: set[socket.socket] = set()
        self._lines: dict[socket.socket, str] = {}
        self._threads: list[threading.Thread] = []

    def __enter__(self) -> PictureServer:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Serial numbers of the cameras whose stream runs."""
        self._admit()
        with self._lock:
            return tuple(sorted(self._lines.values()))

    def open(self) -> None:
        """Listen; a socket that an earlier process has left behind is replaced."""
        self._door = _Door(self.path)
        self._spawn(self._welcome, self._door)

    def close(self) -> None:
        """Disconnect all cameras; no thread is left and the socket is gone. Allowed any number of times."""
        with self._lock:
            door, self._door = self._door, None
            if door is None:
                return
            door.ring()
            for connection in self._connections:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        door.close()

    def edge(self, line: int, rising: bool, t_s: float, serial: str | None = None) -> int:
        """Give an edge on a trigger line; returns how many cameras got it.

        Parameters
        ----------
        line
            0 or 1.
        rising
            Or falling.
        t_s
            When it happens, s on the clock of `time.monotonic`; an exposure that it triggers begins then.
        serial
            Of the camera, None for all that acquire.
        """
        return self._tell(_MESSAGE.pack(_EDGE, line, rising, 0, round(t_s * _NS)), serial)

    def inject(self, fault: Fault, count: int = 1, *, every: bool = False, serial: str | None = None) -> int:
        """Let a fault befall the ``count``-th frame from now, or with ``every`` each ``count``-th (0: none any more).

        Returns how many cameras were told: those whose stream runs.
        """
        return self._tell(_MESSAGE.pack(_FAULT, fault, every, count, 0), serial)

    def _tell(self, message: bytes, serial: str | None) -> int:
        told = 0
        self._admit()
        with self._lock:
            for connection, owner in self._lines.items():
                if serial is None or serial == owner:
                    with contextlib.suppress(OSError):  # a camera that stops this moment
                        connection.sendall(message)
                        told += 1
        return told

    def _welcome(self, door: _Door) -> None:
        while self._door is door:
            door.wait()
            self._admit()

    def _admit(self) -> None:
        """Take the cameras that wait at the door; one that has begun to stream is known when this returns."""
        with self._lock:
            while self._door is not None:
                arrival = self._door.next()
                if arrival is None:
                    return
                connection, channel, serial = arrival
                self._connections.add(connection)
                if channel == _LINES:
                    self._lines[connection] = serial
                self._spawn(self._serve, connection, channel, serial)

    def _spawn(self, target: Callable[..., None], *args: Any) -> None:
        thread = threading.Thread(target=target, args=args, name=f"picture server {self.path.name}", daemon=True)
        self._threads = [t for t in self._threads if t.is_alive()]
        self._threads.append(thread)
        thread.start()

    def _serve(self, connection: socket.socket, channel: int, serial: str) -> None:
        try:
            if channel == _PICTURES:
                self._serve_pictures(connection, serial)
            else:
                self._hear_exposures(connection, serial)
        except OSError:
            pass  # the camera has let go
        finally:
            with self._lock:
                self._lines.pop(connection, None)
                self._connections.discard(connection)
            connection.close()

    def _serve_pictures(self, connection: socket.socket, serial: str) -> None:
        while True:
            _, bits, frame_id, begin, duration, x, y, width, height, gain, black = _REQUEST.unpack(
                _receive(connection, _REQUEST.size)
            )
            request = ExposureRequest(
                serial, frame_id, begin / _NS, duration / _NS, x, y, width, height, bits, gain, black
            )
            try:
                pixels = _checked(self._source.picture(request), request)
            except Exception as error:
                _log.exception("%s: no picture of exposure %d", serial, frame_id)
                self.failures.append(error)
                connection.sendall(_ANSWER.pack(_PICT, 1, 0))
                continue
            connection.sendall(_ANSWER.pack(_PICT, 0, pixels.nbytes))
            connection.sendall(pixels.data)

    def _hear_exposures(self, connection: socket.socket, serial: str) -> None:
        while True:
            frame_id, begin, end = _EXPOSED.unpack(_receive(connection, _EXPOSED.size))
            if self._exposed is not None:
                try:
                    self._exposed(Exposure(serial, frame_id, begin / _NS, end / _NS))
                except Exception as error:
                    _log.exception("%s: exposure %d was not taken note of", serial, frame_id)
                    self.failures.append(error)


class _Door:
    """A listening unix socket whose wait can be ended."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._bell, self._ear = socket.socketpair()
        try:
            self._listener.bind(str(path))
        except OSError:
            self.close()
            raise
        self._listener.listen()
        self._listener.setblocking(False)

    def wait(self) -> None:
        """Until somebody is at the door or `ring` was called."""
        select.select([self._listener, self._ear], [], [])

    def ring(self) -> None:
        """End all waits, now and in future."""
        self._bell.send(b"!")

    def next(self) -> tuple[socket.socket, int, str] | None:
        """Connection, channel and serial number of the camera that waits longest; None where none waits."""
        while True:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return None
            try:
                connection.settimeout(_PATIENCE_S)
                magic, channel, name = _HELLO.unpack(_receive(connection, _HELLO.size))
                connection.settimeout(None)
                if magic == _MAGIC and channel in (_PICTURES, _LINES):
                    return connection, channel, name.rstrip(b"\0").decode()
                _log.error("%s: somebody speaks another protocol", self._path)
            except OSError:
                pass  # gone before it has said who it is
            connection.close()

    def close(self) -> None:
        """Nobody can come any more."""
        for one in (self._listener, self._bell, self._ear):
            one.close()
        self._path.unlink(missing_ok=True)


def _receive(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise ConnectionResetError
        data += part
    return data


def _checked(picture: Picture, request: ExposureRequest) -> Picture:
    wanted = np.dtype(np.uint8 if request.bits == 8 else "<u2")
    shape = request.height_px, request.width_px
    if picture.dtype != wanted or picture.shape != shape:
        raise ValueError(f"the source gave {picture.dtype} {picture.shape}, not {wanted} {shape}")
    if request.bits not in (8, 16) and int(picture.max()) >> request.bits:
        raise ValueError(f"the source gave grey values above {(1 << request.bits) - 1}")
    return picture if picture.flags.c_contiguous else picture.copy()
