"""The traps of harvesters and of producers, by their numbers in the project's list; 14 and 16 in test_genicam_parts.

Provoked with the simulated producer or with viky; where neither can, the test's docstring says so.
"""

import ctypes.util
import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import psutil
import pytest
from cameras import (
    counters,
    exposure_picture,
    free_running,
    running,
    shot,
    shot_until_fault,
    simulated,
    simulator,
    viky,
    wait_for,
)
from requirements import require

from drivers import (
    DeviceLostError,
    DeviceState,
    FrameLossError,
    FrameTimeoutError,
    IllegalCallError,
    MissingLibraryError,
    SystemClock,
)
from drivers.genicam import GenICamCamera, GenICamSettings
from drivers.genicam.discovery import discover
from drivers.genicam.producers import SEARCH_PATH
from sim_backend.gentl.feed import Fault


def in_a_program_of_its_own(code):
    """What a program prints as JSON; for what must not happen in the process of the tests."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_trap_1_a_fetch_ends_at_its_timeout(ready):
    camera, out, _ = ready
    began = time.monotonic()
    with pytest.raises(FrameTimeoutError, match=r"no frame within 0\.3 s"):
        camera.fetch(out, 0.3)
    assert 0.3 <= time.monotonic() - began < 5.0


def test_trap_2_incomplete_frames_do_not_prolong_a_fetch(ready):
    camera, out, world = ready
    assert world.inject(Fault.INCOMPLETE, 1, every=True, serial="A") == 1
    shot_until_fault(camera, out)
    began = time.monotonic()
    for _ in range(4):
        with pytest.raises(FrameLossError, match="incomplete"):
            shot(camera, out, timeout_s=20.0)
    assert time.monotonic() - began < 20.0
    world.inject(Fault.INCOMPLETE, 0, every=True, serial="A")
    camera.stop()  # what it was told before is heard before it ends


def test_trap_3_an_incomplete_frame_is_an_error_that_says_so(ready):
    camera, out, world = ready
    first = shot(camera, out)
    before = counters(camera)["incomplete"]
    world.inject(Fault.INCOMPLETE, 1, serial="A")
    stamp, error = shot_until_fault(camera, out)
    last = (stamp or first).frame_id
    assert isinstance(error, FrameLossError)
    assert error.message == f"{camera.name}: a frame after frame {last} was incomplete"
    assert counters(camera)["incomplete"] == before + 1
    # What was reported as incomplete is not reported as lost as well.
    assert shot(camera, out).frame_id == last + 2


def test_trap_3b_the_binding_is_not_loaded_where_it_could_hold_the_lock(world):
    """How much of the time a thread is stalled is measured in tests/benchmarks."""
    code = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent.parent)!r})
if __name__ == "__main__":
    import json
    from cameras import running, simulated
    with running(simulated(serial="C")) as (camera, out):
        camera.trigger(); camera.fetch(out, 5.0)
        print(json.dumps(sorted({{"harvesters", "genicam", "genicam.gentl"}} & set(sys.modules))))
"""
    assert in_a_program_of_its_own(code) == []


def give_more_than_the_ring_holds(camera, give, number):
    """Edges; further ones only when the ring of four is full, however busy the machine is."""
    before = counters(camera)["delivered"]
    give(4)
    wait_for(lambda: counters(camera)["delivered"] == before + 4)
    give(number - 4)


def test_trap_4_as_many_frames_wait_as_the_camera_says(streaming):
    camera, out, give = streaming
    assert camera.capacity == 20
    give_more_than_the_ring_holds(camera, give, camera.capacity)
    stamps = [camera.fetch(out, 10.0) for _ in range(camera.capacity)]
    assert [s.frame_id for s in stamps] == list(range(camera.capacity))
    assert np.array_equal(out, exposure_picture(out.shape, 8, camera.capacity - 1) % 256)
    assert counters(camera)["underrun"] == 0
    assert counters(camera)["ring_high_water"] == 4


def test_trap_4_frames_for_which_there_was_no_room_are_named(streaming):
    camera, out, give = streaming
    give_more_than_the_ring_holds(camera, give, camera.capacity + 5)
    good = []

    def fetch_all():
        while True:
            good.append(camera.fetch(out, 10.0).frame_id)

    with pytest.raises(FrameLossError, match=r"5 found no free buffer after frame \d+ \(underrun\)"):
        fetch_all()
    assert good == list(range(len(good)))
    assert counters(camera)["underrun"] == 5


def test_trap_5_a_frame_does_not_change_after_it_was_fetched(ready):
    camera, _, _ = ready
    frames = [np.empty((48, 64), np.uint16) for _ in range(60)]  # more than there are buffers and slots
    ids = [shot(camera, frame).frame_id for frame in frames]
    for number, frame in zip(ids, frames, strict=True):
        assert np.array_equal(frame, exposure_picture(frame.shape, 12, number))


def test_trap_6_a_late_frame_is_not_taken_for_the_next(ready):
    camera, out, world = ready
    world.inject(Fault.LATE, 1, serial="A")
    assert isinstance(shot_until_fault(camera, out, timeout_s=0.25)[1], FrameTimeoutError)
    asked_s = time.monotonic()
    for _ in range(3):
        stamp = shot(camera, out)
        # The simulated camera stamps with the clock of this machine.
        assert stamp.t_device_s > asked_s
        assert np.array_equal(out, exposure_picture(out.shape, 12, stamp.frame_id))
        time.sleep(0.2)
    assert counters(camera)["restarts"] >= 1


def test_trap_6_a_frame_that_nobody_asked_for_is_dropped(ready):
    camera, out, world = ready
    before = counters(camera)["unasked"]
    world.inject(Fault.STALE, 1, serial="A")
    camera.stop()
    camera.arm()
    asked_s = time.monotonic()
    camera.start()
    camera.trigger()  # at once, so that the stale frame may come after it
    stamp = camera.fetch(out, 10.0)
    assert stamp.t_device_s > asked_s
    assert stamp.frame_id == 1
    assert counters(camera)["unasked"] == before + 1


def test_trap_6_a_free_running_camera_gives_frames_that_began_later(world):
    rate = {"AcquisitionFrameRateEnable": True, "AcquisitionFrameRate": 100.0}
    with running(simulated(serial="C", trigger="free_run", exposure_us=5000.0, features=rate)) as (camera, out):
        for pause_s in (0.0, 0.003, 0.006, 0.1, 0.009):
            time.sleep(pause_s)
            asked_s = time.monotonic()
            assert shot(camera, out).t_device_s >= asked_s


def test_trap_7_ctrl_c_stays_with_this_program(ready):
    camera, out, _ = ready
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    os.kill(camera._process.pid, signal.SIGINT)
    assert shot(camera, out).frame_id >= 0


def test_trap_7_and_8_the_binding_leaves_its_process_as_it_was(world):
    code = f"""
import json, signal, warnings
from pathlib import Path
from drivers.genicam.library import kept_interrupt_handler, load_harvesters
from drivers.genicam.producers import load
filters, handler = list(warnings.filters), signal.getsignal(signal.SIGINT)
core = load_harvesters()
harvester, devices = load(Path({str(simulator())!r}))
with kept_interrupt_handler():
    acquirer = harvester.create(2)
    taken = signal.getsignal(signal.SIGINT) is not handler
same = [warnings.filters == filters, signal.getsignal(signal.SIGINT) is handler]
acquirer.destroy(); harvester.reset()
print(json.dumps([taken, *same]))
"""
    taken, filters_same, handler_same = in_a_program_of_its_own(code)
    assert taken, "this harvesters leaves Ctrl-C alone: the guard can go"
    assert filters_same
    assert handler_same


def test_trap_8_warnings_of_this_program_are_as_before(ready):
    camera, out, _ = ready
    shot(camera, out)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning):
            warnings.warn("still an error", stacklevel=1)


def test_trap_9_unplugging_is_seen_at_once_and_the_camera_comes_back(ready):
    camera, out, world = ready
    world.inject(Fault.DISCONNECT, 1, serial="A")
    began = time.monotonic()
    _, error = shot_until_fault(camera, out, timeout_s=60.0)
    assert time.monotonic() - began < 20.0
    assert isinstance(error, DeviceLostError)
    assert camera.name in error.message
    assert "cable" in error.remedy
    assert camera.state is DeviceState.FAULT
    with pytest.raises(IllegalCallError, match="FAULT"):
        camera.trigger()
    assert camera.describe()["state"] == "FAULT"
    camera.close()
    time.sleep(0.3)
    camera.open()
    camera.configure()
    camera.arm()
    camera.start()
    shot(camera, out)


def test_trap_10_looking_for_cameras_disturbs_none_that_is_open(ready, streaming):
    first, out, _ = ready
    second, small, give = streaming
    assert [device.serial for report in discover([simulator()]) for device in report.devices] == ["A", "B", "C"]
    shot(first, out)
    give(1)
    second.fetch(small, 10.0)
    assert (first.state, second.state) == (DeviceState.RUNNING, DeviceState.RUNNING)


def test_trap_11_a_closed_camera_says_that_it_is_closed():
    camera = free_running()
    camera.open()
    camera.configure()
    camera.close()
    for call in (camera.configure, camera.arm, camera.start, camera.trigger, camera.stop):
        with pytest.raises(IllegalCallError, match="CLOSED"):
            call()


def test_trap_12_a_producer_that_is_not_there_is_an_error(tmp_path):
    viky()
    camera = GenICamCamera(GenICamSettings(producer=tmp_path / "none.cti"), SystemClock())
    with pytest.raises(MissingLibraryError, match=r"there is no GenTL producer .*none\.cti"):
        camera.open()
    text = tmp_path / "text.cti"
    text.write_text("no library")
    reports = discover([tmp_path / "none.cti", text])
    assert "there is no GenTL producer" in reports[0].error
    assert "text.cti cannot be used" in reports[1].error


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A library that loads but has none of a producer's functions, in a folder of its own."""
    name = ctypes.util.find_library("m")
    require(name and sys.platform.startswith("linux"), "needs a shared library that is no producer: libm on Linux")
    path = tmp_path_factory.mktemp("broken") / "broken.cti"
    path.symlink_to(next(Path(ctypes_path) for ctypes_path in loaded_libraries() if Path(ctypes_path).name == name))
    return path


def loaded_libraries():
    ctypes.CDLL(ctypes.util.find_library("m"))
    lines = Path("/proc/self/maps").read_text().splitlines()
    return [line.split()[-1] for line in lines if "/" in line]


def test_trap_13_a_producer_that_crashes_takes_only_its_own_process_along(broken):
    viky()
    crashed, healthy = discover([broken, viky()])
    assert crashed.error == f"GenTL producer {broken}: its process was ended by SIGSEGV"
    assert crashed.devices == ()
    assert healthy.error is None
    assert [device.serial for device in healthy.devices] == ["0", "1", "2"]
    camera = GenICamCamera(GenICamSettings(producer=broken), SystemClock())
    with pytest.raises(DeviceLostError, match=rf"SIGSEGV, while {broken} was looking for it"):
        camera.open()
    assert camera.state is DeviceState.CLOSED


def test_trap_13_and_16_a_broken_producer_of_another_vendor_is_no_obstacle(broken, world, monkeypatch):
    monkeypatch.setenv(SEARCH_PATH, os.pathsep.join([str(broken.parent), str(simulator().parent)]))
    with running(GenICamCamera(GenICamSettings(serial="C", exposure_us=1000.0), SystemClock())) as (camera, out):
        shot(camera, out)
        assert camera.describe()["identity"]["producer"] == str(simulator())


def test_trap_13_a_crash_during_a_scan_is_named_and_the_camera_opens_again(ready):
    camera, out, world = ready
    world.inject(Fault.CRASH, 1, serial="A")
    _, error = shot_until_fault(camera, out)
    assert isinstance(error, DeviceLostError)
    assert error.message == f"{camera.name}: its process was ended by SIGSEGV"
    assert camera.state is DeviceState.FAULT
    camera.close()
    camera.open()
    camera.configure()
    camera.arm()
    camera.start()
    shot(camera, out)


def test_trap_15_starting_again_and_again_takes_no_more_memory(ready):
    """The leaks of some vendors' producers cannot be provoked; what they leave goes with the camera's process."""
    camera, out, _ = ready
    child = psutil.Process(camera._process.pid)

    def cycles(number):
        for _ in range(number):
            camera.stop()
            camera.arm()
            camera.start()
            shot(camera, out)
        return child.memory_info().rss

    warm = cycles(5)
    assert cycles(20) - warm < 2_000_000
    camera.close()
    assert not child.is_running()


def test_trap_17_a_running_camera_cannot_be_set():
    """viky would let its width be changed while it streams."""
    with running(free_running()) as (camera, out):
        with pytest.raises(IllegalCallError, match="RUNNING"):
            camera.configure()
        assert shot(camera, out).frame_id >= 0
