"""Serial ports as the operating system lists them, and what to type where they may not be opened."""

import sys
from types import SimpleNamespace

import pytest
from serial.tools import list_ports

from drivers import MissingLibraryError
from drivers.trigger_box.discovery import SerialPort, permission_remedy, serial_ports, udev_rule


def listed(device, **fields):
    known = {"description": "n/a", "vid": None, "pid": None, "serial_number": None}
    return SimpleNamespace(device=device, **(known | fields))


def test_ports_are_listed_usb_first(monkeypatch, tmp_path):
    there = tmp_path / "ttyACM1"
    there.touch()
    monkeypatch.setattr(
        list_ports,
        "comports",
        lambda: [
            listed("/dev/ttyS99"),
            listed("/dev/ttyUSB7", description=None, vid=0x1A86, pid=0x7523),
            listed(str(there), description="Pico - Board CDC", vid=0x2E8A, pid=0xA, serial_number="E66"),
        ],
    )
    assert serial_ports() == (
        SerialPort("/dev/ttyUSB7", "", "1a86:7523", None, False),
        SerialPort(str(there), "Pico - Board CDC", "2e8a:000a", "E66", True),
        SerialPort("/dev/ttyS99", "", None, None, False),
    )


def test_this_machine_can_be_asked():
    for port in serial_ports():
        assert port.path


def test_remedy_names_the_group_and_the_rule():
    remedy = permission_remedy("/dev/there-is-no-such-port", "2e8a:000a")
    assert "sudo usermod -aG dialout $USER" in remedy
    assert udev_rule("2e8a", "000a") in remedy
    assert "udev" not in permission_remedy("/dev/there-is-no-such-port")


def test_group_is_that_of_the_port(tmp_path):
    file = tmp_path / "port"
    file.touch()
    assert f"-aG {file.group()} " in permission_remedy(str(file))


def test_rule_is_one_line_of_matches_and_assignments():
    rule = udev_rule("2e8a", "000a")
    assert "\n" not in rule
    matches = [part.strip() for part in rule.split(",")]
    assert [part for part in matches if "==" in part] == [
        'SUBSYSTEM=="tty"',
        'ATTRS{idVendor}=="2e8a"',
        'ATTRS{idProduct}=="000a"',
    ]
    assert 'TAG+="uaccess"' in matches


def test_without_pyserial_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial.tools", None)
    with pytest.raises(MissingLibraryError, match="pyserial is not installed") as caught:
        serial_ports()
    assert caught.value.remedy == "pip install pyserial"
