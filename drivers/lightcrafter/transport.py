"""Commands to a LightCrafter over USB, and its replies: 64-byte HID reports on two interrupt endpoints.

Source: DLPU018J §1.2 (DLPC900); the DLPC350 speaks the same (DLPU010, TI's own library of 2015). The first report of a
command is flags, sequence number, length (little endian; command and data), command (little endian), data; further
reports carry 64 bytes of data each. A reply repeats the sequence number; its length counts the data alone.
"""

from __future__ import annotations

import contextlib
import errno
from typing import Any

from drivers.devices import Clock
from drivers.errors import DeviceBusyError, DeviceLostError, DeviceNotFoundError, HardwareError, ProtocolError
from drivers.lightcrafter.discovery import CHIPS, PERMISSION_REMEDY, serial_of, usb_devices

REPORT_BYTES = 64
READ, REPLY, NACK = 0x80, 0x40, 0x20
_HEADER_BYTES = 4
_OUT, _IN = 0x01, 0x81
# Where several HID interfaces enumerate, commands go to interface 0, as TI's library has it.
_INTERFACE = 0
_TIMEOUT_MS = 2000
_STALE_REPLIES = 8


class RefusedCommandError(ProtocolError):
    """The projector refused a command (NACK).

    Parameters
    ----------
    device, command
        Who refused what.
    code
        The projector's error code, None where it has none.
    reason
        The code in words.
    """

    def __init__(self, device: str, command: int, code: int | None, reason: str) -> None:
        number = "" if code is None else f" (error {code})"
        super().__init__(
            f"{device} refused command 0x{command:04X}: {reason}{number}",
            "The sequence is set up anew when it is repeated; where this comes back, switch the projector off and on, "
            "and check that no other program controls it.",
        )
        self.command = command
        self.code = code


def encode(command: int, data: bytes, sequence: int, *, read: bool = False, reply: bool = True) -> list[bytes]:
    """Cut a command into reports.

    Parameters
    ----------
    command
        USB command, as the manual writes it: 0x1A1B.
    data
        What goes with it.
    sequence
        0..255; the reply repeats it.
    read
        True for a read command.
    reply
        True where a write is to be acknowledged.

    Returns
    -------
    list of bytes
        Of `REPORT_BYTES` each, the last one filled up with zeros.
    """
    flags = (READ if read else 0) | (REPLY if read or reply else 0)
    body = command.to_bytes(2, "little") + data
    stream = bytes((flags, sequence)) + len(body).to_bytes(2, "little") + body
    stream += bytes(-len(stream) % REPORT_BYTES)
    return [stream[at : at + REPORT_BYTES] for at in range(0, len(stream), REPORT_BYTES)]


class UsbTransport:
    """One LightCrafter on the USB.

    Parameters
    ----------
    device
        The name that errors mention.
    product_id
        0x6401 for the DLPC350, 0xC900 for the DLPC900.
    serial
        Serial number; None where only one such projector is connected.
    clock
        Time.
    backend
        A `usb.backend.IBackend`; None for libusb.
    gap_s
        At least this long from one command to the next, s.
    """

    def __init__(
        self,
        device: str,
        product_id: int,
        serial: str | None,
        clock: Clock,
        backend: Any = None,
        gap_s: float = 0.0,
    ) -> None:
        self.device = device
        self.identity: dict[str, Any] = {}
        self.commands = 0
        self._product_id = product_id
        self._serial = serial
        self._clock = clock
        self._backend = backend
        self._gap_s = gap_s
        self._usb: Any = None
        self._sequence = 0
        self._kernel_driver = False
        self._ready_s = 0.0

    def open(self) -> None:
        """Find the projector and take it over from the kernel.

        Raises
        ------
        MissingLibraryError, DeviceNotFoundError, DeviceBusyError, HardwareError
            The last one where this user may not open it; the remedy has the udev rule.
        """
        self._usb = self._find()
        try:
            self._claim()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the projector; allowed at any time."""
        device, self._usb = self._usb, None
        if device is None:
            return
        import usb.core
        import usb.util

        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.release_interface(device, _INTERFACE)
            if self._kernel_driver:
                device.attach_kernel_driver(_INTERFACE)
        self._kernel_driver = False
        usb.util.dispose_resources(device)

    def read(self, command: int, data: bytes = b"") -> bytes:
        """Send a read command and return the data of its reply.

        Raises
        ------
        RefusedCommandError
            The projector says no.
        DeviceLostError
            It is gone, or silent for 2 s.
        ProtocolError
            It answers something else.
        """
        self._send(command, data, read=True)
        return self._reply(command)

    def write(self, command: int, data: bytes = b"", *, acknowledged: bool = True) -> None:
        """Send a write command and wait until the projector has taken it; errors as `read`.

        Parameters
        ----------
        command, data
            See `encode`.
        acknowledged
            False for a command that the projector cannot answer, such as a reset.
        """
        self._send(command, data, reply=acknowledged)
        if acknowledged:
            self._reply(command)

    def _find(self) -> Any:
        import usb.core

        there, hidden = [], None
        for device in usb_devices(self._backend):
            if device.idProduct != self._product_id:
                continue
            try:
                there.append((serial_of(device), device))
            except NotImplementedError:
                there.append(("", device))
            except usb.core.USBError as error:
                hidden = self._translated(error, "open")
        fitting = [(serial, device) for serial, device in there if self._serial in (None, serial)]
        if len(fitting) == 1:
            serial, device = fitting[0]
            self.identity = {"usb_serial": serial, "bus": device.bus, "address": device.address}
            return device
        if hidden is not None and not fitting:
            raise hidden
        wanted = CHIPS[self._product_id] + (f" with serial number {self._serial}" if self._serial else "")
        listed = ", ".join(serial or "one without a serial number" for serial, _ in there) or "none"
        if fitting:
            raise DeviceNotFoundError(
                f"{self.device}: {len(fitting)} projectors are a {wanted}: {listed}",
                "Name one of them by its serial number in the bench file.",
            )
        raise DeviceNotFoundError(
            f"{self.device}: no {wanted} is on the USB; there is: {listed}",
            "Switch the projector on, wait until it has started (10 s), and check its USB cable.",
        )

    def _claim(self) -> None:
        import usb.core
        import usb.util

        try:
            # The kernel takes every HID device for itself; elsewhere there is nothing to detach.
            with contextlib.suppress(NotImplementedError):
                if self._usb.is_kernel_driver_active(_INTERFACE):
                    self._usb.detach_kernel_driver(_INTERFACE)
                    self._kernel_driver = True
            usb.util.claim_interface(self._usb, _INTERFACE)
            self._drain()
        except usb.core.USBError as error:
            raise self._translated(error, "open") from error

    def _drain(self) -> None:
        """Drop what an earlier program has asked for and not fetched."""
        import usb.core

        with contextlib.suppress(usb.core.USBTimeoutError):
            for _ in range(_STALE_REPLIES):
                self._usb.read(_IN, REPORT_BYTES, 1)

    def _send(self, command: int, data: bytes, *, read: bool = False, reply: bool = True) -> None:
        import usb.core

        if self._usb is None:
            raise self._lost("its USB connection is closed")
        self._clock.sleep(self._ready_s - self._clock.now())
        self._sequence = (self._sequence + 1) % 256
        try:
            for report in encode(command, data, self._sequence, read=read, reply=reply):
                self._usb.write(_OUT, report, _TIMEOUT_MS)
        except usb.core.USBError as error:
            raise self._translated(error, f"command 0x{command:04X}") from error
        self.commands += 1
        self._ready_s = self._clock.now() + self._gap_s

    def _reply(self, command: int) -> bytes:
        import usb.core

        unexpected = None
        try:
            for _ in range(_STALE_REPLIES):
                report = self._report()
                if report[1] == self._sequence:
                    return self._data(command, report)
                # The late answer to a command that was given up; the one that is due comes after it.
                unexpected = report[1]
        except usb.core.USBTimeoutError as error:
            if unexpected is None:
                raise self._lost(f"no answer to command 0x{command:04X} within {_TIMEOUT_MS / 1000:g} s") from error
        except usb.core.USBError as error:
            raise self._translated(error, f"command 0x{command:04X}") from error
        raise self._garbled(command, f"its reply has number {unexpected}, not {self._sequence}")

    def _data(self, command: int, report: bytes) -> bytes:
        length = int.from_bytes(report[2:4], "little")
        if report[0] & NACK:
            raise RefusedCommandError(self.device, command, None, "it says no")
        if length > 512 or report[0] & ~(READ | REPLY | NACK):
            raise self._garbled(command, f"its reply begins with {report[:8].hex(' ')}")
        data = report[_HEADER_BYTES:]
        while len(data) < length:
            data += self._report()
        return data[:length]

    def _report(self) -> bytes:
        report = bytes(self._usb.read(_IN, REPORT_BYTES, _TIMEOUT_MS))
        return report + bytes(REPORT_BYTES - len(report))

    def _translated(self, error: Any, doing: str) -> HardwareError:
        if error.errno == errno.EACCES:
            return HardwareError(f"{self.device}: this user may not open it", PERMISSION_REMEDY)
        if error.errno == errno.EBUSY:
            return DeviceBusyError(
                f"{self.device}: another program holds it",
                "Close the other program that talks to the projector, such as the vendor's own.",
            )
        return self._lost(f"the USB connection broke at {doing} ({error.strerror})")

    def _lost(self, why: str) -> DeviceLostError:
        return DeviceLostError(
            f"{self.device}: {why}",
            "Check the projector's power and USB cable; where it hangs, switch it off and on.",
        )

    def _garbled(self, command: int, why: str) -> ProtocolError:
        return ProtocolError(
            f"{self.device} answered command 0x{command:04X} with something else: {why}",
            "Use a shorter USB cable without a hub; where this comes back, switch the projector off and on.",
        )
