"""A Pico with the PrawnBlaster firmware, as its public documentation describes it: one pseudoclock, clock of 100 MHz.

Facts from https://github.com/labscript-suite/PrawnBlaster (readme; run states, answers and limits of version 1.2).
"""

from __future__ import annotations

import re
from collections.abc import Callable

from sim_backend.trigger_box.slt import Drive, Level

VERSION = "1.2.0"
_CYCLES_PER_US = 100
_TIMED_OUT = (1 << 32) - 1
_SHORTEST_HALF = 5
_SHORTEST_WAIT = 6
_INSTRUCTIONS = 30_000
_STOPPED, _RUNNING, _ABORTED = 0, 2, 5
_BUSY = (
    "Cannot execute command {} during buffered execution. Check status first and wait for it to return 0 or 5 "
    "(stopped or aborted)."
)


class PrawnBlaster:
    """The firmware; calls as those of `SltBox`, with the trigger input for an edge and no line for exposures.

    Parameters
    ----------
    send
        Takes the bytes of whole lines for the host.
    drive
        Moves the output.
    """

    def __init__(self, send: Callable[[bytes], None], drive: Drive) -> None:
        self._send = send
        self._drive = drive
        self._commands: dict[str, Callable[..., str]] = {
            "version": lambda: f"version: {VERSION}",
            "status": lambda: f"run-status:{self._status} clock-status:0",
            "debug on": lambda: "ok",
            "debug off": lambda: "ok",
            "getfreqs": lambda: "pll_sys = 100000kHz\r\nclk_sys = 100000kHz\r\nok",
            "abort": self._abort,
            "getwait": self._wait_length,
            "setnumpseudoclocks": self._clear_program,
            "setinpin": lambda clock, pin: "ok",
            "setoutpin": lambda clock, pin: "ok",
            "set": self._set,
            "get": self._get,
            "start": lambda: self._begin(triggered=False),
            "hwstart": lambda: self._begin(triggered=True),
        }
        self._line = b""
        self._high = False
        self._clear()

    def _clear(self) -> None:
        self._status = _STOPPED
        self._program: dict[int, tuple[int, int]] = {}
        self._now = 0
        self._waits: list[int] = []
        # What runs: next instruction, times its pulse is still to be given, and when the present phase ends (µs).
        self._next = self._repeats = self._half_us = 0
        self._phase = ""
        self._ends: int | None = None

    def reset(self, t_us: int) -> None:
        """Begin anew; says nothing."""
        self._clear()
        self._now = t_us
        self._drive(None, t_us)

    @property
    def wake_at_us(self) -> int | None:
        """When `wake` must be called next."""
        return self._ends if self._status == _RUNNING else None

    def wake(self, t_us: int) -> None:
        """Go through the phases that end by ``t_us``."""
        while self._status == _RUNNING and self._ends is not None and self._ends <= t_us:
            self._now = self._ends
            if self._phase == "high":
                self._drive("LOW", self._now)
                self._phase, self._ends = "low", self._now + self._half_us
            elif self._phase == "low":
                self._repeats -= 1
                if self._repeats:
                    self._rise()
                else:
                    self._advance()
            else:
                # The wait has timed out; a wait that follows it has no end.
                self._waits.append(_TIMED_OUT)
                self._advance(endless=True)
        self._now = max(self._now, t_us)

    def edge(self, rising: bool, t_us: int) -> None:
        """The trigger input has changed."""
        self.wake(t_us)
        self._high = rising
        self._look()

    def exposure(self, level: Level, t_us: int) -> None:
        """There is no such input."""

    def receive(self, data: bytes, t_us: int) -> None:
        """Bytes have come from the host."""
        self.wake(t_us)
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            self._send(self._answer(line.decode("ascii", "replace").strip()).encode("ascii", "replace") + b"\r\n")

    def _answer(self, text: str) -> str:
        match = re.fullmatch(r"(debug on|debug off|[a-z]+)((?: \d+)*)", text)
        if match is None or match[1] not in self._commands:
            return f"invalid request: {text}"
        always = ("status", "version", "debug on", "debug off", "getfreqs", "abort", "getwait")
        if match[1] not in always and self._status not in (_STOPPED, _ABORTED):
            return _BUSY.format(text)
        try:
            return self._commands[match[1]](*map(int, match[2].split()))
        except TypeError:
            return "invalid request"

    def _abort(self) -> str:
        if self._status != _RUNNING:
            return "Can only abort when status is 1 or 2 (transitioning to running or running)"
        self._status = _ABORTED
        self._drive("LOW", self._now)
        return "ok"

    def _wait_length(self, clock: int, wait: int) -> str:
        return f"{self._waits[wait]}" if wait < len(self._waits) else "wait not yet available"

    def _clear_program(self, clocks: int) -> str:
        self._program = {}
        return "ok"

    def _set(self, clock: int, address: int, half: int, repeats: int) -> str:
        if address >= _INSTRUCTIONS:
            return "invalid address"
        if repeats == 0 and 0 < half < _SHORTEST_WAIT:
            return "invalid request"
        if repeats > 0 and half < _SHORTEST_HALF:
            return "half-period too short"
        self._program[address] = half, repeats
        return "ok"

    def _get(self, clock: int, address: int) -> str:
        half, repeats = self._program.get(address, (0, 0))
        return f"{half} {repeats}"

    def _begin(self, *, triggered: bool) -> str:
        self._drive("LOW", self._now)
        self._waits = []
        self._next = 0
        if self._program.get(0, (0, 0)) != (0, 0):
            self._status = _RUNNING
            if triggered:
                self._phase, self._ends = "endless wait", None
                self._look()
            else:
                self._advance()
        return "ok"

    def _look(self) -> None:
        """A wait ends as long as the input is high: it is the level that counts."""
        if self._status != _RUNNING or not self._high:
            return
        if self._phase == "wait":
            assert self._ends is not None
            self._waits.append((self._ends - self._now) * _CYCLES_PER_US)
            self._advance()
        elif self._phase == "endless wait":
            self._advance()

    def _advance(self, *, endless: bool = False) -> None:
        half, repeats = self._program.get(self._next, (0, 0))
        self._next += 1
        if repeats:
            self._repeats, self._half_us = repeats, half // _CYCLES_PER_US
            self._rise()
        elif half == 0:
            self._status = _STOPPED
        elif endless:
            self._phase, self._ends = "endless wait", None
            self._look()
        elif self._phase == "wait":
            # The wait before this one has ended by its trigger, and takes its second half along.
            self._advance()
        else:
            self._phase, self._ends = "wait", self._now + half // _CYCLES_PER_US
            self._look()

    def _rise(self) -> None:
        self._drive("HIGH", self._now)
        self._phase, self._ends = "high", self._now + self._half_us
