"""What goes wrong with a camera and its frames, through the whole driver; see test_genicam_traps for the rest."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cameras import (
    counters,
    exposure_picture,
    free_running,
    left_behind,
    running,
    shot,
    shot_until_fault,
    simulated,
    simulator,
    wait_for,
)

from drivers import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    FrameLossError,
    FrameTimeoutError,
    NoiseModel,
)
from drivers.genicam.discovery import discover
from sim_backend.gentl.feed import Fault


def is_right(out, stamp, bits):
    return np.array_equal(out, exposure_picture(out.shape, bits, stamp.frame_id))


@pytest.mark.parametrize("fault", [Fault.MISS_TRIGGER, Fault.DROP])
def test_a_frame_that_never_comes_is_a_timeout_with_the_counters(ready, fault):
    camera, out, world = ready
    world.inject(fault, 1, serial="A")
    _, error = shot_until_fault(camera, out, timeout_s=0.5)
    assert isinstance(error, FrameTimeoutError)
    assert re.search(r"no frame within 0\.5 s \(\d+ delivered, ", error.message)
    assert "exposure and read-out" in error.remedy
    for _ in range(3):
        assert is_right(out, shot(camera, out), 12)


def test_a_truncated_frame_is_never_given_out(ready):
    camera, out, world = ready
    out[:] = 7
    before = out.copy()
    world.inject(Fault.TRUNCATE, 1, serial="A")
    last, error = shot_until_fault(camera, out)
    assert isinstance(error, FrameLossError)
    words = "was incomplete (the buffer holds 3072 bytes, the picture 6144)"
    assert f"frame {0 if last is None else last.frame_id + 1} {words}" in error.message
    # What stands there is the good frame before it, untouched.
    assert np.array_equal(out, before) if last is None else is_right(out, last, 12)
    assert is_right(out, shot(camera, out), 12)


def test_a_frame_of_another_size_is_never_given_out(ready):
    camera, out, world = ready
    before = counters(camera)["malformed"]
    world.inject(Fault.WRONG_SIZE, 1, serial="A")
    _, error = shot_until_fault(camera, out)
    assert isinstance(error, FrameLossError)
    assert re.search(r"frame \d+ is 64 × 24 px Mono12, not 64 × 48 px Mono12", error.message)
    assert counters(camera)["malformed"] == before + 1
    assert is_right(out, shot(camera, out), 12)


def test_frame_numbers_that_jump_are_named(ready):
    camera, out, world = ready
    first = shot(camera, out)
    before = counters(camera)["lost"]
    world.inject(Fault.ID_JUMP, 1, serial="A")
    last, error = shot_until_fault(camera, out)
    number = (last or first).frame_id
    assert isinstance(error, FrameLossError)
    assert f"frames {number + 1} to {number + 3} did not arrive (3 missing)" in error.message
    assert counters(camera)["lost"] == before + 3
    assert shot(camera, out).frame_id == number + 5


def test_a_frame_that_comes_twice_does_not_shift_the_next_ones(ready):
    camera, out, world = ready
    before = counters(camera)["unasked"]
    world.inject(Fault.DUPLICATE, 1, serial="A")
    stamps = []
    while counters(camera)["unasked"] == before or len(stamps) < 4:
        asked_s = time.monotonic()
        stamps.append(shot(camera, out))
        assert stamps[-1].t_device_s > asked_s
        assert is_right(out, stamps[-1], 12)
        assert len(stamps) < 100
        time.sleep(0.02)
    assert [s.frame_id for s in stamps] == list(range(len(stamps)))
    assert counters(camera)["unasked"] == before + 1


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault.DROP, "frame 2 did not arrive (1 missing)"),
        (Fault.DUPLICATE, "frame 2 came twice"),
        (Fault.INCOMPLETE, "a frame after frame 1 was incomplete"),
        (Fault.TRUNCATE, "frame 2 was incomplete"),
        (Fault.WRONG_SIZE, "frame 2 is 64 × 24 px Mono8"),
    ],
)
def test_in_a_burst_a_fault_stands_where_its_frame_would(streaming, world, fault, words):
    camera, out, give = streaming
    world.inject(fault, 3, serial="B")
    give(6)  # on the line on which it has just been told of the fault
    came = []
    for number in range(6):
        nothing_more = fault is Fault.DROP and number == 5
        try:
            came.append(camera.fetch(out, 0.5 if nothing_more else 10.0).frame_id)
        except FrameLossError as error:
            came.append(error.message)
        except FrameTimeoutError:
            came.append(None)
    if fault is Fault.DUPLICATE:
        assert came[:3] == [0, 1, 2]
        assert words in came[3]
        assert came[4:] == [3, 4]
    elif fault is Fault.DROP:
        # The frame that shows the gap is not usable either: nobody could say whose place it takes.
        assert came[:2] == [0, 1]
        assert words in came[2]
        assert came[3:] == [4, 5, None]
    else:
        assert came[:2] == [0, 1]
        assert words in came[2]
        assert came[3:] == [3, 4, 5]


def test_a_missed_edge_leaves_one_frame_less(streaming, world):
    """Nothing in the frames tells; the counts of the trigger box do."""
    camera, out, give = streaming
    world.inject(Fault.MISS_TRIGGER, 2, serial="B")
    give(4)
    assert [camera.fetch(out, 10.0).frame_id for _ in range(3)] == [0, 1, 2]
    with pytest.raises(FrameTimeoutError, match=r"Check that the trigger reaches the camera"):
        camera.fetch(out, 0.1)


def test_a_camera_on_a_line_takes_no_software_trigger(streaming):
    camera, out, give = streaming
    with pytest.raises(DeviceSettingError, match="camera B is triggered by an edge"):
        camera.trigger()
    give(1)
    assert is_right(out, camera.fetch(out, 10.0), 8)


def test_unplugged_while_nobody_looks_is_seen_at_the_next_call(ready):
    camera, _, world = ready
    world.inject(Fault.DISCONNECT, 1, serial="A")

    def trigger_only():
        for _ in range(100):  # the first may come before the camera knows of its fate
            camera.trigger()
            time.sleep(0.1)

    with pytest.raises(DeviceLostError, match="camera A: "):
        trigger_only()
    assert camera.state is DeviceState.FAULT
    camera.close()
    assert camera.state is DeviceState.CLOSED


def test_a_camera_that_is_away_is_not_found_until_it_is_back(world):
    with running(simulated(serial="C")) as (camera, out):
        wait_for(lambda: "C" in world.cameras)
        world.inject(Fault.DISCONNECT, 1, serial="C")
        assert isinstance(shot_until_fault(camera, out)[1], DeviceLostError)
        camera.close()
        with pytest.raises(DeviceNotFoundError, match="no camera has serial 'C'") as caught:
            camera.open()
        assert "serial A" in caught.value.message
        assert camera.state is DeviceState.CLOSED
        (Path(os.environ["MFS_SIM_GENTL_DIR"]) / "C.unplugged").unlink()
        camera.open()
        camera.configure()
        camera.arm()
        camera.start()
        assert is_right(out, shot(camera, out), 8)


def test_a_camera_that_another_process_holds_is_busy(ready):
    camera, out, _ = ready
    second = simulated(serial="A")
    with pytest.raises(DeviceBusyError, match="camera A is held by another program") as caught:
        second.open()
    assert "Close" in caught.value.remedy
    assert "in use" in caught.value.message
    assert second.state is DeviceState.CLOSED
    assert shot(camera, out).frame_id >= 0
    access = {device.serial: device.access for device in discover([simulator()])[0].devices}
    assert access["A"] == "in use"


def test_a_killed_scan_leaves_the_camera_free_and_nothing_behind(world):
    code = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent.parent)!r})
if __name__ == "__main__":
    from cameras import running, simulated
    with running(simulated(serial="C")) as (camera, out):
        camera.trigger(); camera.fetch(out, 5.0)
        print("running", flush=True)
        sys.stdin.read()
"""
    before = left_behind()
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdout.readline() == b"running\n"
        program.kill()
    wait_for(lambda: discover([simulator()])[0].devices[2].access == "free")
    wait_for(lambda: left_behind() == before)


def test_a_description_holds_identity_settings_features_and_counters(ready):
    camera, out, _ = ready
    shot(camera, out)
    snapshot = json.loads(json.dumps(camera.describe(), allow_nan=False))
    assert snapshot["identity"]["serial"] == "A"
    assert snapshot["identity"]["model"] == "MFS Sim"
    assert snapshot["identity"]["producer"] == str(simulator())
    assert snapshot["settings"]["pixel_format"] == "Mono12"
    assert snapshot["features"]["ExposureTime"] == 1000.0
    assert snapshot["features"]["DeviceTemperature"] > 0
    assert snapshot["counters"]["delivered"] >= 1
    camera.stop()
    assert camera.describe()["features"] == snapshot["features"]


def test_what_a_camera_rounds_is_in_its_description():
    camera = free_running(features={"AcquisitionFrameRate": 61.5})
    with running(camera):
        made = camera.describe()["features"]["AcquisitionFrameRate"]
        assert camera.describe()["rounded"] == {"AcquisitionFrameRate": {"asked": 61.5, "made": made}}


def test_settings_that_are_refused_leave_an_open_camera(world):
    camera = simulated(serial="C", exposure_us=1.0)
    try:
        camera.open()
        with pytest.raises(DeviceSettingError, match="camera C: ExposureTime cannot be 1"):
            camera.configure()
        assert camera.state is DeviceState.OPEN
    finally:
        camera.close()


def test_the_noise_model_is_what_the_file_says():
    assert simulated().noise is None
    assert simulated(read_noise_dn=1.5).noise == NoiseModel(1.5)
    assert simulated(read_noise_dn=1.5, electrons_per_dn=4.0).noise == NoiseModel(1.5, 0.25)
