"""Which LightCrafters are on the USB, and whether this user may talk to them."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from drivers.errors import MissingLibraryError

VENDOR_ID = 0x0451
CHIPS = {0x6401: "DLPC350 (LightCrafter 4500)", 0xC900: "DLPC900 (LightCrafter 6500 or 9000)"}
"""Product ids and what they stand for; both families are HID devices of Texas Instruments."""

UDEV_RULE_PATH = "/etc/udev/rules.d/60-lightcrafter.rules"
UDEV_RULE = "\n".join(
    f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{VENDOR_ID:04x}", ATTR{{idProduct}}=="{product:04x}", '
    'MODE="0660", TAG+="uaccess"'
    for product in CHIPS
)
"""Lets whoever sits at the machine open the projectors; goes to `UDEV_RULE_PATH`."""

PERMISSION_REMEDY = (
    "Allow access once, then plug the projector in again:\n"
    f"sudo tee {UDEV_RULE_PATH} <<'RULE'\n{UDEV_RULE}\nRULE\n"
    "sudo udevadm control --reload"
)


@dataclass(frozen=True)
class UsbProjector:
    """One LightCrafter that was found.

    Parameters
    ----------
    vendor_id, product_id
        Of the USB.
    chip
        What the product id stands for.
    serial
        Serial number; empty where there is none or it could not be read.
    bus, address
        Where it is on the USB, as ``lsusb`` shows it.
    problem
        Why it cannot be opened; empty where it can.
    remedy
        What to do about that.
    """

    vendor_id: int
    product_id: int
    chip: str
    serial: str
    bus: int
    address: int
    problem: str = ""
    remedy: str = ""

    @property
    def accessible(self) -> bool:
        """True where this user may open it."""
        return not self.problem

    def __str__(self) -> str:
        serial = f"serial {self.serial}" if self.serial else "without a readable serial number"
        return f"{self.chip}, {serial}, at bus {self.bus} address {self.address}"


def find_projectors(backend: Any = None) -> list[UsbProjector]:
    """List all LightCrafters, accessible or not.

    Parameters
    ----------
    backend
        A `usb.backend.IBackend`; None for libusb.

    Raises
    ------
    MissingLibraryError
        pyusb or libusb cannot be loaded.
    """
    import usb.util

    found = []
    for device in usb_devices(backend):
        serial, problem, remedy = _look_at(device)
        found.append(
            UsbProjector(
                device.idVendor,
                device.idProduct,
                CHIPS[device.idProduct],
                serial,
                device.bus or 0,
                device.address or 0,
                problem,
                remedy,
            )
        )
        usb.util.dispose_resources(device)
    return found


def usb_devices(backend: Any = None) -> Iterator[Any]:
    """Give the pyusb devices of all LightCrafters; parameters and errors as `find_projectors`."""
    backend = libusb() if backend is None else backend
    import usb.core

    return iter(
        usb.core.find(
            find_all=True, backend=backend, idVendor=VENDOR_ID, custom_match=lambda device: device.idProduct in CHIPS
        )
    )


def serial_of(device: Any) -> str:
    """Read the serial number of a pyusb device; empty where it has none.

    Raises
    ------
    usb.core.USBError
        The device cannot be opened.
    """
    import usb.util

    if not device.iSerialNumber:
        return ""
    # With the language given, pyusb does not hide a refused open behind "no langid".
    text = usb.util.get_string(device, device.iSerialNumber, langid=0x0409)
    return str(text or "").strip("\0 ")


def libusb() -> Any:
    """Load pyusb's backend over the libusb that the wheel `libusb-package` carries.

    Raises
    ------
    MissingLibraryError
        pyusb or libusb cannot be loaded.
    """
    try:
        import libusb_package
        import usb.backend.libusb1
    except ImportError as error:
        raise MissingLibraryError(
            f"USB projectors need {error.name}, which is not installed",
            "Install it with: pip install pyusb libusb-package",
        ) from error
    path = libusb_package.get_library_path()
    backend = usb.backend.libusb1.get_backend(find_library=lambda _: None if path is None else str(path))
    if backend is None:
        raise MissingLibraryError(
            "USB projectors need libusb 1.0, which cannot be loaded",
            "Install it with: pip install --force-reinstall libusb-package, or: sudo apt install libusb-1.0-0",
        )
    return backend


def _look_at(device: Any) -> tuple[str, str, str]:
    import usb.core

    try:
        return serial_of(device), "", ""
    except NotImplementedError:
        return (
            "",
            "its USB driver does not let other programs in",
            "On Windows, install WinUSB for it with Zadig; the vendor's own program stops working then.",
        )
    except usb.core.USBError as error:
        if error.errno == errno.EACCES:
            return "", "this user may not open it", PERMISSION_REMEDY
        if error.errno == errno.EBUSY:
            return "", "another program holds it", "Close the other program that talks to the projector."
        return "", f"it cannot be opened: {error}", "Unplug it, switch it off and on, and plug it in again."
