"""Packets, faults of the wire and finding projectors, through pyusb: `drivers.lightcrafter.transport` and `discovery`.

Bytes are the examples of the vendor's manual, DLPU018J §1.2.
"""

import pytest

from drivers import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    HardwareError,
    MissingLibraryError,
    ProtocolError,
)
from drivers.lightcrafter import discovery
from drivers.lightcrafter.transport import RefusedCommandError, UsbTransport, encode
from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedDlpc900, EmulatedUsb

CURTAIN = 0x1100


def chip(**more):
    return EmulatedDlpc900(VirtualClock(), (64, 32), **more)


def connect(*devices, serial=None):
    usb = EmulatedUsb(*devices)
    link = UsbTransport("projector", 0xC900, serial, devices[0]._clock if devices else VirtualClock(), usb)
    link.open()
    return link, usb


def test_the_manual_s_read_and_write_go_over_the_wire_byte_by_byte():
    device = chip()
    link, _ = connect(device)
    link.write(CURTAIN, bytes.fromhex("FF 01 FF 01 FF 01"))
    for _ in range(0x0F):
        link.read(CURTAIN)
    device.reports.clear()
    assert link.read(CURTAIN) == bytes.fromhex("FF 01 FF 01 FF 01")
    (_, sent), (_, received) = device.reports
    assert sent == bytes.fromhex("C0 11 02 00 00 11").ljust(64, b"\0")
    assert received == bytes.fromhex("C0 11 06 00 FF 01 FF 01 FF 01").ljust(64, b"\0")

    device.reports.clear()
    link.write(CURTAIN, bytes.fromhex("FF 01 FF 01 FF 01"), acknowledged=False)
    assert list(device.reports) == [("out", bytes.fromhex("00 12 08 00 00 11 FF 01 FF 01 FF 01").ljust(64, b"\0"))]


def test_long_commands_go_on_in_reports_without_a_header():
    data = bytes(range(256)) * 2
    first, *rest = encode(0x1A2B, data, 7)
    assert first[:6] == bytes.fromhex("40 07 02 02 2B 1A")
    assert first[6:] == data[:58]
    assert b"".join(rest) == data[58:].ljust(64 * len(rest), b"\0")
    assert {len(report) for report in (first, *rest)} == {64}
    assert len(rest) == 8  # 454 bytes


def test_long_replies_are_put_together():
    device = chip()
    link, _ = connect(device)
    device._registers[0x1234] = bytes(range(200))
    assert link.read(0x1234) == bytes(range(200))


def test_a_late_answer_to_an_earlier_command_is_not_taken_for_this_one():
    device = chip()
    link, _ = connect(device)
    device._replies.append(bytes((0xC0, 99, 6, 0)) + b"stale!".ljust(60, b"\0"))
    link.write(CURTAIN, b"\1\2\3\4\5\6")
    assert link.read(CURTAIN) == b"\1\2\3\4\5\6"


def test_what_another_program_left_is_dropped_at_the_start():
    device = chip()
    device._replies.append(bytes((0xC0, 1, 6, 0)) + b"stale!".ljust(60, b"\0"))
    link, _ = connect(device)
    assert link.read(CURTAIN) == bytes(6)  # its number is 1 as well


def test_silence_is_a_lost_device_after_two_seconds():
    device = chip()
    link, _ = connect(device)
    device.faults.hang = True
    begun = device._clock.now()
    with pytest.raises(DeviceLostError, match="no answer to command 0x1100 within 2 s") as caught:
        link.read(CURTAIN)
    assert device._clock.now() - begun == pytest.approx(2.0)
    assert "switch it off and on" in caught.value.remedy


def test_a_pulled_cable_is_a_lost_device():
    device = chip()
    link, usb = connect(device)
    device.unplug()
    with pytest.raises(DeviceLostError, match="USB connection broke at command 0x1100"):
        link.read(CURTAIN)
    link.close()
    with pytest.raises(DeviceNotFoundError, match="there is: none"):
        link.open()
    device.plugged = True
    link.open()
    assert link.read(CURTAIN) == bytes(6)
    link.close()
    assert not usb.claimed


@pytest.mark.parametrize(
    ("fault", "text"),
    [("garbled", "reply begins with 5b"), ("misnumbered", "its reply has number 0, not 1")],
)
def test_a_wrong_answer_is_told_and_the_next_command_goes_through(fault, text):
    device = chip()
    link, _ = connect(device)
    setattr(device.faults, fault, 1)
    with pytest.raises(ProtocolError, match=text):
        link.read(CURTAIN)
    assert link.read(CURTAIN) == bytes(6)


def test_a_refusal_is_told():
    device = chip()
    link, _ = connect(device)
    device.faults.nack[CURTAIN] = 6
    with pytest.raises(RefusedCommandError, match="refused command 0x1100"):
        link.read(CURTAIN)
    assert link.read(CURTAIN) == bytes(6)


def test_the_kernel_s_driver_makes_room_and_gets_it_back():
    device = chip()
    link, usb = connect(device)
    assert not device.kernel_driver
    assert usb.claimed
    link.close()
    link.close()
    assert device.kernel_driver
    assert not usb.claimed
    with pytest.raises(DeviceLostError, match="connection is closed"):
        link.read(CURTAIN)


def test_a_projector_in_other_hands_is_busy_and_nothing_is_held():
    device = chip()
    device.taken = True
    usb = EmulatedUsb(device)
    link = UsbTransport("projector", 0xC900, None, VirtualClock(), usb)
    with pytest.raises(DeviceBusyError, match="another program holds it"):
        link.open()
    assert not usb.claimed
    assert device.kernel_driver


def test_a_missing_permission_comes_with_the_udev_rule():
    device = chip()
    device.permitted = False
    with pytest.raises(HardwareError, match="this user may not open it") as caught:
        connect(device)
    assert 'ATTR{idVendor}=="0451", ATTR{idProduct}=="c900"' in caught.value.remedy
    assert "udevadm control --reload" in caught.value.remedy


def test_serial_numbers_choose():
    one, two, other = chip(serial="A1"), chip(serial="A2"), EmulatedDlpc350(VirtualClock(), (64, 32), serial="A3")
    link, _ = connect(one, two, other, serial="A2")
    assert link.identity["usb_serial"] == "A2"
    two.faults.nack[CURTAIN] = 6
    with pytest.raises(RefusedCommandError):
        link.read(CURTAIN)
    with pytest.raises(DeviceNotFoundError, match=r"2 projectors are a DLPC900.*: A1, A2"):
        connect(one, two, other)
    with pytest.raises(DeviceNotFoundError, match=r"no DLPC900.* with serial number A3 .* there is: A1, A2"):
        connect(one, two, other, serial="A3")


def test_commands_keep_their_distance():
    clock = VirtualClock()
    device = EmulatedDlpc900(clock, (64, 32))
    link = UsbTransport("projector", 0xC900, None, clock, EmulatedUsb(device), gap_s=0.02)
    link.open()
    begun = clock.now()
    for _ in range(5):
        link.read(CURTAIN)
    assert clock.now() - begun == pytest.approx(0.08)


def test_discovery_lists_all_with_what_keeps_one_from_being_opened():
    good, hidden, none = chip(serial="A1"), chip(serial="A2"), EmulatedDlpc350(VirtualClock(), (64, 32), serial="")
    hidden.permitted = False
    usb = EmulatedUsb(good, hidden, none)
    found = discovery.find_projectors(usb)
    assert [(p.product_id, p.serial, p.accessible) for p in found] == [
        (0xC900, "A1", True),
        (0xC900, "", False),
        (0x6401, "", True),
    ]
    assert found[1].problem == "this user may not open it"
    assert discovery.UDEV_RULE in found[1].remedy
    assert str(found[0]) == "DLPC900 (LightCrafter 6500 or 9000), serial A1, at bus 1 address 2"
    assert not usb.claimed


def test_discovery_works_on_the_real_libusb():
    assert isinstance(discovery.find_projectors(), list)


def test_a_missing_libusb_is_told(monkeypatch):
    import usb.backend.libusb1

    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda find_library: None)
    with pytest.raises(MissingLibraryError, match=r"libusb 1\.0") as caught:
        discovery.find_projectors()
    assert "pip install" in caught.value.remedy


def test_the_udev_rule_lets_whoever_sits_there_in():
    lines = discovery.UDEV_RULE.splitlines()
    assert len(lines) == 2
    for line, product in zip(lines, ("6401", "c900"), strict=True):
        assert line == (
            f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="0451", ATTR{{idProduct}}=="{product}", MODE="0660", TAG+="uaccess"'
        )
    # logind gives the device away at 73-seat-late.rules; a later rule would come too late.
    assert int(discovery.UDEV_RULE_PATH.rsplit("/", 1)[1][:2]) < 73
