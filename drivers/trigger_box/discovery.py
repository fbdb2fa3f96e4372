"""Which serial ports there are, who may open them, and which box answers at one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import MissingLibraryError


@dataclass(frozen=True)
class SerialPort:
    """A serial port of this machine, as the system describes it; nothing was sent to it.

    Parameters
    ----------
    path
        Such as ``/dev/ttyACM0``.
    description
        The system's, or its maker's; empty where it has none.
    usb_id
        Vendor and product, such as ``2e8a:000a``; None where it is not on USB.
    serial_number
        Of the USB device; None where it has none.
    accessible
        True where this user may read and write it.
    """

    path: str
    description: str
    usb_id: str | None
    serial_number: str | None
    accessible: bool


def serial_ports() -> tuple[SerialPort, ...]:
    """All serial ports, those on USB first, without opening any.

    Raises
    ------
    MissingLibraryError
        pyserial is not installed.
    """
    try:
        from serial.tools import list_ports
    except ImportError:
        raise MissingLibraryError("Serial ports: pyserial is not installed", "pip install pyserial") from None
    ports = [
        SerialPort(
            path=port.device,
            description="" if port.description in (None, "n/a") else port.description,
            usb_id=None if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            serial_number=port.serial_number,
            accessible=os.access(port.device, os.R_OK | os.W_OK),
        )
        for port in list_ports.comports()
    ]
    return tuple(sorted(ports, key=lambda port: (port.usb_id is None, port.path)))


def permission_remedy(port: str, usb_id: str | None = None) -> str:
    """What to type so that the present user may open ``port``.

    Parameters
    ----------
    port
        Path of the port.
    usb_id
        Vendor and product; a udev rule for it is added where it is known.
    """
    try:
        group = Path(port).group()
    except (OSError, KeyError, NotImplementedError):
        group = "dialout"
    lines = [f"Join the group that owns the port, then log in again:  sudo usermod -aG {group} $USER"]
    if usb_id is not None:
        vendor, product = usb_id.split(":")
        lines += [
            "or allow the one who sits at the machine, by a rule in /etc/udev/rules.d/60-mfs-trigger-box.rules:",
            udev_rule(vendor, product),
            "then: sudo udevadm control --reload && sudo udevadm trigger",
        ]
    return "\n".join(lines)


def udev_rule(vendor: str, product: str) -> str:
    """Rule that lets the user at the machine open a serial port with these USB ids (four hexadecimal digits each).

    It also keeps ModemManager, which asks each new port whether it is a modem, away from it.
    """
    return (
        f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}", '
        'TAG+="uaccess", ENV{ID_MM_DEVICE_IGNORE}="1"'
    )
