"""The SLT/1 driver on the emulated wire: what it sets, and every fault it has to survive or to refuse."""

from __future__ import annotations

import json
import os
import threading
import time
from contextlib import contextmanager

import psutil
import pytest
import serial
from pydantic import ValidationError

from drivers import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    HardwareError,
    ProtocolError,
    SequenceFaultError,
    SystemClock,
    TriggerCounts,
)
from drivers.trigger_box import SerialPort, SltSettings, SltTriggerBox
from sim_backend.trigger_box import PrawnBlasterEmulator, SltBoxEmulator

QUICK = {"reply_timeout_s": 0.3, "boot_timeout_s": 0.9}
"""Where an answer does not come."""
PATIENT = {"reply_timeout_s": 3.0, "boot_timeout_s": 10.0}
"""Where it does, as soon as the machine lets the emulator say it."""


@pytest.fixture
def emulator():
    with SltBoxEmulator() as box:
        yield box


@pytest.fixture
def make(emulator):
    """Drivers on the emulator's port, closed at the end."""
    made = []

    def make(**settings):
        driver = SltTriggerBox(SltSettings(**({"port": emulator.port} | PATIENT | settings)), SystemClock())
        made.append(driver)
        return driver

    yield make
    for driver in made:
        driver.close()


@pytest.fixture
def armed(make):
    """A box that is armed for single pulses, with a camera that reports back."""

    def arm(pulses=None, **settings):
        driver = make(**settings)
        driver.open()
        driver.configure()
        driver.arm(pulses)
        return driver

    return arm


@contextmanager
def told(error, *words):
    """An error whose message names the device and the words, and whose remedy says what to do."""
    with pytest.raises(error) as caught:
        yield caught
    for word in ("SLT trigger box", *words):
        assert word in caught.value.message
    assert len(caught.value.remedy) > 20
    if error is not HardwareError:
        assert type(caught.value) is error


def report_exposures(emulator, *, but=()):
    """A camera that answers each pulse with an exposure, but those numbers."""

    def expose(t_s):
        if len(emulator.pulses) not in but:
            emulator.exposure(True)
            emulator.exposure(False)

    emulator.on_pulse = expose


# --- what is set ------------------------------------------------------------------------------------------------------


def test_proves_that_each_pulse_became_an_exposure(armed, emulator):
    report_exposures(emulator)
    driver = armed(24)
    for _ in range(24):
        emulator.strobe("EXT0")
        time.sleep(1.5e-3)
    assert driver.counts() == TriggerCounts(24, 24, 0)


def test_a_pulse_without_exposure_shows_in_the_counts(armed, emulator):
    report_exposures(emulator, but=(3,))
    driver = armed()
    for _ in range(5):
        driver.fire()
        time.sleep(2e-3)
    assert driver.counts() == TriggerCounts(5, 4, 0)


def test_an_exposure_without_pulse_shows_in_the_counts(armed, emulator):
    report_exposures(emulator)
    driver = armed()
    driver.fire()
    emulator.exposure(True)
    assert driver.counts() == TriggerCounts(1, 2, 0)


def test_an_edge_that_comes_too_early_shows_in_the_counts(armed, emulator):
    driver = armed(5, min_period_us=200_000)
    for _ in range(3):
        emulator.strobe("EXT0")
    counts = driver.counts()
    assert (counts.sent, counts.missed) == (1, 2)


def test_without_count_back_exposures_are_not_known(armed, emulator):
    report_exposures(emulator)
    driver = armed(count_back=False)
    driver.fire()
    assert driver.counts() == TriggerCounts(1, None, 0)


def test_pulse_has_the_set_length_and_delay(armed, emulator):
    moves = []
    drive = emulator._firmware._drive
    emulator._firmware._drive = lambda level, t_us: (moves.append((level, t_us)), drive(level, t_us))
    driver = armed(1, pulse_us=300, delay_us=5000, min_period_us=20_000)
    moves.clear()
    given = time.monotonic()
    emulator.edge("EXT0", True, given)
    while driver.counts().sent == 0 or emulator.output == "HIGH":
        time.sleep(1e-3)
    (rise, t_rise), (fall, t_fall) = moves
    assert (rise, fall, t_fall - t_rise) == ("HIGH", "LOW", 300)
    assert emulator.pulses[0] - given == pytest.approx(5e-3, abs=5e-6)


@pytest.mark.parametrize(
    ("edge", "rising", "falling"), [("rising", 1, 0), ("falling", 0, 1), ("change", 1, 1)], ids=str
)
def test_answers_the_set_edge(armed, emulator, edge, rising, falling):
    driver = armed(9, edge=edge)
    emulator.edge("EXT0", True)
    assert driver.counts().sent == rising
    time.sleep(2e-3)
    emulator.edge("EXT0", False)
    assert driver.counts().sent == rising + falling


def test_active_low_output_and_exposure_line():
    with SltBoxEmulator(trigger_on="FALLING") as emulator:
        driver = SltTriggerBox(SltSettings(port=emulator.port, output_level="low", exposure_level="low"), SystemClock())
        assert emulator.output is None
        driver.open()
        assert emulator.output is None
        driver.configure()
        assert emulator.output == "HIGH"
        emulator.exposure(True)
        driver.arm()
        assert emulator.pulses == []
        driver.fire()
        emulator.exposure(False)
        assert driver.counts() == TriggerCounts(1, 1, 0)
        assert len(emulator.pulses) == 1
        driver.close()
        assert emulator.output == "HIGH"


def test_refuses_a_pulse_before_the_one_before_is_over(armed, emulator):
    driver = armed(min_period_us=500_000)
    driver.fire()
    with told(SequenceFaultError, "500000 µs"):
        driver.fire()
    assert driver.state is DeviceState.ARMED
    assert driver.counts().missed == 1
    assert len(emulator.pulses) == 1


def test_times_beyond_the_boards_limits_are_refused(make, emulator):
    emulator._firmware._do = lambda command, do=emulator._firmware._do: (
        "n=1-100,period=100-65000,width=50-20000,delay=0-9" if command == "CAP?" else do(command)
    )
    for settings, words in (
        ({"pulse_us": 20}, ("pulse_us is 20", "50 to 20000")),
        ({"delay_us": 10}, ("delay_us is 10", "0 to 9")),
        ({"min_period_us": 66_000}, ("min_period_us is 66000", "100 to 65000")),
    ):
        driver = make(**settings)
        driver.open()
        with told(DeviceSettingError, *words):
            driver.configure()
        driver.close()


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValidationError, match="pulse_us"):
        SltSettings(pulse_us=1000, min_period_us=1000)
    with pytest.raises(ValidationError, match="port and serial_number"):
        SltSettings(port="/dev/ttyACM0", serial_number="E66")


def test_describes_box_line_and_counts(armed, emulator):
    driver = armed()
    driver.fire()
    driver.counts()
    told = json.loads(json.dumps(driver.describe()))
    assert told["identity"] == {"board": "emulator", "serial": "EMU1", "firmware": "1.0.0", "protocol": "1"}
    assert told["limits"]["n"] == [1, 65535]
    assert told["counts"]["sent"] == 1
    assert told["line"] == {"repeated": 0, "garbled": 0, "stray": 0}


# --- what goes wrong on the line, and is got over ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault", ["swallow_commands", "garble_commands", "garble_replies", "halve_replies", "repeat_replies"]
)
def test_one_fault_on_the_line_costs_no_pulse_and_gives_none_too_many(armed, emulator, fault):
    report_exposures(emulator)
    driver = armed(**QUICK)
    for number in range(1, 4):
        setattr(emulator.faults, fault, 1)
        driver.fire()
        time.sleep(2e-3)
        assert driver.counts() == TriggerCounts(number, number, 0)
    assert len(emulator.pulses) == 3
    line = driver.describe()["line"]
    assert line["repeated"] == (0 if fault == "repeat_replies" else 3)
    assert line["stray"] == (3 if fault == "repeat_replies" else 0)


def test_a_late_answer_is_not_taken_for_another(armed, emulator):
    driver = armed(**QUICK)
    say = emulator._firmware._send
    emulator._firmware._send = lambda line: threading.Timer(0.4, emulator.say, (line,)).start()
    driver.fire()
    emulator._firmware._send = say
    time.sleep(0.5)
    assert driver.counts().sent == 1
    assert len(emulator.pulses) == 1
    assert driver.describe()["line"]["stray"] > 0


@pytest.mark.parametrize(
    "noise", [b"\xff\x00\x80garbage\n", b"garbage without end", b"\n\n\r\n", b"!EDGE IN0 1 5*F2\n"]
)
def test_noise_between_answers_is_passed_over(armed, emulator, noise):
    driver = armed()
    emulator.say(noise)
    driver.fire()
    emulator.say(noise)
    time.sleep(2e-3)
    assert driver.counts().sent == 1


def test_waits_for_a_board_that_restarts_when_its_port_is_opened(make, emulator):
    driver = make(boot_timeout_s=20.0)
    begun = time.monotonic()
    emulator.reboot(boot_s=0.2)
    driver.open()
    assert 0.15 < time.monotonic() - begun < 19.0
    driver.configure()
    driver.arm()
    driver.fire()
    assert driver.counts().sent == 1


def test_stops_a_box_that_a_crashed_scan_has_left_running(make, emulator):
    first = make()
    first.open()
    first.configure()
    first.arm(5)
    first._session.close()  # as the kernel does when the process is killed
    second = make()
    second.open()
    emulator.edge("EXT0", True)
    assert emulator.pulses == []


# --- what ends in an error --------------------------------------------------------------------------------------------


def recovers(driver, emulator):
    """The box gives pulses again after close and open."""
    driver.close()
    driver.open()
    driver.configure()
    driver.arm()
    before = len(emulator.pulses)
    driver.fire()
    assert driver.counts().sent == 1
    assert len(emulator.pulses) - before == 1


def test_silent_from_the_beginning(make, emulator):
    emulator.faults.silent = True
    driver = make(**QUICK)
    with told(DeviceNotFoundError, emulator.port, "nothing answers within 0.9 s"):
        driver.open()
    assert driver.state is DeviceState.CLOSED
    emulator.faults.silent = False
    recovers(driver, emulator)


@pytest.mark.parametrize("call", ["fire", "counts", "stop"])
def test_silent_in_mid_run(armed, emulator, call):
    driver = armed(**QUICK)
    emulator.faults.silent = True
    begun = time.monotonic()
    with told(DeviceLostError, emulator.port, "does not answer any more", "3 times") as caught:
        getattr(driver, call)()
    assert time.monotonic() - begun < 5.0
    assert caught.value.repeatable
    assert driver.state is DeviceState.FAULT
    driver.stop()
    emulator.faults.silent = False
    recovers(driver, emulator)


def test_garbled_for_good(armed, emulator):
    driver = armed()
    emulator.faults.garble_replies = 1000
    with told(ProtocolError, "cannot be read", "GO was sent 3 times", "#"):
        driver.fire()
    assert driver.state is DeviceState.FAULT
    emulator.faults.garble_replies = 0
    recovers(driver, emulator)


def test_restart_in_mid_run_is_announced(armed, emulator):
    driver = armed()
    driver.fire()
    emulator.reboot()
    with told(DeviceLostError, "has restarted", "before it answered GO") as caught:
        driver.fire()
    assert caught.value.repeatable
    assert driver.state is DeviceState.FAULT
    assert len(emulator.pulses) == 1
    recovers(driver, emulator)


@pytest.mark.parametrize("call", ["fire", "counts", "arm"])
def test_restart_in_mid_run_whose_banner_is_lost(armed, emulator, call):
    driver = armed()
    emulator.faults.silent = True
    emulator.reboot()
    emulator.faults.silent = False
    with told(DeviceLostError, "has restarted"):
        getattr(driver, call)()
    assert driver.state is DeviceState.FAULT
    recovers(driver, emulator)


def test_unplugged_in_mid_run_and_back(armed, emulator):
    driver = armed()
    emulator.unplug()
    with told(DeviceLostError, emulator.port, "was lost") as caught:
        driver.fire()
    assert caught.value.repeatable
    assert driver.state is DeviceState.FAULT
    driver.close()
    with told(DeviceNotFoundError, emulator.port, "no such port"):
        driver.open()
    emulator.plug_in()
    recovers(driver, emulator)


def test_unplugged_while_an_answer_is_awaited(armed, emulator):
    driver = armed(reply_timeout_s=10.0)
    emulator.faults.silent = True
    threading.Timer(0.05, emulator.unplug).start()
    begun = time.monotonic()
    with told(DeviceLostError, "was lost"):
        driver.fire()
    assert time.monotonic() - begun < 8.0


def test_another_version_of_the_protocol():
    with SltBoxEmulator(identity="SLT,rp2040,E66,2.1.0,2") as emulator:
        driver = SltTriggerBox(SltSettings(port=emulator.port, **QUICK), SystemClock())
        with told(HardwareError, "firmware 2.1.0 on rp2040", "SLT/2", "SLT/1"):
            driver.open()
        assert driver.state is DeviceState.CLOSED


def test_another_device_at_the_port():
    with PrawnBlasterEmulator() as emulator:
        driver = SltTriggerBox(SltSettings(port=emulator.port, **QUICK), SystemClock())
        with told(DeviceNotFoundError, "no SLT box", "invalid request"):
            driver.open()


def test_answer_that_is_no_number_of_a_pulse(armed, emulator):
    driver = armed()
    emulator._firmware._go = lambda: "17"
    with told(ProtocolError, "GO number 1", "'17'"):
        driver.fire()
    assert driver.state is DeviceState.FAULT


def test_port_held_by_another_program(make, emulator):
    with serial.Serial(emulator.port, exclusive=True):
        driver = make()
        with told(DeviceBusyError, emulator.port, "another program") as caught:
            driver.open()
    assert f"fuser {emulator.port}" in caught.value.remedy
    driver.open()


def test_port_that_this_user_may_not_open(make, emulator):
    folder = os.path.dirname(emulator.port)
    driver = make()
    mode = os.stat(folder).st_mode
    # Root may open anything, so it steps down to a user who may not.
    user = os.geteuid()
    os.chmod(folder, 0)
    try:
        if user == 0:
            os.seteuid(65534)
        with told(HardwareError, emulator.port, "may not open") as caught:
            driver.open()
    finally:
        if user == 0:
            os.seteuid(0)
        os.chmod(folder, mode)
    assert "usermod -aG" in caught.value.remedy
    driver.open()


def test_port_that_udev_has_not_dealt_with_yet(make, emulator, monkeypatch):
    """A port belongs to root for a moment after it was plugged in; that is no reason to give up."""
    attempts = []
    real = os.open

    def forbidden_at_first(path, *arguments):
        if path == emulator.port and not attempts:
            attempts.append(path)
            raise PermissionError(13, "Permission denied")
        return real(path, *arguments)

    monkeypatch.setattr(os, "open", forbidden_at_first)
    make().open()
    assert attempts == [emulator.port]


def test_port_that_is_no_port(make, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with told(HardwareError, str(file), "cannot be opened"):
        make(port=str(file)).open()


# --- finding it -------------------------------------------------------------------------------------------------------


def usb(path, serial_number, usb_id="2e8a:000a"):
    return SerialPort(path, "Pico", usb_id, serial_number, True)


def test_found_by_serial_number_wherever_it_is_plugged_in(emulator):
    ports = [usb("/dev/ttyACM0", "A"), usb(emulator.port, "B")]
    driver = SltTriggerBox(SltSettings(serial_number="B", **QUICK), SystemClock(), ports=lambda: ports)
    driver.open()
    driver.configure()
    driver.arm()
    with SltBoxEmulator() as elsewhere:
        emulator.unplug()
        with told(DeviceLostError):
            driver.fire()
        ports[1] = usb(elsewhere.port, "B")
        recovers(driver, elsewhere)
        assert driver.describe()["port"] == elsewhere.port
        driver.close()


def test_found_by_its_answer_among_other_ports(emulator, tmp_path):
    with PrawnBlasterEmulator() as other:
        ports = [usb(other.port, None), usb(str(tmp_path / "gone"), None), usb(emulator.port, None)]
        ports.append(SerialPort("/dev/ttyS0", "", None, None, True))
        driver = SltTriggerBox(SltSettings(**QUICK), SystemClock(), ports=lambda: ports)
        driver.open()
        assert driver.describe()["port"] == emulator.port
        driver.close()


def test_several_or_none_are_listed(emulator):
    with SltBoxEmulator() as second:
        ports = [usb(emulator.port, "A"), usb(second.port, "B")]
        driver = SltTriggerBox(SltSettings(**QUICK), SystemClock(), ports=lambda: ports)
        with told(DeviceNotFoundError, "several fit", emulator.port, second.port, "serial number B"):
            driver.open()
    driver = SltTriggerBox(SltSettings(serial_number="C"), SystemClock(), ports=lambda: ports)
    with told(DeviceNotFoundError, "none with serial number C", emulator.port, "2e8a:000a"):
        driver.open()
    driver = SltTriggerBox(SltSettings(), SystemClock(), ports=list)
    with told(DeviceNotFoundError, "none that answers", "USB serial ports: none"):
        driver.open()


def test_every_failed_open_lets_the_port_go(make, emulator):
    process = psutil.Process()
    files, threads = process.num_fds(), threading.active_count()
    emulator.faults.silent = True
    for _ in range(3):
        with told(DeviceNotFoundError):
            make(reply_timeout_s=0.1, boot_timeout_s=0).open()
    emulator.faults.silent = False
    driver = make()
    driver.open()
    emulator.unplug()
    driver.close()
    emulator.plug_in()
    assert (process.num_fds(), threading.active_count()) == (files, threads)
