"""A conversation with an SLT/1 box: numbered commands, repeated until answered, never carried out twice."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.devices import Clock
from drivers.errors import DeviceLostError, DeviceNotFoundError, HardwareError, ProtocolError
from drivers.trigger_box import slt_protocol
from drivers.trigger_box.serial_line import SerialLine
from drivers.trigger_box.settings import SerialPortSettings
from drivers.trigger_box.slt_protocol import Event, Identity, Reply

CHECK_ERROR = 5
LONG_ERROR = 6
_AFTER_GARBLED_S = 0.02
_FLASH = "Flash the firmware in drivers/trigger_box/firmware onto the board, or set `port` to the right one"
_PRINTABLE = re.compile(rb"[^\x20-\x7e]+")


class RefusedError(Exception):
    """The box answered ``ERR``.

    Parameters
    ----------
    code, text
        Number and name of the error, SLT1.md section 4.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(f"ERR {code} {text}")
        self.code = code
        self.text = text


class SltSession:
    """The host's side of one open port.

    Parameters
    ----------
    device
        The name that errors mention.
    port
        Path of the port.
    settings
        Speed, timeouts and attempts.
    clock
        Real time.

    Raises
    ------
    HardwareError
        The port cannot be opened; see `SerialLine`.

    Attributes
    ----------
    repeated, garbled, stray
        Commands that had to be sent again; lines that were no SLT/1 or had a wrong checksum; good answers that belong
        to no open question, as late and doubled ones do.
    """

    def __init__(self, device: str, port: str, settings: SerialPortSettings, clock: Clock) -> None:
        self.device = device
        self.port = port
        self.repeated = self.garbled = self.stray = 0
        self._settings = settings
        self._clock = clock
        self._number = 0
        self._last_noise = b""
        self._booted = False
        self._line = SerialLine(device, port, settings.baud, clock)

    def identify(self) -> Identity:
        """Wait until the box is up and ask who it is.

        Raises
        ------
        DeviceNotFoundError
            Nothing answers, or something that is no SLT box.
        HardwareError
            It speaks another version of the protocol.
        """
        deadline = self._clock.now() + self._settings.boot_timeout_s
        while (reply := self._exchange("*IDN?")) is None and self._clock.now() < deadline:
            pass
        self._booted = False
        if reply is None:
            if self._last_noise:
                raise DeviceNotFoundError(
                    f"{self.device} at {self.port}: what answers there is no SLT box, it said {self._heard()}",
                    f"{_FLASH}, and check `baud`.",
                )
            raise DeviceNotFoundError(
                f"{self.device} at {self.port}: nothing answers within {self._settings.boot_timeout_s:g} s",
                f"{_FLASH}; then press the board's reset button and try again.",
            )
        try:
            identity = slt_protocol.identity(reply.text)
        except ValueError as error:
            raise DeviceNotFoundError(f"{self.device} at {self.port}: {error}", f"{_FLASH}.") from None
        if identity.protocol != slt_protocol.PROTOCOL:
            raise HardwareError(
                f"{self.device} at {self.port}: its firmware {identity.firmware} on {identity.board} speaks "
                f"SLT/{identity.protocol}, this program SLT/{slt_protocol.PROTOCOL}",
                "Flash the firmware that belongs to this program: drivers/trigger_box/firmware.",
            )
        return identity

    def ask(self, body: str) -> str:
        """Send a command and return the text of its answer.

        Raises
        ------
        RefusedError
            The box answered with an error.
        DeviceLostError
            It does not answer any more, is gone, or has restarted.
        ProtocolError
            What it answers cannot be read.
        """
        garbled = self.garbled
        for attempt in range(self._settings.attempts):
            self.repeated += attempt > 0
            # The same number each time: a box that has done it, and whose answer was lost, only says so again.
            reply = self._exchange(body, again=attempt > 0)
            if self._booted:
                raise restarted(self.device, self.port, f"before it answered {body}")
            if reply is None:
                continue
            if reply.error is not None:
                raise RefusedError(reply.error, reply.text)
            return reply.text
        tried = f"{body} was sent {self._settings.attempts} times"
        if self.garbled > garbled:
            raise ProtocolError(
                f"{self.device} at {self.port}: its answers cannot be read; {tried}, the last line was {self._heard()}",
                "Check `baud`, the USB cable and the ground between box and bench; a hub without power does this too.",
            )
        raise DeviceLostError(
            f"{self.device} at {self.port} does not answer any more; {tried}",
            "Press the box's reset button or plug it in again, then repeat the scan.",
        )

    def close(self) -> None:
        """Let the port go; never fails."""
        self._line.close()

    @contextmanager
    def closed_on_error(self) -> Iterator[None]:
        """Let the port go if what follows fails."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def _exchange(self, body: str, *, again: bool = False) -> Reply | None:
        if not again:
            self._number = self._number % slt_protocol.LAST_NUMBER + 1
        for pending in self._line.pending():
            self.stray += self._read(pending) is not None
        self._line.write(slt_protocol.command(self._number, body))
        deadline = self._clock.now() + self._settings.reply_timeout_s
        while (line := self._line.read_line(deadline)) is not None:
            garbled = self.garbled
            reply = self._read(line)
            if reply is None:
                if self.garbled > garbled:
                    # Most likely the answer; to ask again does no harm.
                    deadline = min(deadline, self._clock.now() + _AFTER_GARBLED_S)
                continue
            if reply.number == self._number:
                return reply
            if reply.number is None and reply.error in (CHECK_ERROR, LONG_ERROR):
                # The command arrived damaged: no use in waiting.
                return None
            self.stray += 1
        return None

    def _read(self, line: bytes) -> Reply | None:
        try:
            message = slt_protocol.parse(line)
        except ValueError:
            self.garbled += 1
            self._last_noise = line
            return None
        if isinstance(message, Event):
            self._booted |= message.kind == "BOOT"
            return None
        return message

    def _heard(self) -> str:
        return repr(_PRINTABLE.sub(b"?", self._last_noise[:60]).decode("ascii"))


def restarted(device: str, port: str, when: str) -> DeviceLostError:
    """The error for a box that has lost what it was told."""
    return DeviceLostError(
        f"{device} at {port} has restarted, {when}",
        "Check the box's supply and its USB cable (a brown-out does this), then repeat the scan.",
    )
