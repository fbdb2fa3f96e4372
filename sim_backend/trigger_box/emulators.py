"""Boxes on a pseudo-terminal: the firmware, a clock, and the cables of a bench as methods."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Literal, Protocol, Self

from drivers import Clock, SystemClock
from sim_backend.trigger_box.prawnblaster import PrawnBlaster
from sim_backend.trigger_box.slt import IDENTITY, Level, SltBox
from sim_backend.trigger_box.wire import Wire, WireFaults

TriggerEdge = Literal["RISING", "FALLING"]
Send = Callable[[bytes], None]
Drive = Callable[[Level | None, int], None]
# A clock that is not the system's may jump; the thread looks at it at least this often while something is due.
_LOOK_S = 2e-3
_STROBE_US = 20


class Firmware(Protocol):
    """What runs in a box; see `SltBox` for the meaning of the calls."""

    @property
    def wake_at_us(self) -> int | None:
        """When `wake` must be called next."""
        ...

    def reset(self, t_us: int) -> None:
        """Begin anew."""
        ...

    def receive(self, data: bytes, t_us: int) -> None:
        """Bytes have come from the host."""
        ...

    def edge(self, rising: bool, t_us: int) -> None:
        """The trigger input has changed."""
        ...

    def exposure(self, level: Level, t_us: int) -> None:
        """The camera's line has changed."""
        ...

    def wake(self, t_us: int) -> None:
        """Do what is due."""
        ...


class BoxEmulator:
    """A box with cables; a context manager.

    Parameters
    ----------
    firmware
        Made with ``(send, drive)``.
    clock
        Time of the box.
    on_pulse
        Called with the time (s on ``clock``) at which a pulse begins, in the thread that caused it: that of the caller
        of `edge` where there is no delay, else the emulator's own. All times are kept in `pulses` as well.
    trigger_on
        The edge of OUT0 that the camera takes for a trigger.

    Notes
    -----
    The box is up at once. Its port is a link that stays the same when it is unplugged and plugged in again.
    """

    def __init__(
        self,
        firmware: Callable[[Send, Drive], Firmware],
        clock: Clock | None,
        on_pulse: Callable[[float], None] | None,
        trigger_on: TriggerEdge = "RISING",
    ) -> None:
        self.on_pulse = on_pulse
        self.pulses: list[float] = []
        self._clock = clock or SystemClock()
        self._lock = threading.RLock()
        self._begun: list[float] = []
        self._lines: list[bytes] = []
        self._inside = threading.local()
        self._output: Level | None = None
        self._started_s = self._clock.now()
        self._boots_until: float | None = None
        self._trigger_level: Level = "HIGH" if trigger_on == "RISING" else "LOW"
        self._firmware = firmware(self._send, self._drive)
        self._wire = Wire(self._receive, self._wake)

    @property
    def port(self) -> str:
        """Path of the serial port for the driver."""
        return self._wire.port

    @property
    def faults(self) -> WireFaults:
        """What goes wrong on the wire."""
        return self._wire.faults

    @property
    def output(self) -> Level | None:
        """Level of OUT0; None while it is not driven."""
        return self._output

    def edge(self, name: str, rising: bool, t_s: float | None = None) -> None:
        """An edge at an input, at ``t_s`` (s on the clock; not before an earlier call's) or now.

        Raises
        ------
        ValueError
            The box has no such input.
        """
        self._edges(name, t_s, (rising, 0))

    def strobe(self, name: str, t_s: float | None = None) -> None:
        """A high pulse of 20 µs at an input, as projectors give one per pattern; see `edge`."""
        self._edges(name, t_s, (True, 0), (False, _STROBE_US))

    def _edges(self, name: str, t_s: float | None, *edges: tuple[bool, int]) -> None:
        if name != "EXT0":
            raise ValueError(f"the box has no input {name!r}, only EXT0")
        with self._lock:
            begin_us = self._time_us(t_s)
            if self._boots_until is None:
                for rising, later_us in edges:
                    self._firmware.edge(rising, (begin_us + later_us) % (1 << 32))
        self._pass_on()

    def exposure(self, active: bool, t_s: float | None = None) -> None:
        """The camera's "exposure active" line, which is high while it is active, at ``t_s`` or now."""
        with self._lock:
            if self._boots_until is None:
                self._firmware.exposure("HIGH" if active else "LOW", self._time_us(t_s))
        self._pass_on()

    def reboot(self, boot_s: float = 0.0) -> None:
        """Reset, as by a brown-out or an Arduino's DTR line; deaf for ``boot_s``."""
        with self._lock:
            self._boots_until = self._clock.now() + boot_s
        self._wake()
        self._wire.kick()

    def unplug(self) -> None:
        """Pull the USB cable: the port is gone and the box without power."""
        self._wire.unplug()

    def plug_in(self) -> None:
        """Put the USB cable back: the box starts anew."""
        self._wire.plug_in()
        self.reboot()

    def say(self, data: bytes) -> None:
        """Send any bytes to the host."""
        self._wire.send(data)

    def close(self) -> None:
        """Unplug and end the thread."""
        self._wire.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _time_us(self, t_s: float | None = None) -> int:
        moment = self._clock.now() if t_s is None else t_s
        return round((moment - self._started_s) * 1e6) % (1 << 32)

    def _send(self, data: bytes) -> None:
        self._lines.append(data)

    def _drive(self, level: Level | None, t_us: int) -> None:
        before, self._output = self._output, level
        if before is not None and before != level and level == self._trigger_level:
            # One reading of the clock, or what comes between two would shift the pulse. Of two times modulo 2³² the
            # difference that is nearest to 0.
            now = self._clock.now()
            ahead_us = (t_us - self._time_us(now) + (1 << 31)) % (1 << 32) - (1 << 31)
            self._begun.append(now + ahead_us * 1e-6)

    def _receive(self, data: bytes) -> None:
        with self._lock:
            if self._boots_until is None:
                self._firmware.receive(data, self._time_us())
        self._pass_on()

    def _wake(self) -> float | None:
        with self._lock:
            if self._boots_until is not None:
                if self._clock.now() < self._boots_until:
                    return _LOOK_S
                self._boots_until = None
                self._started_s = self._clock.now()
                self._firmware.reset(0)
            now_us = self._time_us()
            self._firmware.wake(now_us)
            due = self._firmware.wake_at_us
        self._pass_on()
        return None if due is None else min(((due - now_us) % (1 << 32)) * 1e-6, _LOOK_S)

    def _pass_on(self) -> None:
        """Tell of the pulses that have begun, then send what the firmware has said: a box's output is that much faster.

        Without the lock: whoever hears of a pulse may well answer with an edge, and comes here again.
        """
        with self._lock:
            begun, self._begun = self._begun, []
            self.pulses += begun
            due = self._firmware.wake_at_us is not None
        depth = getattr(self._inside, "depth", 0)
        self._inside.depth = depth + 1
        try:
            if self.on_pulse is not None:
                for t_s in begun:
                    self.on_pulse(t_s)
        finally:
            self._inside.depth = depth
        if depth == 0:
            with self._lock:
                lines, self._lines = self._lines, []
                for line in lines:
                    self._wire.send(line)
        if due and not self._wire.is_own_thread():
            self._wire.kick()


class SltBoxEmulator(BoxEmulator):
    """A box that speaks SLT/1; see `BoxEmulator`.

    Parameters
    ----------
    clock, on_pulse
        See `BoxEmulator`; the system's clock where there is none.
    identity
        Answer to ``*IDN?``.
    trigger_on
        The edge of OUT0 that the camera takes for a trigger.
    firmware
        What runs in the box, where it is not `SltBox`.
    """

    def __init__(
        self,
        clock: Clock | None = None,
        on_pulse: Callable[[float], None] | None = None,
        *,
        identity: str = IDENTITY,
        trigger_on: TriggerEdge = "RISING",
        firmware: Callable[[Send, Drive], Firmware] | None = None,
    ) -> None:
        super().__init__(firmware or partial(SltBox, identity=identity), clock, on_pulse, trigger_on)


class PrawnBlasterEmulator(BoxEmulator):
    """A Pico that runs PrawnBlaster; see `BoxEmulator`. Its trigger input is EXT0 here.

    Parameters
    ----------
    clock, on_pulse
        See `BoxEmulator`; the system's clock where there is none.
    """

    def __init__(self, clock: Clock | None = None, on_pulse: Callable[[float], None] | None = None) -> None:
        super().__init__(PrawnBlaster, clock, on_pulse)
