"""The PrawnBlaster driver on the emulated wire: what the conformance suite does not ask of every box."""

import time

import pytest

from drivers import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    ProtocolError,
    SequenceFaultError,
    SystemClock,
    TriggerCounts,
)
from drivers.trigger_box import PrawnBlasterBox, PrawnBlasterSettings, SerialPort
from sim_backend.trigger_box import PrawnBlasterEmulator, SltBoxEmulator

QUICK = {"reply_timeout_s": 0.3, "boot_timeout_s": 0.9}
"""Where an answer does not come."""
PATIENT = {"reply_timeout_s": 3.0, "boot_timeout_s": 10.0}
"""Where it does, as soon as the machine lets the emulator say it."""


@pytest.fixture
def emulator():
    with PrawnBlasterEmulator() as box:
        yield box


@pytest.fixture
def armed(emulator):
    drivers = []

    def arm(pulses=None, **settings):
        driver = PrawnBlasterBox(PrawnBlasterSettings(port=emulator.port, **(PATIENT | settings)), SystemClock())
        drivers.append(driver)
        driver.open()
        driver.configure()
        driver.arm(pulses)
        return driver

    yield arm
    for driver in drivers:
        driver.close()


def recovers(driver, emulator):
    driver.close()
    driver.open()
    driver.configure()
    driver.arm()
    before = len(emulator.pulses)
    driver.fire()
    assert len(emulator.pulses) - before == 1
    assert driver.counts() == TriggerCounts(1, None, 0)


def test_pulse_has_the_set_length(armed, emulator):
    programs = []
    take = emulator._firmware._commands["set"]
    emulator._firmware._commands["set"] = lambda *numbers: (programs.append(numbers), take(*numbers))[1]
    armed(pulse_us=250)
    # Half-period in cycles of 10 ns, once, then the end.
    assert programs == [(0, 0, 25_000, 1), (0, 1, 0, 0)]
    programs.clear()
    armed_again = PrawnBlasterBox(PrawnBlasterSettings(port=emulator.port), SystemClock())
    with pytest.raises(DeviceBusyError):
        armed_again.open()


def test_does_not_wait_for_an_edge_of_its_own_accord(armed, emulator):
    """Between edges there is no time limit: even after the longest wait no pulse comes unasked."""
    driver = armed(3)
    emulator.strobe("EXT0")
    time.sleep(2e-3)
    # The longest wait of the firmware is 42.9 s; its end is brought about here.
    with emulator._lock:
        emulator._started_s -= 60
    driver.counts()
    assert len(emulator.pulses) == 1
    assert driver.counts().sent <= 1
    for _ in range(2):
        emulator.strobe("EXT0")
        time.sleep(2e-3)
    assert len(emulator.pulses) == 3
    assert driver.counts() == TriggerCounts(3, None, 0)


def test_refuses_a_pulse_before_the_one_before_is_over(armed, emulator):
    driver = armed()
    # A long train is under way.
    emulator._firmware._set(0, 0, 10_000_000, 5)
    emulator._firmware._begin(triggered=False)
    with pytest.raises(SequenceFaultError, match="one before it was not over"):
        driver.fire()
    assert driver.counts().missed == 1


def test_pins_must_differ(emulator):
    driver = PrawnBlasterBox(PrawnBlasterSettings(port=emulator.port, input_pin=9), SystemClock())
    driver.open()
    with pytest.raises(DeviceSettingError, match="both 9"):
        driver.configure()
    driver.close()


def test_more_edges_than_the_firmware_can_await(armed):
    driver = armed()
    with pytest.raises(DeviceSettingError, match="101 edges") as caught:
        driver.arm(101)
    assert "SLT/1" in caught.value.remedy


@pytest.mark.parametrize("call", ["fire", "counts", "stop"])
def test_silent_in_mid_run(armed, emulator, call):
    driver = armed(5 if call == "counts" else None, **QUICK)
    emulator.faults.silent = True
    with pytest.raises(DeviceLostError, match="does not answer") as caught:
        getattr(driver, call)()
    assert caught.value.repeatable
    assert driver.state is DeviceState.FAULT
    emulator.faults.silent = False
    recovers(driver, emulator)


def test_garbled(armed, emulator):
    driver = armed()
    emulator.faults.garble_replies = 100
    with pytest.raises(ProtocolError, match="start was answered with") as caught:
        driver.fire()
    assert caught.value.remedy
    assert driver.state is DeviceState.FAULT
    emulator.faults.garble_replies = 0
    recovers(driver, emulator)


@pytest.mark.parametrize("fault", ["garble_replies", "halve_replies", "swallow_commands", "repeat_replies"])
def test_one_fault_in_a_question_is_got_over(armed, emulator, fault):
    driver = armed(5, **QUICK)
    setattr(emulator.faults, fault, 1)
    assert driver.counts().sent == 0
    assert driver.state is DeviceState.ARMED


def test_unplugged_and_back(armed, emulator):
    driver = armed()
    emulator.unplug()
    with pytest.raises(DeviceLostError, match="was lost"):
        driver.fire()
    driver.close()
    with pytest.raises(DeviceNotFoundError, match="no such port"):
        driver.open()
    emulator.plug_in()
    recovers(driver, emulator)


def test_another_device_at_the_port():
    with SltBoxEmulator() as other:
        driver = PrawnBlasterBox(PrawnBlasterSettings(port=other.port, **QUICK), SystemClock())
        with pytest.raises(DeviceNotFoundError, match="no PrawnBlaster answers") as caught:
            driver.open()
        assert "Flash" in caught.value.remedy
        assert driver.state is DeviceState.CLOSED


def test_found_by_its_answer(emulator):
    with SltBoxEmulator() as other:
        ports = [SerialPort(box.port, "Pico", "2e8a:000a", None, True) for box in (other, emulator)]
        driver = PrawnBlasterBox(PrawnBlasterSettings(**QUICK), SystemClock(), ports=lambda: ports)
        driver.open()
        assert driver.describe()["port"] == emulator.port
        driver.close()
