"""An emulated LightCrafter 6500 or 9000: refuses what the DLPC900's manual (DLPU018J) forbids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers import Clock
from sim_backend.lightcrafter.chip import EmulatedChip, Nack, PictureOf, Planes, frame_planes, grey
from sim_backend.lightcrafter.decoder import BadImageError, decode
from sim_backend.lightcrafter.sequencer import Run, Step

_SHORTEST_US = {1: 105, 2: 304, 3: 394, 4: 823, 5: 1215, 6: 1487, 7: 1998, 8: 4046}
_BLACK_BEFORE_TRIGGER_S = 105e-6
_MODE_CHANGE_S = 0.3
_TEXTS = {5: "Command not allowed in present mode", 11: "BMP image missing", 14: "Invalid exposure"}


@dataclass(frozen=True)
class _Line:
    """One line of the look-up table, as the chip reads its 12 bytes."""

    exposure_us: int
    bits: int
    leds: int
    waits: bool
    dark_us: int
    pulse_2: bool
    image: int
    position: int

    @classmethod
    def read(cls, data: bytes) -> _Line:
        place = int.from_bytes(data[10:12], "little")
        return cls(
            int.from_bytes(data[2:5], "little"),
            (data[5] >> 1 & 7) + 1,
            data[5] >> 4 & 7,
            bool(data[5] >> 7),
            int.from_bytes(data[6:9], "little"),
            not data[9] & 1,
            place & 0x7FF,
            place >> 11,
        )

    @property
    def place(self) -> tuple[int, int, int]:
        """What makes the chip forget its images when it changes."""
        return self.bits, self.image, self.position


class EmulatedDlpc900(EmulatedChip):
    """A LightCrafter 6500, or 9000 where ``size`` is 2560 × 1600.

    Parameters
    ----------
    clock, size, serial, video, on_edge, report_s
        See `EmulatedChip`.
    flash
        Images of the flash memory, each (height, width), 24-bit.
    """

    product_id = 0xC900

    def __init__(
        self,
        clock: Clock,
        size: tuple[int, int] = (1920, 1080),
        serial: str = "LC0001",
        *,
        flash: Sequence[Planes] = (),
        **more: Any,
    ) -> None:
        self._flash = list(flash)
        self._dual = size == (2560, 1600)
        super().__init__(clock, size, serial, **more)

    def power_on(self) -> None:
        """Begin as after the power was switched on."""
        super().power_on()
        self._registers |= {0x1A01: b"\0", 0x1A35: b"\x68\0\0", 0x1A36: b"\0"}
        self._lines: dict[int, _Line] = {}
        self._table: list[_Line] = []
        self._order: list[int] = []
        self._shown = 0
        self._configured = False
        self._forget_images()
        self._loading: tuple[int, int] | None = None
        self._body = bytearray()
        self._changing: tuple[float, int] | None = None
        self._set_mode(1)

    def enter_mode(self, mode: int) -> None:
        """Change the mode as another program would."""
        self._sequencer.stop(self._clock.now())
        self._set_mode(mode)

    def _forget_images(self) -> None:
        self._images: list[dict[int, Planes]] = [{}, {}]
        self._next_image: list[int | None] = [None, None]

    def _pass_time(self, now: float) -> None:
        super()._pass_time(now)
        if self._changing is not None and now >= self._changing[0]:
            self._mode, self._changing = self._changing[1], None
        if self._mode == 2 and self._running and not self._locked():
            self._sequencer.stop(now)
            self._aborted = True

    def _read(self, command: int, data: bytes) -> bytes:
        match command:
            case 0x0100:
                return bytes((self._error,))
            case 0x0101:
                return _TEXTS.get(self._error, "").encode().ljust(128, b"\0")
            case 0x0206:
                return bytes((2 if self._dual else 1,)) + b"EMULATED".ljust(31, b"\0")
            case 0x1A0C:
                parked = self._registers[0x0200] != b"\0"
                return bytes((parked | self._running << 1 | self._locked() << 3,))
        return super()._read(command, data)

    def _write(self, command: int, data: bytes) -> None:
        match command:
            case 0x1A1B:
                if self._running or data[0] > 3:
                    raise Nack(5 if self._running else 6)
                self._set_mode(data[0])
            case 0x1A24:
                self._start_or_stop(data[0])
            case 0x1A34:
                self._define(data)
            case 0x1A31:
                self._configure(int.from_bytes(data[:2], "little") & 0x7FF, int.from_bytes(data[2:6], "little"))
            case 0x1A32:
                self._reorder(data)
            case 0x1A2A | 0x1A2C:
                self._announce_image(data, half=int(command == 0x1A2C))
            case 0x1A2B | 0x1A2D:
                self._image_data(data, half=int(command == 0x1A2D))
            case 0x1A1D | 0x1A1E:
                self._set_output(command - 0x1A1C, data)
            case _:
                super()._write(command, data)

    def _set_mode(self, mode: int) -> None:
        now = self._clock.now()
        if mode == 2:
            # Only from video mode with a locked source, and not at once.
            if self._mode != 0 or not self._locked():
                raise Nack(5)
            self._changing = now + _MODE_CHANGE_S, mode
            return
        self._mode = mode
        self._configured = False
        self._forget_images()
        if mode in (1, 3):
            # Pattern modes begin with the splash pattern, running.
            white = np.full((self._size[1], self._size[0]), 255, np.uint8)
            self._sequencer.begin(Run(now, [Step(lambda _: white, 1 / 60, 0.0, True, True)], 0))

    def _start_or_stop(self, what: int) -> None:
        now = self._clock.now()
        if what in (0, 1):
            self._sequencer.stop(now)
            return
        if what != 2:
            raise Nack(6)
        if self._mode == 0 or not self._configured:
            raise Nack(5)
        if self._running:
            return
        steps = [self._step(index) for index in self._order]
        if self._mode == 2:
            if not self._locked():
                raise Nack(5)
            assert self._video is not None
            self._aborted = False
            self._sequencer.begin(Run(self._video.refresh_after(now), steps, self._shown, self._video))
            return
        self._aborted = False
        self._sequencer.begin(Run(now, steps, self._shown))

    def _step(self, index: int) -> Step:
        line = self._table[index]
        waits_next = self._table[(index + 1) % len(self._table)].waits
        dark_s = line.dark_us * 1e-6 + (_BLACK_BEFORE_TRIGGER_S if waits_next else 0.0)
        return Step(self._picture(line), line.exposure_us * 1e-6, dark_s, line.leds != 0, line.pulse_2)

    def _picture(self, line: _Line) -> PictureOf:
        if self._mode == 2:
            video = self._video
            assert video is not None
            return lambda number: grey(frame_planes(video.frame(number)), line.position, line.bits)
        if self._mode == 1:
            if line.image >= len(self._flash):
                raise Nack(11)
            halves = [self._flash[line.image]]
        else:
            memory = self._images[: 2 if self._dual else 1]
            if any(line.image not in half for half in memory):
                raise Nack(11)
            halves = [half[line.image] for half in memory]
        return lambda _: grey(np.concatenate(halves, axis=1), line.position, line.bits)

    def _define(self, data: bytes) -> None:
        if self._running or self._mode == 0:
            raise Nack(5)
        if len(data) != 12:
            raise Nack(6)
        index, line = int.from_bytes(data[:2], "little"), _Line.read(data)
        if index >= 400:
            raise Nack(15)
        if line.exposure_us < _SHORTEST_US[line.bits]:
            raise Nack(14)
        if line.position + line.bits > 24 or (self._mode == 3 and line.image > 17):
            raise Nack(10)
        if index in self._lines and self._lines[index].place != line.place:
            self._forget_images()
        self._lines[index] = line
        self._configured = False

    def _configure(self, entries: int, shown: int) -> None:
        if self._running or self._mode == 0:
            raise Nack(5)
        if not 1 <= entries <= 400:
            raise Nack(6)
        if any(index not in self._lines for index in range(entries)):
            raise Nack(7)
        table = [self._lines[index] for index in range(entries)]
        if self._mode == 3 and sum(line.bits for line in {line.place: line for line in table}.values()) > (
            480 if self._dual else 400
        ):
            raise Nack(8)
        if entries != len(self._table):
            self._forget_images()
        self._table = table
        self._order = list(range(entries))
        self._shown = shown
        self._configured = True

    def _reorder(self, data: bytes) -> None:
        if self._running or self._mode not in (1, 3) or not self._configured:
            raise Nack(5)
        entries = int.from_bytes(data[:2], "little") & 0x7FF
        order = [int.from_bytes(data[at : at + 2], "little") for at in range(6, len(data), 2)]
        if not 1 <= entries <= 400 or len(order) != entries:
            raise Nack(6)
        if any(index >= len(self._table) for index in order):
            raise Nack(15)
        self._order, self._shown = order, int.from_bytes(data[2:6], "little")

    def _announce_image(self, data: bytes, *, half: int) -> None:
        if self._mode != 3 or self._running or not self._configured or (half and not self._dual):
            raise Nack(5)
        index, size = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:6], "little")
        # The last image first, then down to number 0.
        due = self._next_image[half]
        if index != (max(line.image for line in self._table) if due is None else due) or size < 48:
            raise Nack(6)
        self._loading, self._body = (index, size), bytearray()

    def _image_data(self, data: bytes, *, half: int) -> None:
        if self._loading is None:
            raise Nack(5)
        if not 2 < len(data) <= 506 or int.from_bytes(data[:2], "little") != len(data) - 2:
            raise Nack(6)
        index, size = self._loading
        self._body += data[2:]
        if len(self._body) > size:
            raise Nack(6)
        if len(self._body) < size:
            return
        self._loading = None
        try:
            planes: Planes = decode(bytes(self._body))
        except BadImageError:
            raise Nack(9) from None
        if planes.shape != (self._size[1], self._size[0] // (2 if self._dual else 1)):
            raise Nack(4)
        self._images[half][index] = planes
        self._next_image[half] = index - 1 if index else None

    def _set_output(self, output: int, data: bytes) -> None:
        if len(data) != 5:
            raise Nack(6)
        delays = [int.from_bytes(data[at : at + 2], "little", signed=True) for at in (1, 3)]
        if not all(-20 <= delay <= 20_000 for delay in delays):
            raise Nack(13)
        self._sequencer.inverted[output] = bool(data[0])
        self._sequencer.delays_s[output] = delays[0] * 1e-6, delays[1] * 1e-6
