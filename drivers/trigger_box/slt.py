"""The driver of SLT/1 trigger boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

from drivers.devices import Clock, DeviceState, Lifecycle, TriggerCounts
from drivers.errors import (
    DeviceSettingError,
    HardwareError,
    IllegalCallError,
    ProtocolError,
    SequenceFaultError,
)
from drivers.trigger_box import slt_protocol
from drivers.trigger_box.discovery import SerialPort, serial_ports
from drivers.trigger_box.finding import find_port
from drivers.trigger_box.serial_line import fault_on_loss
from drivers.trigger_box.settings import SltSettings
from drivers.trigger_box.slt_protocol import Identity, Status
from drivers.trigger_box.slt_session import RefusedError, SltSession, restarted

_STATE_ERROR = 3
_BUSY_ERROR = 4


class SltTriggerBox:
    """A trigger box that speaks SLT/1 (`drivers.devices.Trigger`).

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
    Not safe for several threads at once. After a fault, ``close`` and ``open`` bring the box back, under whatever
    name its port has then.
    """

    def __init__(
        self, settings: SltSettings, clock: Clock, *, ports: Callable[[], Sequence[SerialPort]] = serial_ports
    ) -> None:
        self.name = "SLT trigger box"
        self._settings = settings
        self._clock = clock
        self._ports = ports
        self._life = Lifecycle(self.name)
        self._session: SltSession | None = None
        self._port: str | None = None
        self._identity: Identity | None = None
        self._limits: dict[str, tuple[int, int]] = {}
        self._wanted: int | None = None
        self._fired = 0
        self._status: Status | None = None

    @property
    def min_period_s(self) -> float:
        """What `min_period_us` says, s."""
        return self._settings.min_period_us * 1e-6

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def identity(self) -> Identity | None:
        """Who the box said it is; None until it was first opened."""
        return self._identity

    def open(self) -> None:
        """Find the port, wait until the box is up, and stop whatever it was doing.

        Raises
        ------
        DeviceNotFoundError
            There is no such port, several fit, or no SLT box answers there.
        DeviceBusyError
            Another program has the port.
        HardwareError
            The port may not be opened, or the box speaks another version of the protocol.
        """
        self._life.check("open")
        port = find_port(self.name, self._settings, self._ports, self._answers)
        session = SltSession(self.name, port, self._settings, self._clock)
        with session.closed_on_error():
            self._identity = session.identify()
            try:
                self._limits = slt_protocol.limits(session.ask("CAP?"))
                session.ask("STOP")
            except (RefusedError, ValueError) as error:
                raise self._against_protocol(error) from None
        self._session, self._port, self._status = session, port, None
        self._life.move("open")

    def configure(self) -> None:
        """Set levels and check that the box can do what the settings ask.

        Raises
        ------
        DeviceSettingError
            A time is beyond the box's limits.
        """
        self._life.check("configure")
        wanted = self._settings
        for field, value, limit in (
            ("pulse_us", wanted.pulse_us, "width"),
            ("delay_us", wanted.delay_us, "delay"),
            ("min_period_us", wanted.min_period_us, "period"),
        ):
            self._require_within(field, value, limit)
        exposing = wanted.exposure_level.upper() if wanted.count_back else "OFF"
        self._command(f"CFG OUT0 {wanted.output_level.upper()} IN0 {exposing} EVENTS OFF")
        self._life.move("configure")

    def arm(self, pulses: int | None = None) -> None:
        """Set the counts to 0 and get ready for `fire`, or for so many edges at EXT0.

        Raises
        ------
        DeviceSettingError
            More pulses than the box can count.
        DeviceLostError
            The box has restarted, or is gone.
        """
        self._life.check("arm")
        wanted = self._settings
        if pulses is not None:
            self._require_within("pulses", pulses, "n")
        self._command("STOP")
        self._command(f"TRAIN {pulses or 1} {wanted.min_period_us} {wanted.pulse_us} {wanted.delay_us}")
        self._command("ARM" if pulses is None else f"ARM EXT0 {wanted.edge.upper()}")
        self._wanted, self._fired, self._status = pulses, 0, None
        self._life.move("arm")

    def fire(self) -> None:
        """Give one pulse; returns when the box has begun it.

        Raises
        ------
        SequenceFaultError
            The pulse before it, or the shortest period, was not over; none was given.
        DeviceLostError
            The box has restarted, or is gone.
        """
        self._life.require("fire", DeviceState.ARMED)
        if self._wanted is not None:
            raise IllegalCallError(self.name, f"ARMED for {self._wanted} edges", "fire", "armed without a number")
        given = self._command("GO")
        self._fired += 1
        if given != str(self._fired):
            raise self._failed(self._against_protocol(f"GO number {self._fired} was answered with {given!r}"))

    def counts(self) -> TriggerCounts:
        """What was counted since the box was armed; stays readable after `stop`."""
        self._life.require("counts", DeviceState.CONFIGURED, DeviceState.ARMED)
        try:
            status = slt_protocol.status(self._command("STAT?"))
        except ValueError as error:
            raise self._failed(self._against_protocol(error)) from None
        if status.state == "RESET" or (self.state is DeviceState.ARMED and status.state == "IDLE"):
            raise self._failed(restarted(self.name, self._where, "and has lost its counts"))
        self._status = status
        return TriggerCounts(sent=status.sent, exposed=status.exposed, missed=status.missed)

    def stop(self) -> None:
        """No more pulses; a pulse under way ends at once. Does nothing on a lost box, which has to be opened anew."""
        self._life.require("stop", *(state for state in DeviceState if state is not DeviceState.CLOSED))
        if self.state is DeviceState.FAULT:
            return
        self._command("STOP")
        if self.state is DeviceState.ARMED:
            self._life.move("stop")

    def close(self) -> None:
        """Stop the box if it can be reached, and let the port go."""
        session, self._session = self._session, None
        if session is not None:
            if self.state is not DeviceState.FAULT:
                with suppress(HardwareError, RefusedError):
                    session.ask("STOP")
            session.close()
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of identity, settings and counters."""
        session = self._session
        return {
            "name": self.name,
            "state": self.state.name,
            "port": self._port,
            "identity": None if self._identity is None else asdict(self._identity),
            "limits": {name: list(limit) for name, limit in self._limits.items()},
            "settings": self._settings.model_dump(mode="json"),
            "counts": None if self._status is None else asdict(self._status),
            "line": None
            if session is None
            else {"repeated": session.repeated, "garbled": session.garbled, "stray": session.stray},
        }

    @property
    def _where(self) -> str:
        return self._port or "an unknown port"

    def _command(self, body: str) -> str:
        assert self._session is not None
        with fault_on_loss(self._life):
            try:
                return self._session.ask(body)
            except RefusedError as refusal:
                if refusal.code == _BUSY_ERROR:
                    raise SequenceFaultError(
                        f"{self.name}: a pulse was asked for while the one before it, or min_period_us "
                        f"({self._settings.min_period_us} µs), was not over",
                        "Lower min_period_us to what the camera needs, or wait longer between two pulses.",
                    ) from None
                if refusal.code == _STATE_ERROR:
                    raise restarted(self.name, self._where, f"and refuses {body}") from None
                raise self._against_protocol(f"{body} was answered with {refusal}") from None

    def _failed(self, error: HardwareError) -> HardwareError:
        self._life.move("fail")
        return error

    def _against_protocol(self, what: object) -> ProtocolError:
        return ProtocolError(
            f"{self.name} at {self._where} does not keep to SLT/1: {what}",
            "Flash the firmware that belongs to this program: drivers/trigger_box/firmware.",
        )

    def _require_within(self, field: str, value: int, limit: str) -> None:
        least, most = self._limits[limit]
        if not least <= value <= most:
            raise DeviceSettingError(
                f"{self.name}: {field} is {value}, this box can do {least} to {most}",
                f"Set {field} to a value from {least} to {most}, or use another board.",
            )

    def _answers(self, port: str) -> bool:
        """True where an SLT box answers at ``port``."""
        try:
            session = SltSession(self.name, port, self._settings, self._clock)
        except HardwareError:
            return False
        try:
            session.identify()
        except HardwareError:
            return False
        finally:
            session.close()
        return True
