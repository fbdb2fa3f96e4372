"""An emulated LightCrafter 4500: refuses what the DLPC350's manual (DLPU010) forbids, and has its known quirks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers import Clock
from sim_backend.lightcrafter.chip import EmulatedChip, Nack, PictureOf, Planes, frame_planes, grey
from sim_backend.lightcrafter.sequencer import Run, Step

_SHORTEST_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
_GROUPS = {1: 24, 2: 12, 3: 8, 4: 6, 5: 4, 6: 4, 7: 3, 8: 3}
_VALIDATION_S = 0.05
_WHITE_NUMBER = 24


class EmulatedDlpc350(EmulatedChip):
    """A LightCrafter 4500.

    Parameters
    ----------
    clock, size, serial, video, on_edge, report_s
        See `EmulatedChip`.
    flash
        Images of the flash memory, each (height, width), 24-bit:
        G0..G7, R0..R7, B0..B7.
    gap_s
        A command that comes sooner after the one before is refused, s: the real chip loses such ones now and then.
    """

    product_id = 0x6401

    def __init__(
        self,
        clock: Clock,
        size: tuple[int, int] = (912, 1140),
        serial: str = "LC0001",
        *,
        flash: Sequence[Planes] = (),
        gap_s: float = 0.018,
        **more: Any,
    ) -> None:
        self._flash = list(flash)
        self._gap_s = gap_s
        super().__init__(clock, size, serial, **more)

    def power_on(self) -> None:
        """Begin as after the power was switched on."""
        super().power_on()
        self._registers |= {
            0x1A22: b"\0",
            0x1A23: b"\0",
            0x1A29: bytes(8),
            0x1A31: bytes(4),
            0x1A35: bytes(4),
            0x1A36: b"\0",
        }
        self._mailbox = 0
        self._words: list[int] = []
        self._image_order = [0]
        self._valid = False
        self._validated_s = 0.0
        self._found = 0
        self._starts_ignored = 0
        self._last_s = -1.0

    def enter_mode(self, mode: int) -> None:
        """Change the mode as another program would."""
        self._sequencer.stop(self._clock.now())
        self._set_mode(mode)

    def _pass_time(self, now: float) -> None:
        super()._pass_time(now)
        if self._from_video and self._running and not self._locked():
            self._sequencer.stop(now)
            self._aborted = True

    @property
    def _from_video(self) -> bool:
        return self._mode == 1 and self._registers[0x1A22] == b"\0"

    def _read(self, command: int, data: bytes) -> bytes:
        self._mind_the_gap()
        match command:
            case 0x1A0C:
                return bytes(((self._registers[0x0200] != b"\0") | self._running << 1 | 8,))
            case 0x071C:
                width, height = self._size
                return (
                    bytes((2 if self._locked() else 0,)) + width.to_bytes(2, "little") + height.to_bytes(2, "little")
                ).ljust(28, b"\0")
            case 0x1A42:
                return bytes((len(self._flash),))
            case 0x1A1A:
                if self._clock.now() < self._validated_s:
                    return b"\x80"
                self._valid = not self._found & 3
                return bytes((self._found,))
        return super()._read(command, data)

    def _write(self, command: int, data: bytes) -> None:
        self._mind_the_gap()
        if self._running and command in (0x1A1B, 0x1A22, 0x1A23, 0x1A29, 0x1A31, 0x1A33, 0x1A34, 0x1A1A):
            raise Nack(5)
        match command:
            case 0x1A1B:
                self._set_mode(data[0])
            case 0x1A24:
                self._start_or_stop(data[0])
            case 0x1A33:
                self._mailbox = data[0]
            case 0x1A32:
                if self._mailbox == 0 or data != b"\0":
                    raise Nack(5)
            case 0x1A34:
                self._fill(data)
            case 0x1A1A:
                self._found = self._findings()
                self._valid = False
                self._validated_s = self._clock.now() + _VALIDATION_S
            case 0x1A1D | 0x1A1E:
                codes = data[1:]
                if len(codes) != (2 if command == 0x1A1D else 1) or max(codes) > 0xD5:
                    raise Nack(6)
                rising, falling = ((code - 0xBB) * 107.2e-9 for code in (codes[0], codes[-1]))
                self._sequencer.inverted[command - 0x1A1C] = bool(data[0])
                self._sequencer.delays_s[command - 0x1A1C] = rising, falling
            case _:
                super()._write(command, data)
                if command in (0x1A22, 0x1A23, 0x1A29, 0x1A31):
                    self._valid = False

    def _mind_the_gap(self) -> None:
        now, last = self._clock.now(), self._last_s
        self._last_s = now
        if now - last < self._gap_s:
            raise Nack(255)

    def _set_mode(self, mode: int) -> None:
        if mode > 1:
            raise Nack(6)
        if self._mode == 1 and self._registers[0x1A00][0] & 7 == 1:
            # With a test pattern as its input it drops off the USB.
            self.unplug()
            return
        if mode == 1 and self._mode == 0:
            self._starts_ignored = 1
        self._mode = mode
        self._valid = False

    def _fill(self, data: bytes) -> None:
        if self._mailbox == 2:
            if len(data) % 3:
                raise Nack(6)
            self._words = [int.from_bytes(data[at : at + 3], "little") for at in range(0, len(data), 3)]
        elif self._mailbox == 1:
            # Exactly two arrive the other way round.
            self._image_order = list(data[::-1] if len(data) == 2 else data)
        else:
            raise Nack(5)
        self._valid = False

    def _findings(self) -> int:
        exposure, period = self._timing_us
        lines, _, _, images = self._registers[0x1A31]
        found = 0
        for word in self._words:
            number, bits = word >> 2 & 0x3F, word >> 8 & 15
            if bits not in _SHORTEST_US or number >= _GROUPS[bits] + (bits == 1):
                found |= 2
            elif exposure < _SHORTEST_US[bits]:
                found |= 1
        if len(self._words) != lines + 1 or (not self._from_video and len(self._image_order) != images + 1):
            found |= 2
        if period < exposure:
            found |= 1
        elif 0 < period - exposure < 230:
            found |= 1 | 16
        return found

    @property
    def _timing_us(self) -> tuple[int, int]:
        data = self._registers[0x1A29]
        return int.from_bytes(data[:4], "little"), int.from_bytes(data[4:], "little")

    def _start_or_stop(self, what: int) -> None:
        now = self._clock.now()
        if what in (0, 1):
            self._sequencer.stop(now)
            return
        if what != 2:
            raise Nack(6)
        if self._mode == 0:
            raise Nack(5)
        if self._running or not self._valid:
            return  # what was not validated does not start, and nothing says so
        if self._starts_ignored:
            self._starts_ignored -= 1
            return
        lines, repeat, per_pulse_2, _ = self._registers[0x1A31]
        steps = self._steps(per_pulse_2 + 1)
        self._aborted = False
        shown = 0 if repeat else lines + 1
        if not self._from_video:
            self._sequencer.begin(Run(now, steps, shown))
        elif self._locked():
            assert self._video is not None
            self._sequencer.begin(Run(self._video.refresh_after(now), steps, shown, self._video))

    def _steps(self, per_pulse_2: int) -> list[Step]:
        exposure, period = self._timing_us
        steps, image = [], -1
        for index, word in enumerate(self._words):
            image += word >> 18 & 1
            picture = self._picture(word >> 2 & 0x3F, word >> 8 & 15, bool(word >> 16 & 1), max(image, 0))
            lit = bool(word >> 12 & 7)
            steps.append(Step(picture, exposure * 1e-6, (period - exposure) * 1e-6, lit, index % per_pulse_2 == 0))
        return steps

    def _picture(self, number: int, bits: int, invert: bool, image: int) -> PictureOf:
        turned = 255 if invert else 0
        if bits == 1 and number == _WHITE_NUMBER:
            flat = np.full((self._size[1], self._size[0]), 255 ^ turned, np.uint8)
            return lambda _: flat
        # Seven bits are the upper ones of a channel.
        first = 8 * number + 1 if bits == 7 else bits * number
        if self._from_video:
            video = self._video
            assert video is not None
            return lambda frame: grey(frame_planes(video.frame(frame)), first, bits) ^ np.uint8(turned)
        stored = self._image_order[image]
        if stored >= len(self._flash):
            raise Nack(11)
        return lambda _: grey(self._flash[stored], first, bits) ^ np.uint8(turned)
