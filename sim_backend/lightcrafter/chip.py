"""What both emulated chips share: packets, faults, and the registers of status, light, flips and input."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import Clock
from sim_backend.lightcrafter.sequencer import Edge, Picture, Sequencer
from sim_backend.lightcrafter.video import VideoSource

REPORT_BYTES = 64
Planes = NDArray[np.uint32]
"""A 24-bit image, (height, width)."""


class Nack(Exception):  # noqa: N818 - the manual's word
    """The chip refuses a command.

    Parameters
    ----------
    code
        Error code of the DLPC900's manual.
    """

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class WireFaults:
    """What goes wrong; every number counts down to 0.

    Parameters
    ----------
    nack
        Commands to be refused at their next coming, and the error code.
    garbled
        How many replies are noise.
    misnumbered
        How many replies have another number than their command.
    hang
        True: no reply any more.
    """

    nack: dict[int, int] = field(default_factory=dict)
    garbled: int = 0
    misnumbered: int = 0
    hang: bool = False


class EmulatedChip:
    """Base of the emulated LightCrafters; a `UsbDevice`.

    Parameters
    ----------
    clock
        The bench's time.
    size
        (width, height) of the mirrors, px.
    serial
        USB serial number.
    video
        The video cable, None where there is none.
    on_edge
        Called at each edge of the trigger outputs, see `Edge`; it may come late, its moment is right.
    report_s
        What a report takes on the USB, s; only on a virtual clock.
    """

    product_id: int

    def __init__(
        self,
        clock: Clock,
        size: tuple[int, int],
        serial: str = "LC0001",
        *,
        video: VideoSource | None = None,
        on_edge: Edge | None = None,
        report_s: float = 0.0,
    ) -> None:
        self.serial = serial
        self.plugged = self.permitted = self.kernel_driver = True
        self.taken = False
        self.faults = WireFaults()
        self.commands: deque[tuple[int, bytes]] = deque(maxlen=100_000)
        """(command, data) of the latest writes."""
        self.reports: deque[tuple[str, bytes]] = deque(maxlen=1000)
        """("out" or "in", 64 bytes) as they were on the wire."""
        self._clock = clock
        self._size = size
        self._video = video
        self._on_edge = on_edge or (lambda output, rising, moment: None)
        self._report_s = report_s
        self._replies: deque[bytes] = deque()
        self.power_on()

    def power_on(self) -> None:
        """Begin as after the power was switched on."""
        width, height = self._size
        self._replies.clear()
        self._partial = b""
        self._error = 0
        self._registers: dict[int, bytes] = {
            0x1A00: b"\x08",
            0x1A05: b"\x01",
            0x1A07: b"\x08",
            0x0B01: b"\x80\x80\x80",
            0x1008: b"\0",
            0x1009: b"\0",
            0x0200: b"\0",
            0x1100: bytes(6),
        }
        self._mode = 0
        self._aborted = False
        self._sequencer = Sequencer(np.zeros((height, width), np.uint8), self._on_edge)

    def unplug(self) -> None:
        """Pull the USB cable and the power."""
        self.plugged = False
        self.kernel_driver = True
        self.power_on()

    def surface(self, moment: float | None = None) -> Picture:
        """Give what is on the surface, (height, width) 0..255, at ``moment`` (s; None: now)."""
        moment = self._clock.now() if moment is None else moment
        picture = self._sequencer.surface(moment)
        if self._mode == 0 and self._video is not None and self._registers[0x1A07] == b"\x08":
            picture = self._video_picture(moment)
        if self._registers[0x0200] != b"\0":
            return np.zeros_like(picture)
        if self._registers[0x1008] == b"\1":
            picture = picture[:, ::-1]
        return picture[::-1] if self._registers[0x1009] == b"\1" else picture

    def advance(self) -> None:
        """Tell all edges that have come about by now, and notice what else time has brought."""
        self._pass_time(self._clock.now())

    def receive(self, report: bytes) -> None:
        """Take a report."""
        self.reports.append(("out", report))
        self._clock.sleep(self._report_s)
        self._partial += report.ljust(REPORT_BYTES, b"\0")
        length = int.from_bytes(self._partial[2:4], "little")
        if len(self._partial) < 4 + length:
            return
        message, self._partial = self._partial, b""
        flags, number = message[0], message[1]
        command = int.from_bytes(message[4:6], "little")
        data = message[6 : 4 + length]
        self.advance()
        answer = b""
        try:
            if command in self.faults.nack:
                raise Nack(self.faults.nack.pop(command))
            if flags & 0x80:
                answer = self._read(command, data)
            else:
                self.commands.append((command, data))
                self._write(command, data)
                self._error = 0
        except Nack as nack:
            self._error = nack.code
            flags |= 0x20
            answer = b""
        if flags & 0x40 and not self.faults.hang:
            self._reply(flags, number, answer)

    def give(self, timeout_s: float) -> bytes | None:
        """Give the next reply."""
        if not self._replies:
            self._clock.sleep(timeout_s)
            return None
        self._clock.sleep(self._report_s)
        report = self._replies.popleft()
        self.reports.append(("in", report))
        return report

    def _reply(self, flags: int, number: int, answer: bytes) -> None:
        if self.faults.misnumbered:
            self.faults.misnumbered -= 1
            number = (number - 1) % 256
        stream = bytes((flags, number)) + len(answer).to_bytes(2, "little") + answer
        if self.faults.garbled:
            self.faults.garbled -= 1
            stream = bytes((0x5B, number, 0xFF, 0xFF)) + b"\xa5" * 60
        stream += bytes(-len(stream) % REPORT_BYTES)
        self._replies.extend(stream[at : at + REPORT_BYTES] for at in range(0, len(stream), REPORT_BYTES))

    def _pass_time(self, now: float) -> None:
        self._sequencer.tell(now)

    @property
    def _running(self) -> bool:
        return self._sequencer.running(self._clock.now())

    def _read(self, command: int, data: bytes) -> bytes:
        """Answer a read command; raises `Nack`."""
        match command:
            case 0x1A0A:
                return bytes((1 | self._aborted << 6,))
            case 0x1A0B:
                return b"\1"
            case 0x1A1B:
                return bytes((self._mode,))
            case 0x0205:
                return bytes((3, 0, 1, 4)) + bytes(12)  # 4.1.3
            case _ if command in self._registers:
                return self._registers[command]
        raise Nack(3)

    def _write(self, command: int, data: bytes) -> None:
        """Carry a write command out; raises `Nack`."""
        if command not in self._registers:
            raise Nack(3)
        if len(data) != len(self._registers[command]):
            raise Nack(6)
        self._registers[command] = data
        if command == 0x1A07:
            # By hand or by the sequence: the emulator's light is either the sequence's or none.
            self._sequencer.light(self._clock.now(), data == b"\x08")

    def _video_picture(self, moment: float) -> Picture:
        assert self._video is not None
        frame = self._video.frame(int(moment / self._video.period_s) - 1)
        picture: Picture = np.rint(frame.mean(axis=-1)).astype(np.uint8)
        return picture

    def _locked(self) -> bool:
        return self._video is not None and self._video.locked(self._clock.now())


def grey(image: Planes, first: int, bits: int) -> Picture:
    """Give the grey values (height, width; 0..255) of the pattern on planes ``first`` and up of an image."""
    levels = (1 << bits) - 1
    value = image >> np.uint32(first) & np.uint32(levels)
    picture: Picture = ((value * 255 * 2 + levels) // (2 * levels)).astype(np.uint8)
    return picture


def frame_planes(frame: Picture) -> Planes:
    """Give the 24 planes of a video frame (height, width, RGB): G0..G7, R0..R7, B0..B7."""
    wide = frame.astype(np.uint32)
    image: Planes = wide[..., 1] | wide[..., 0] << np.uint32(8) | wide[..., 2] << np.uint32(16)
    return image


PictureOf = Callable[[int], Picture]
