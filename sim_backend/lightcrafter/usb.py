"""A USB that pyusb takes for real, with emulated LightCrafters on it."""

from __future__ import annotations

import errno
from array import array
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, Protocol

import usb.backend
import usb.core

_SERIAL_INDEX = 3


class UsbDevice(Protocol):
    """What sits at the far end of a cable."""

    product_id: int
    serial: str
    plugged: bool
    """False while the cable is out or the power is off."""
    permitted: bool
    """False where this user may not open it."""
    taken: bool
    """True while another program holds it."""
    kernel_driver: bool
    """True while the kernel's HID driver holds it."""

    def receive(self, report: bytes) -> None:
        """Take a report of 64 bytes."""
        ...

    def give(self, timeout_s: float) -> bytes | None:
        """Give the next report, None where there is none within ``timeout_s``."""
        ...


class EmulatedUsb(usb.backend.IBackend):  # type: ignore[misc]
    """A `usb.backend.IBackend` for pyusb.

    Parameters
    ----------
    devices
        What is connected.
    """

    def __init__(self, *devices: UsbDevice) -> None:
        super().__init__()
        self.devices = list(devices)
        self.claimed: set[int] = set()
        """Which of the devices are claimed, by ``id()``; empty when everything was let go."""

    def enumerate_devices(self) -> Iterator[UsbDevice]:
        """Give the devices that are plugged in."""
        return iter([device for device in self.devices if device.plugged])

    def get_parent(self, dev: UsbDevice) -> None:
        """All hang at the root."""

    def get_device_descriptor(self, dev: UsbDevice) -> Any:
        """Describe a device."""
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0110,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=0x0451,
            idProduct=dev.product_id,
            bcdDevice=0x0100,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=_SERIAL_INDEX if dev.serial else 0,
            bNumConfigurations=1,
            address=self.devices.index(dev) + 2,
            bus=1,
            port_number=self.devices.index(dev) + 1,
            port_numbers=(self.devices.index(dev) + 1,),
            speed=3,
        )

    def get_configuration_descriptor(self, dev: UsbDevice, config: int) -> Any:
        """Describe its one configuration."""
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=41,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0xC0,
            bMaxPower=50,
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, dev: UsbDevice, intf: int, alt: int, config: int) -> Any:
        """Describe its HID interface."""
        if intf or alt:
            raise IndexError((intf, alt))
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=2,
            bInterfaceClass=3,
            bInterfaceSubClass=0,
            bInterfaceProtocol=0,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(self, dev: UsbDevice, ep: int, intf: int, alt: int, config: int) -> Any:
        """Describe its two interrupt endpoints."""
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=(0x01, 0x81)[ep],
            bmAttributes=3,
            wMaxPacketSize=64,
            bInterval=1,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev: UsbDevice) -> UsbDevice:
        """Open, as the operating system allows."""
        self._present(dev)
        if not dev.permitted:
            raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        return dev

    def close_device(self, dev_handle: UsbDevice) -> None:
        """Close; an open interface goes along."""
        self.claimed.discard(id(dev_handle))

    def set_configuration(self, dev_handle: UsbDevice, config_value: int) -> None:
        """There is one only."""

    def get_configuration(self, dev_handle: UsbDevice) -> int:
        """Give the one there is."""
        return 1

    def claim_interface(self, dev_handle: UsbDevice, intf: int) -> None:
        """Claim, unless the kernel or another program has it."""
        self._present(dev_handle)
        if dev_handle.taken or dev_handle.kernel_driver:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self.claimed.add(id(dev_handle))

    def release_interface(self, dev_handle: UsbDevice, intf: int) -> None:
        """Release."""
        self._present(dev_handle)
        self.claimed.discard(id(dev_handle))

    def is_kernel_driver_active(self, dev_handle: UsbDevice, intf: int) -> bool:
        """Say whether the kernel has it."""
        return dev_handle.kernel_driver

    def detach_kernel_driver(self, dev_handle: UsbDevice, intf: int) -> None:
        """Take it from the kernel."""
        dev_handle.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: UsbDevice, intf: int) -> None:
        """Give it back."""
        dev_handle.kernel_driver = True

    def ctrl_transfer(
        self,
        dev_handle: UsbDevice,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array[int],
        timeout: int,
    ) -> int:
        """Answer requests for string descriptors."""
        self._present(dev_handle)
        text = {1: "Texas Instruments", 2: "DLP", _SERIAL_INDEX: dev_handle.serial}.get(wValue & 0xFF, "")
        body = text.encode("utf-16-le") if wValue & 0xFF else b"\x09\x04"
        answer = (bytes((len(body) + 2, 3)) + body)[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def intr_write(self, dev_handle: UsbDevice, ep: int, intf: int, data: array[int], timeout: int) -> int:
        """Pass a report on."""
        self._present(dev_handle)
        if len(data) > 64:
            raise usb.core.USBError("Overflow", -8, errno.EOVERFLOW)
        dev_handle.receive(data.tobytes())
        return len(data)

    def intr_read(self, dev_handle: UsbDevice, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        """Fetch a report."""
        self._present(dev_handle)
        report = dev_handle.give(timeout / 1000)
        if report is None:
            self._present(dev_handle)
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        buff[: len(report)] = array("B", report)
        return len(report)

    def _present(self, device: UsbDevice) -> None:
        if not device.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
