"""The executable specification of SLT/1: what a box does with bytes, edges and time, without any wire.

The text is `drivers/trigger_box/SLT1.md`; the sections named below are its sections. A second implementation, in C, is
the firmware's `slt_core`; both hold the same conversations in the tests.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

Level = Literal["HIGH", "LOW"]
Drive = Callable[[Level | None, int], None]
"""Called with the level of OUT0 (None: not driven) and the time of the change, µs."""

IDENTITY = "SLT,emulator,EMU1,1.0.0,1"
LIMITS: Mapping[str, tuple[int, int]] = {
    "n": (1, 65535),
    "period": (20, 10_000_000),
    "width": (1, 1_000_000),
    "delay": (0, 1_000_000),
}
LONGEST_COMMAND = 95
_WRAP = 1 << 32
_NUMBER = re.compile(r"[0-9]{1,10}")
_ID = re.compile(r"#[0-9]{1,5}")
_CHECKED = re.compile(rb"(.*)\*([0-9A-F]{2})", re.DOTALL)
_CONFIGURATION = re.compile(r"CFG OUT0 (HIGH|LOW)(?: IN0 (HIGH|LOW|OFF))?(?: EVENTS (ON|OFF))?")


class _RefusedError(Exception):
    """An answer ``ERR``, section 4."""


_SYNTAX = "1 SYNTAX"
_RANGE = "2 RANGE"
_STATE = "3 STATE"
_BUSY = "4 BUSY"
_CHECK = "5 CHECK"
_LONG = "6 LONG"


def checksum(line: bytes) -> int:
    """CRC-8 of a line's characters, section 2: polynomial x⁸ + x² + x + 1, first value 0."""
    rest = 0
    for character in line:
        rest ^= character
        for _ in range(8):
            rest = (rest << 1) ^ (0x107 if rest & 0x80 else 0)
    return rest


@dataclass(frozen=True)
class Train:
    """What one GO, or one edge, gives."""

    pulses: int
    period_us: int
    width_us: int
    delay_us: int


class SltBox:
    """One box; times are µs on its own clock, which never runs backwards and is given modulo 2³² with each call.

    Parameters
    ----------
    send
        Takes the bytes of whole lines for the host.
    drive
        Moves the output.
    identity
        Answer to ``*IDN?``.
    """

    def __init__(self, send: Callable[[bytes], None], drive: Drive, identity: str = IDENTITY) -> None:
        self.identity = identity
        self._send = send
        self._drive = drive
        self._clear(0)

    def reset(self, t_us: int) -> None:
        """Begin anew, as after power-on (section 6)."""
        self._clear(t_us)
        self._drive(None, t_us)
        self._send(b"\n")
        self._tell(f"!BOOT {self.identity}")

    def _clear(self, t_us: int) -> None:
        self._now = t_us % _WRAP
        self._line = bytearray()
        self._too_long = False
        self._last: tuple[str, str] = "", ""
        self._state = "RESET"
        self._active: Level = "HIGH"
        self._exposing: Level | None = None
        self._exposure_level: Level | None = None
        self._events = False
        self._late_events: list[str] | None = None
        self._train: Train | None = None
        self._wanted_edge: str | None = None
        self._sent = self._owed = self._started = self._exposed = self._edges = self._missed = 0
        # What is still to come of the pulses under way, and when: rises left, is the output active, times in µs.
        self._rises = 0
        self._high = False
        self._change_at = self._busy_until = 0

    # --- time and inputs ------------------------------------------------------------------------------------------

    @property
    def wake_at_us(self) -> int | None:
        """When `wake` must be called next; None while nothing is under way."""
        if self._state != "RUNNING":
            return None
        return self._change_at if self._high or self._rises else self._busy_until

    def wake(self, t_us: int) -> None:
        """Do all that is due by ``t_us``."""
        while (due := self.wake_at_us) is not None and _reached(t_us, due):
            if self._high:
                self._set_output(False, due)
                self._change_at = (due + self._period_us - self._width_us) % _WRAP
            elif self._rises:
                self._rises -= 1
                self._sent += 1
                self._set_output(True, due)
                self._change_at = (due + self._width_us) % _WRAP
                self._event(f"!PULSE OUT0 {self._sent} {due}")
            else:
                self._finish(due)
        self._now = t_us % _WRAP

    def edge(self, rising: bool, t_us: int) -> None:
        """EXT0 has changed."""
        self.wake(t_us)
        if self._state not in ("ARMED", "RUNNING", "DONE") or self._wanted_edge is None:
            return
        if self._wanted_edge not in ("CHANGE", "RISING" if rising else "FALLING"):
            return
        self._edges += 1
        self._event(f"!EDGE EXT0 {self._edges} {self._now}")
        if self._started == self._owed:
            return
        if self._state == "RUNNING":
            self._missed += 1
        else:
            self._start(1)

    def exposure(self, level: Level, t_us: int) -> None:
        """IN0 is now at ``level``."""
        self.wake(t_us)
        before, self._exposure_level = self._exposure_level, level
        if self._state not in ("ARMED", "RUNNING", "DONE") or level == before or level != self._exposing:
            return
        self._exposed += 1
        self._event(f"!EDGE IN0 {self._exposed} {self._now}")

    def _start(self, pulses: int) -> None:
        assert self._train is not None
        self._state = "RUNNING"
        self._started += pulses
        self._rises = pulses
        self._period_us, self._width_us = self._train.period_us, self._train.width_us
        self._change_at = (self._now + self._train.delay_us) % _WRAP
        busy = (pulses - 1) * self._period_us + max(self._period_us, self._train.delay_us + self._width_us)
        self._busy_until = (self._now + busy) % _WRAP
        self.wake(self._now)

    def _finish(self, t_us: int) -> None:
        if self._wanted_edge is not None and self._started == self._owed:
            self._state = "DONE"
            self._event(f"!DONE {self._sent} {t_us}")
        else:
            self._state = "ARMED"

    def _set_output(self, active: bool, t_us: int) -> None:
        self._high = active
        opposite: Level = "LOW" if self._active == "HIGH" else "HIGH"
        self._drive(self._active if active else opposite, t_us)

    # --- lines ----------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, t_us: int) -> None:
        """Bytes have come from the host."""
        self.wake(t_us)
        for byte in data:
            if byte != 0x0A:
                self._too_long |= len(self._line) > LONGEST_COMMAND
                self._line.append(byte)
                continue
            line, too_long = bytes(self._line), self._too_long
            self._line.clear()
            self._too_long = False
            line = line.removesuffix(b"\r")
            if too_long or len(line) > LONGEST_COMMAND:
                self._tell(f"ERR {_LONG}")
            elif line:
                self._answer(line)

    def _answer(self, line: bytes) -> None:
        if checked := _CHECKED.fullmatch(line):
            line = checked[1]
            if int(checked[2], 16) != checksum(line):
                self._tell(f"ERR {_CHECK}")
                return
        if not all(0x20 <= byte <= 0x7E for byte in line):
            self._tell(f"ERR {_SYNTAX}")
            return
        text, number = line.decode("ascii"), ""
        if text.startswith("#"):
            number, _, command = text.partition(" ")
            if not _ID.fullmatch(number):
                self._tell(f"ERR {_SYNTAX}")
                return
            if text == self._last[0]:
                self._tell(self._last[1])
                return
        else:
            command = text
        # Section 5: what a command causes is told after its answer.
        self._late_events = []
        try:
            reply = f"OK {self._do(command)}"
        except _RefusedError as refusal:
            reply = f"ERR {refusal}"
        if number:
            reply = f"{number} {reply}"
            self._last = text, reply
        self._tell(reply)
        events, self._late_events = self._late_events, None
        for event in events:
            self._tell(event)

    def _do(self, command: str) -> str:
        if command == "*IDN?":
            return self.identity
        if command == "CAP?":
            return ",".join(f"{name}={least}-{most}" for name, (least, most) in LIMITS.items())
        if command == "STAT?":
            return self._status()
        if command == "STOP":
            return self._stop()
        if command == "GO":
            return self._go()
        if command == "ARM":
            return self._arm(None)
        if command.startswith("ARM EXT0 "):
            edge = command.removeprefix("ARM EXT0 ")
            if edge not in ("RISING", "FALLING", "CHANGE"):
                raise _RefusedError(_SYNTAX)
            return self._arm(edge)
        if configuration := _CONFIGURATION.fullmatch(command):
            return self._configure(*configuration.groups())
        name, *numbers = command.split(" ")
        if name == "TRAIN" and len(numbers) == 4 and all(_NUMBER.fullmatch(number) for number in numbers):
            return self._set_train(Train(*map(int, numbers)))
        raise _RefusedError(_SYNTAX)

    def _status(self) -> str:
        exposed = "-" if self._exposing is None else self._exposed
        return (
            f"{self._state},sent={self._sent}/{self._owed},in={exposed},edges={self._edges},"
            f"missed={self._missed},t={self._now}"
        )

    def _configure(self, output: str, exposing: str | None, events: str | None) -> str:
        if self._state == "RUNNING":
            raise _RefusedError(_STATE)
        self._active = "HIGH" if output == "HIGH" else "LOW"
        self._exposing = "HIGH" if exposing == "HIGH" else "LOW" if exposing == "LOW" else None
        self._events = events == "ON"
        self._state = "IDLE"
        self._set_output(False, self._now)
        return self._state

    def _set_train(self, train: Train) -> str:
        values = dict(zip(LIMITS, (train.pulses, train.period_us, train.width_us, train.delay_us), strict=True))
        if not all(least <= values[name] <= most for name, (least, most) in LIMITS.items()):
            raise _RefusedError(_RANGE)
        if train.width_us >= train.period_us:
            raise _RefusedError(_RANGE)
        if self._state in ("RESET", "RUNNING"):
            raise _RefusedError(_STATE)
        self._train = train
        self._state = "IDLE"
        return self._state

    def _arm(self, edge: str | None) -> str:
        if self._state in ("RESET", "RUNNING") or self._train is None:
            raise _RefusedError(_STATE)
        self._wanted_edge = edge
        self._sent = self._started = self._exposed = self._edges = self._missed = 0
        self._owed = 0 if edge is None else self._train.pulses
        self._state = "ARMED"
        return self._state

    def _go(self) -> str:
        if self._wanted_edge is not None or self._state not in ("ARMED", "RUNNING"):
            raise _RefusedError(_STATE)
        if self._state == "RUNNING":
            self._missed += 1
            raise _RefusedError(_BUSY)
        assert self._train is not None
        self._owed += self._train.pulses
        self._start(self._train.pulses)
        return f"{self._owed}"

    def _stop(self) -> str:
        if self._state != "RESET":
            self._rises = 0
            self._state = "IDLE"
            self._set_output(False, self._now)
        return self._state

    def _event(self, text: str) -> None:
        if not self._events:
            return
        if self._late_events is None:
            self._tell(text)
        else:
            self._late_events.append(text)

    def _tell(self, text: str) -> None:
        line = text.encode("ascii")
        self._send(line + b"*%02X\n" % checksum(line))


def _reached(now_us: int, due_us: int) -> bool:
    return (now_us - due_us) % _WRAP < _WRAP // 2
