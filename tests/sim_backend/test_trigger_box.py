"""The emulated boxes as a bench uses them: cables, time, threads. What they say is tested with the specification."""

import os
import statistics
import threading
import time

import psutil
import pytest
import serial
from windows import within

from sim_backend.clock import VirtualClock
from sim_backend.trigger_box import PrawnBlasterEmulator, SltBoxEmulator


@pytest.fixture
def wired():
    """An emulator and a port at its near end."""
    with SltBoxEmulator() as box, serial.Serial(box.port, timeout=20.0) as port:
        yield box, port


def ask(port, *commands):
    for command in commands:
        port.write(command.encode() + b"\n")
        answer = port.read_until(b"\n")
    return answer.decode().rsplit("*", 1)[0].strip()


def test_edge_becomes_a_pulse_well_below_a_millisecond(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH", "TRAIN 200 500 50 0", "ARM EXT0 RISING")
    heard = []
    box.on_pulse = lambda t_s: heard.append(time.monotonic())
    delays = []
    for _ in range(100):
        begun = time.monotonic()
        box.edge("EXT0", True)
        delays.append(heard[-1] - begun)
        time.sleep(1e-3)
    assert len(heard) == 100
    assert statistics.median(delays) < 0.3e-3


def test_pulses_of_a_train_come_at_their_times(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH", "TRAIN 10 5000 100 2000", "ARM")
    heard = []
    box.on_pulse = lambda t_s: heard.append(time.monotonic() - t_s)
    assert ask(port, "GO") == "OK 10"
    assert within(20.0, lambda: len(heard) == 10)
    steps = [later - earlier for earlier, later in zip(box.pulses, box.pulses[1:], strict=False)]
    assert steps == pytest.approx([5e-3] * 9, abs=5e-6)
    # The thread is woken by the system's timer: late by as much as that is, never early.
    assert min(heard) > -1e-4
    assert statistics.median(heard) < 15e-3, "a third of the train"


def test_camera_answers_a_pulse_from_within_its_callback(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH IN0 HIGH", "TRAIN 3 1000 100 0", "ARM EXT0 CHANGE")

    def expose(t_s):
        box.exposure(True, t_s)
        box.exposure(False, t_s)

    box.on_pulse = expose
    for rising in (True, False, True):
        box.edge("EXT0", rising)
        time.sleep(1.5e-3)
    assert ask(port, "STAT?").startswith("OK DONE,sent=3/3,in=3,edges=3,missed=0,")


def test_the_camera_has_the_pulse_before_the_host_has_the_answer(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH IN0 HIGH", "TRAIN 1 1000 100 0", "ARM")
    order = []

    def expose(t_s):
        time.sleep(0.02)
        order.append("camera")
        box.exposure(True)

    box.on_pulse = expose
    assert ask(port, "GO") == "OK 1"
    order.append("host")
    assert order == ["camera", "host"]
    assert ",in=1," in ask(port, "STAT?")


def test_runs_on_a_clock_that_is_given():
    clock = VirtualClock()
    with SltBoxEmulator(clock) as box, serial.Serial(box.port, timeout=20.0) as port:
        ask(port, "CFG OUT0 HIGH", "TRAIN 2 1000000 100 500000", "ARM")
        ask(port, "GO")
        time.sleep(0.02)
        assert box.pulses == []
        clock.sleep(0.6)
        ask(port, "STAT?")
        assert box.pulses == pytest.approx([0.5])
        clock.sleep(2.0)
        assert "sent=2/2" in ask(port, "STAT?")
        assert box.pulses == pytest.approx([0.5, 1.5])
        ask(port, "STOP", "TRAIN 1 1000 100 0", "ARM EXT0 RISING")
        box.edge("EXT0", True, 2.65)
        assert box.pulses[-1] == pytest.approx(2.65)


def test_has_no_other_input(wired):
    box, _ = wired
    with pytest.raises(ValueError, match="EXT1"):
        box.edge("EXT1", True)


def test_port_keeps_its_name_and_the_box_starts_anew_when_it_is_plugged_in(wired):
    box, port = wired
    name, end = box.port, os.readlink(box.port)
    ask(port, "CFG OUT0 HIGH", "TRAIN 2 1000 100 0")
    box.unplug()
    box.unplug()
    assert not os.path.lexists(name)
    with pytest.raises(serial.SerialException):
        port.read(1)
    box.edge("EXT0", True)
    taken = os.open(end, os.O_RDWR | os.O_NOCTTY) if os.path.exists(end) else None
    box.plug_in()
    if taken is not None:
        os.close(taken)
    assert box.port == name
    assert box.output is None
    with serial.Serial(name, timeout=20.0) as again:
        assert ask(again, "STAT?").startswith("OK RESET,sent=0/0")


def test_reboot_is_deaf_until_the_banner(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH")
    begun = time.monotonic()
    box.reboot(boot_s=0.5)
    port.write(b"STAT?\n")
    assert port.read_until(b"\n") == b"\n"
    assert time.monotonic() - begun > 0.45
    assert port.read_until(b"\n").startswith(b"!BOOT SLT,emulator,EMU1,1.0.0,1*")
    assert ask(port, "STAT?").startswith("OK RESET")


def test_a_host_that_does_not_read_blocks_nobody(wired):
    box, port = wired
    ask(port, "CFG OUT0 HIGH IN0 HIGH EVENTS ON", "TRAIN 1 1000 100 0", "ARM")
    for _ in range(2000):
        box.exposure(True)
        box.exposure(False)
    port.timeout = 0.2

    def answered():
        """What of the events still comes, comes before the answer, and may leave no room for it."""
        port.reset_input_buffer()
        port.write(b"STAT?\n")
        return any(b",in=2000," in line for line in iter(lambda: port.read_until(b"\n"), b""))

    assert within(20.0, answered)


@pytest.mark.parametrize("emulator", [SltBoxEmulator, PrawnBlasterEmulator])
def test_leaves_no_thread_no_descriptor_and_no_file(emulator):
    process = psutil.Process()
    threads, files = threading.active_count(), process.num_fds()
    for _ in range(5):
        with emulator() as box, serial.Serial(box.port) as port:
            port.write(b"version\n")
            path = box.port
        assert not os.path.exists(os.path.dirname(path))
    with emulator() as box:
        box.unplug()
    with pytest.raises(RuntimeError, match="test"), emulator():
        raise RuntimeError("test")
    assert (threading.active_count(), process.num_fds()) == (threads, files)


# --- PrawnBlaster, against its readme ---------------------------------------------------------------------------------


@pytest.fixture
def prawn():
    with PrawnBlasterEmulator() as box, serial.Serial(box.port, timeout=20.0) as port:

        def say(command):
            port.write(command.encode() + b"\r\n")
            answer = port.read_until(b"\r\n")
            assert answer.endswith(b"\r\n")
            return answer.decode().strip()

        yield box, say


def test_prawnblaster_answers_as_documented(prawn):
    _, say = prawn
    assert say("version").startswith("version: ")
    assert say("status") == "run-status:0 clock-status:0"
    assert say("set 0 0 4 1") == "half-period too short"
    assert say("set 0 0 5 0") == "invalid request"
    assert say("set 0 30000 5 1") == "invalid address"
    assert say("set 0 0 5") == "invalid request"
    assert say("nonsense").startswith("invalid request")
    assert say("set 0 0 5 1") == "ok"
    assert say("get 0 0") == "5 1"
    assert say("get 0 1") == "0 0"
    assert say("abort").startswith("Can only abort when status is 1 or 2")
    assert say("getwait 0 0") == "wait not yet available"


def test_prawnblaster_runs_a_program(prawn):
    box, say = prawn
    # Three pulses of 50 ms at 100 MHz, a wait of at most 100 ms, one pulse.
    for address, (half, repeats) in enumerate([(5_000_000, 3), (10_000_000, 0), (2_500_000, 1), (0, 0)]):
        assert say(f"set 0 {address} {half} {repeats}") == "ok"
    assert say("start") == "ok"
    assert say("status") == "run-status:2 clock-status:0"
    assert say("set 0 0 5 1").startswith("Cannot execute command set 0 0 5 1 during buffered execution")
    assert within(20.0, lambda: say("status") == "run-status:0 clock-status:0")
    begun = [pulse - box.pulses[0] for pulse in box.pulses]
    # A pulse lasts as long as the pause after it; the wait ran out.
    assert begun == pytest.approx([0, 0.1, 0.2, 0.4], abs=5e-6)
    assert say("getwait 0 0") == str(2**32 - 1)


def test_prawnblaster_waits_for_a_level(prawn):
    """The trap of its waits: a trigger that is still high when the next wait begins ends that as well."""
    box, say = prawn
    for address, (half, repeats) in enumerate([(50_000, 1), (2**32 - 1, 0), (2**32 - 1, 0), (50_000, 1), (0, 0)]):
        say(f"set 0 {address} {half} {repeats}")
    say("hwstart")
    box.strobe("EXT0")
    time.sleep(5e-3)
    assert say("status") == "run-status:2 clock-status:0"
    assert len(box.pulses) == 1
    box.strobe("EXT0")
    assert len(box.pulses) == 2
    assert within(20.0, lambda: say("status") == "run-status:0 clock-status:0")
    say("hwstart")
    box.edge("EXT0", True)
    assert within(20.0, lambda: say("status") == "run-status:0 clock-status:0")
    assert len(box.pulses) == 4
    box.edge("EXT0", False)
    say("hwstart")
    assert say("abort") == "ok"
    assert say("status") == "run-status:5 clock-status:0"
