"""From settings to a port: by path, by USB serial number, or the one port at which a box answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.errors import DeviceNotFoundError
from drivers.trigger_box.discovery import SerialPort
from drivers.trigger_box.settings import SerialPortSettings


def find_port(
    device: str,
    settings: SerialPortSettings,
    ports: Callable[[], Sequence[SerialPort]],
    answers: Callable[[str], bool],
) -> str:
    """Path of the box's port.

    Parameters
    ----------
    device
        The name that errors mention.
    settings
        Which port is wanted.
    ports
        Lists those of the machine.
    answers
        Says whether such a box answers at a path; asked only where the settings name no port, and only of USB ports.

    Raises
    ------
    DeviceNotFoundError
        None fits, or more than one; the message lists what is there.
    """
    if settings.port is not None:
        return settings.port
    usb = [port for port in ports() if port.usb_id is not None]
    if settings.serial_number is not None:
        wanted = f"with serial number {settings.serial_number}"
        fitting = [port for port in usb if port.serial_number == settings.serial_number]
    else:
        wanted = "that answers"
        fitting = [port for port in usb if answers(port.path)]
    if len(fitting) == 1:
        return fitting[0].path
    there = "; ".join(map(_told, usb)) or "none"
    if fitting:
        raise DeviceNotFoundError(
            f"{device}: several fit, {', '.join(port.path for port in fitting)}; USB serial ports: {there}",
            "Set `serial_number` or `port` to the one that is meant.",
        )
    raise DeviceNotFoundError(
        f"{device}: there is none {wanted}; USB serial ports: {there}",
        "Plug the box in, or set `port`; `scan doctor` lists the ports and who may open them.",
    )


def _told(port: SerialPort) -> str:
    serial = "" if port.serial_number is None else f", serial number {port.serial_number}"
    closed = "" if port.accessible else ", not accessible to this user"
    return f"{port.path} ({port.description or 'no description'}, {port.usb_id}{serial}{closed})"
