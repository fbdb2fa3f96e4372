"""The driver of Picos that run the PrawnBlaster firmware, a pseudoclock of the labscript suite.

What it cannot do, and an SLT box can: count exposures, count edges that came too early, tell a lost answer from another
by its number, delay a pulse. Facts: https://github.com/labscript-suite/PrawnBlaster, readme.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from drivers.devices import Clock, DeviceState, Lifecycle, TriggerCounts
from drivers.errors import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    HardwareError,
    IllegalCallError,
    ProtocolError,
    SequenceFaultError,
)
from drivers.trigger_box.discovery import SerialPort, serial_ports
from drivers.trigger_box.finding import find_port
from drivers.trigger_box.serial_line import SerialLine, fault_on_loss
from drivers.trigger_box.settings import PrawnBlasterSettings

_MOST_EDGES = 100  # "up to 100 retriggers mid-execution"
_LONGEST_CYCLES = (1 << 32) - 1
_TIMED_OUT = (1 << 32) - 1
_STOPPED, _TO_RUNNING, _RUNNING, _ABORTED = 0, 1, 2, 5
_OK = re.compile("ok")
_VERSION = re.compile(r"version: (\S+)")
_STATUS = re.compile(r"run-status:(\d) clock-status:\d")
_FREQUENCY = re.compile(r"clk_sys = (\d+)kHz")
_ABORT = re.compile("ok|Can only abort .*")
_START = re.compile("(ok)|Cannot execute command .*")
_WAIT = re.compile(r"(\d+)|wait not yet available")


class PrawnBlasterBox:
    """A PrawnBlaster as a trigger box (`drivers.devices.Trigger`).

    Parameters
    ----------
    settings
        Of the box.
    clock
        Real time.
    ports
        Lists the machine's serial ports.

    Notes
    -----
    Not safe for several threads at once. While edges are awaited, ``sent`` in `counts` is a lower bound: the firmware
    tells only of the edges after the first. ``exposed`` is None always, and ``missed`` counts calls of `fire` only.
    """

    def __init__(
        self, settings: PrawnBlasterSettings, clock: Clock, *, ports: Callable[[], Sequence[SerialPort]] = serial_ports
    ) -> None:
        self.name = "PrawnBlaster"
        self._settings = settings
        self._clock = clock
        self._ports = ports
        self._life = Lifecycle(self.name)
        self._line: SerialLine | None = None
        self._port: str | None = None
        self._version: str | None = None
        self._cycles_per_us = 0.0
        self._edges: int | None = None
        self._sent = self._missed = self._stray = 0

    @property
    def min_period_s(self) -> float:
        """A pulse and as much time after it, s."""
        return 2 * self._settings.pulse_us * 1e-6

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    def open(self) -> None:
        """Find the port, make sure that it is a PrawnBlaster, and stop whatever it was doing.

        Raises
        ------
        DeviceNotFoundError
            There is no such port, several fit, or no PrawnBlaster answers there.
        DeviceBusyError
            Another program has the port.
        HardwareError
            The port may not be opened.
        """
        self._life.check("open")
        self._port = find_port(self.name, self._settings, self._ports, self._answers)
        self._line = SerialLine(self.name, self._port, self._settings.baud, self._clock)
        try:
            self._version = self._identify()
            self._ask("debug off", _OK)
            self._end_run()
        except BaseException:
            self._let_go()
            raise
        self._life.move("open")

    def configure(self) -> None:
        """Set the pins and learn how fast the box's clock is.

        Raises
        ------
        DeviceSettingError
            The pins are the same.
        """
        self._life.check("configure")
        wanted = self._settings
        if wanted.output_pin == wanted.input_pin:
            raise DeviceSettingError(
                f"{self.name}: output_pin and input_pin are both {wanted.output_pin}",
                "Set the two to the GPIO numbers that the camera and the projector are wired to.",
            )
        with fault_on_loss(self._life):
            self._cycles_per_us = int(self._ask("getfreqs", _FREQUENCY, end=_OK)[1]) * 1e-3
            self._ask("setnumpseudoclocks 1", _OK)
            self._ask(f"setinpin 0 {wanted.input_pin}", _OK)
            self._ask(f"setoutpin 0 {wanted.output_pin}", _OK)
        self._life.move("configure")

    def arm(self, pulses: int | None = None) -> None:
        """Load the pulses; with a number, wait for so many edges from now on.

        Raises
        ------
        DeviceSettingError
            More pulses than the firmware can wait for.
        DeviceLostError
            The box does not answer, or is gone.
        """
        self._life.check("arm")
        if pulses is not None and not 1 <= pulses <= _MOST_EDGES:
            raise DeviceSettingError(
                f"{self.name}: {pulses} edges are asked for, the firmware can wait for 1 to {_MOST_EDGES}",
                "Use a box that speaks SLT/1, or sequences of fewer pictures.",
            )
        half = round(self._settings.pulse_us * self._cycles_per_us)
        program = [(half, 1)]
        for _ in range((pulses or 1) - 1):
            # Two waits in a row have no time limit; a single one would end in a pulse that nobody asked for.
            program += [(_LONGEST_CYCLES, 0), (_LONGEST_CYCLES, 0), (half, 1)]
        with fault_on_loss(self._life):
            self._end_run()
            for address, (cycles, repeats) in enumerate([*program, (0, 0)]):
                self._ask(f"set 0 {address} {cycles} {repeats}", _OK)
            if pulses is not None:
                self._ask("hwstart", _OK, attempts=1)
        self._edges, self._sent, self._missed = pulses, 0, 0
        self._life.move("arm")

    def fire(self) -> None:
        """Give one pulse; returns when it is over.

        Raises
        ------
        SequenceFaultError
            The pulse before it was not over, or this one was aborted.
        DeviceLostError
            The box does not answer, or is gone.
        """
        self._life.require("fire", DeviceState.ARMED)
        if self._edges is not None:
            raise IllegalCallError(self.name, f"ARMED for {self._edges} edges", "fire", "armed without a number")
        with fault_on_loss(self._life):
            # Sent once: of an answer that is lost nobody knows whether the pulse was given.
            if self._ask("start", _START, attempts=1)[1] is None:
                self._missed += 1
                raise SequenceFaultError(
                    f"{self.name}: a pulse was asked for while the one before it was not over",
                    "Lower pulse_us to what the camera needs, or wait longer between two pulses.",
                )
            status = self._wait_for_end(2e-6 * self._settings.pulse_us)
        if status != _STOPPED:
            raise SequenceFaultError(
                f"{self.name}: a pulse was not finished, the box is in run-status {status}",
                "Make sure that no other program talks to the box, then repeat the sequence.",
            )
        self._sent += 1

    def counts(self) -> TriggerCounts:
        """What was counted since the box was armed; stays readable after `stop`."""
        self._life.require("counts", DeviceState.CONFIGURED, DeviceState.ARMED)
        if self._edges is not None and self.state is DeviceState.ARMED:
            with fault_on_loss(self._life):
                self._sent = self._count(self._edges)
        return TriggerCounts(sent=self._sent, exposed=None, missed=self._missed)

    def stop(self) -> None:
        """No more pulses. Does nothing on a lost box, which has to be opened anew."""
        self._life.require("stop", *(state for state in DeviceState if state is not DeviceState.CLOSED))
        if self.state is DeviceState.FAULT:
            return
        if self.state is DeviceState.ARMED:
            self.counts()
        with fault_on_loss(self._life):
            self._end_run()
        if self.state is DeviceState.ARMED:
            self._life.move("stop")

    def close(self) -> None:
        """Stop the box if it can be reached, and let the port go."""
        if self._line is not None and self.state is not DeviceState.FAULT:
            with suppress(HardwareError):  # it is let go all the same
                self._ask("abort", _ABORT)
        self._let_go()
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of identity, settings and counters."""
        return {
            "name": self.name,
            "state": self.state.name,
            "port": self._port,
            "version": self._version,
            "cycles_per_us": self._cycles_per_us,
            "settings": self._settings.model_dump(mode="json"),
            "counts": {"sent": self._sent, "missed": self._missed, "edges_awaited": self._edges},
            "line": {"stray": self._stray},
        }

    def _identify(self) -> str:
        deadline = self._clock.now() + self._settings.boot_timeout_s
        while True:
            try:
                return self._ask("version", _VERSION, attempts=1)[1]
            except (DeviceLostError, ProtocolError) as error:
                if self._clock.now() >= deadline:
                    raise DeviceNotFoundError(
                        f"{self.name} at {self._port}: no PrawnBlaster answers there: {error.message}",
                        "Flash the PrawnBlaster firmware onto the Pico, or set `port` to the right one.",
                    ) from None

    def _answers(self, port: str) -> bool:
        """True where a PrawnBlaster answers at ``port``."""
        self._port = port
        try:
            self._line = SerialLine(self.name, port, self._settings.baud, self._clock)
            self._identify()
        except HardwareError:
            return False
        finally:
            self._let_go()
        return True

    def _count(self, wanted: int) -> int:
        if self._status() == _STOPPED:
            return wanted
        # Each wait that has ended has been followed by a pulse; the wait for the first edge is not reported.
        for wait in range(wanted - 1):
            left = self._ask(f"getwait 0 {wait}", _WAIT)[1]
            if left is None or int(left) == _TIMED_OUT:
                return wait + 1 if wait else 0
        return wanted

    def _status(self) -> int:
        return int(self._ask("status", _STATUS)[1])

    def _end_run(self) -> None:
        if self._status() in (_TO_RUNNING, _RUNNING):
            self._ask("abort", _ABORT)
        self._wait_for_end(0.0)

    def _wait_for_end(self, duration_s: float) -> int:
        self._clock.sleep(duration_s)
        deadline = self._clock.now() + self._settings.reply_timeout_s
        while (status := self._status()) not in (_STOPPED, _ABORTED):
            if self._clock.now() >= deadline:
                raise DeviceLostError(
                    f"{self.name} at {self._port} does not come to an end; its run-status is {status}",
                    "Plug the box in again, then repeat the scan.",
                )
        return status

    def _ask(
        self,
        command: str,
        answer: re.Pattern[str],
        *,
        attempts: int | None = None,
        end: re.Pattern[str] | None = None,
    ) -> re.Match[str]:
        """Send a command until a line of its answer matches; ``end``, where given, is the answer's last line."""
        assert self._line is not None
        heard = ""
        for _ in range(attempts or self._settings.attempts):
            self._stray += sum(1 for _ in self._line.pending())
            self._line.write(command.encode("ascii") + b"\r\n")
            deadline = self._clock.now() + self._settings.reply_timeout_s
            match = None
            while (line := self._line.read_line(deadline)) is not None:
                heard = line.decode("ascii", "replace")
                match = match or answer.fullmatch(heard)
                if match and (end is None or end.fullmatch(heard)):
                    return match
                self._stray += match is None and end is None
        where = f"{self.name} at {self._port}"
        if heard:
            raise ProtocolError(
                f"{where}: {command} was answered with {heard[:60]!r}",
                "Check that the board runs PrawnBlaster, its cable, and that no other program talks to it.",
            )
        raise DeviceLostError(f"{where} does not answer {command}", "Plug the box in again, then repeat the scan.")

    def _let_go(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()
