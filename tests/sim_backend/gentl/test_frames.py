"""Frames of the simulated producer: pixels, time stamps, ids, limits, buffers."""

from __future__ import annotations

import time

import numpy as np
import psutil
import pytest
from stock_harvesters import (
    camera,
    documented_picture,
    genapi,
    gentl,
    good,
    next_frame,
    shoot,
    software_triggered,
    wait_for,
)

from sim_backend.gentl import SimulatedCameraId


def unpacked(raw, name, count):
    """Pixels of a buffer by the letter of PFNC: a plain loop over bits, nothing of harvesters."""
    if name == "Mono8":
        return np.frombuffer(raw, np.uint8, count).astype(int)
    if name in ("Mono10", "Mono12", "Mono16"):
        return np.array([raw[2 * i] + 256 * raw[2 * i + 1] for i in range(count)])
    if name == "Mono12Packed":
        halves = [
            (raw[3 * i] << 4 | raw[3 * i + 1] & 15, raw[3 * i + 2] << 4 | raw[3 * i + 1] >> 4)
            for i in range(count // 2)
        ]
        return np.array(halves).ravel()
    bits = int(name[4:6])
    stream = int.from_bytes(raw, "little")
    return np.array([stream >> bits * i & (1 << bits) - 1 for i in range(count)])


@pytest.mark.parametrize(
    ("name", "bits", "bytes_per_frame"),
    [
        ("Mono8", 8, 48 * 20),
        ("Mono10", 10, 2 * 48 * 20),
        ("Mono12", 12, 2 * 48 * 20),
        ("Mono16", 16, 2 * 48 * 20),
        ("Mono10p", 10, 48 * 20 * 5 // 4),
        ("Mono12p", 12, 48 * 20 * 3 // 2),
        ("Mono12Packed", 12, 48 * 20 * 3 // 2),
    ],
)
def test_pixels_of_every_format(folder, name, bits, bytes_per_frame):
    with camera(folder, SimulatedCameraId(width_px=4096, height_px=512)) as acquirer:
        nodes = software_triggered(acquirer)
        nodes.PixelFormat.value = name
        nodes.Width.value, nodes.Height.value = 48, 20
        nodes.OffsetX.value, nodes.OffsetY.value = 4000, 386  # so that all bits are seen
        nodes.BlackLevel.value = 7.0
        assert nodes.PayloadSize.value == bytes_per_frame
        acquirer.start()
        for number in range(3):
            nodes.TriggerSoftware.execute()
            raw = acquirer.fetch(timeout=20.0, is_raw=True)
            expected = documented_picture(48, 20, bits, number, x=4000, y=386, black=7)
            assert raw.size_filled == bytes_per_frame
            assert (raw.frame_id, raw.width, raw.height, raw.offset_x, raw.offset_y) == (number, 48, 20, 4000, 386)
            content = bytes(raw.raw_buffer[:bytes_per_frame])
            assert np.array_equal(unpacked(content, name, 48 * 20).reshape(20, 48), expected)
            raw.parent.queue_buffer(raw)
        assert np.array_equal(shoot(acquirer)[2], documented_picture(48, 20, bits, 3, x=4000, y=386, black=7))


def test_nothing_comes_without_a_trigger(folder):
    with camera(folder) as acquirer:
        software_triggered(acquirer)
        acquirer.start()
        begin = time.monotonic()
        with pytest.raises(gentl.TimeoutException):
            acquirer.fetch(timeout=0.2)
        assert 0.2 <= time.monotonic() - begin < 5.0
        assert acquirer.try_fetch(timeout=0.01) is None
        assert shoot(acquirer)[0] == 0


def test_time_stamps_are_of_the_clock_of_this_machine(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer, exposure_us=20_000)
        acquirer.start()
        before = time.monotonic_ns()
        nodes.TriggerSoftware.execute()
        after = time.monotonic_ns()
        _, stamp, _ = next_frame(acquirer)
        assert before <= stamp <= after
        assert time.monotonic_ns() - stamp >= 20_000_000
        nodes.TimestampLatch.execute()
        assert stamp < nodes.TimestampLatchValue.value < time.monotonic_ns()


def test_ids_begin_anew_with_each_acquisition(folder):
    with camera(folder) as acquirer:
        software_triggered(acquirer)
        for _ in range(3):
            acquirer.start()
            assert [shoot(acquirer)[0] for _ in range(4)] == [0, 1, 2, 3]
            acquirer.stop()


def test_limits_and_steps(folder):
    with camera(folder) as acquirer:
        nodes = acquirer.remote_device.node_map
        assert (nodes.Width.min, nodes.Width.max, nodes.Width.inc) == (16, 64, 8)
        nodes.Width.value = 40
        assert nodes.OffsetX.max == 24
        nodes.OffsetX.value = 16
        assert nodes.Width.max == 48
        for node, bad in [
            (nodes.Width, 56),
            (nodes.Width, 41),
            (nodes.OffsetX, 32),
            (nodes.Height, 50),
            (nodes.ExposureTime, 9.0),
            (nodes.ExposureTime, 2e7),
            (nodes.Gain, 24.5),
            (nodes.AcquisitionFrameRate, 1e5),
        ]:
            with pytest.raises(genapi.OutOfRangeException):
                node.value = bad
        with pytest.raises(genapi.GenericException, match="PixelFormat"):
            nodes.PixelFormat.value = "RGB8"


def test_what_changes_the_size_is_locked_while_frames_stream(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer)
        acquirer.start()
        for name, value in [("Width", 32), ("Height", 32), ("OffsetX", 0), ("OffsetY", 0), ("PixelFormat", "Mono12")]:
            with pytest.raises(genapi.AccessException):
                getattr(nodes, name).value = value
        nodes.ExposureTime.value = 200.0
        acquirer.stop()
        nodes.Width.value = 32
        nodes.PixelFormat.value = "Mono12"
        acquirer.start()
        assert shoot(acquirer)[2].shape == (48, 32)


def test_automatic_exposure_and_gain_lock_their_features(folder):
    with camera(folder) as acquirer:
        nodes = acquirer.remote_device.node_map
        nodes.ExposureAuto.value = nodes.GainAuto.value = "Continuous"
        for node in (nodes.ExposureTime, nodes.Gain):
            with pytest.raises(genapi.AccessException):
                node.value = 20.0
        nodes.ExposureAuto.value = nodes.GainAuto.value = "Off"
        nodes.ExposureTime.value = nodes.Gain.value = 20.0


def test_a_late_consumer_sees_underrun_and_a_gap(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer, buffers=3)
        acquirer.start()
        stream = acquirer.data_streams[0]
        assert (stream.num_queued, stream.num_announced) == (3, 3)
        for number in range(5):
            nodes.TriggerSoftware.execute()
            wait_for(lambda expected=number + 1: stream.num_started + stream.num_underrun == expected)
        assert (stream.num_awaiting_delivery, stream.num_queued, stream.num_delivered) == (3, 0, 3)
        assert stream.num_underrun == 2
        assert [next_frame(acquirer)[0] for _ in range(3)] == [0, 1, 2]
        assert (stream.num_awaiting_delivery, stream.num_queued) == (0, 3)
        assert shoot(acquirer)[0] == 5


def test_a_camera_that_streams_keeps_its_size_whatever_the_consumer_does(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer)
        acquirer.start()
        nodes.TLParamsLocked.value = 0  # against the rules
        with pytest.raises(gentl.AccessDeniedException):
            nodes.PixelFormat.value = "Mono16"
        assert good(shoot(acquirer), 0)


def test_nothing_is_left_behind(folder):
    own = psutil.Process()

    def cycle(acquirer):
        acquirer.start()
        shoot(acquirer)
        acquirer.stop()

    with camera(folder) as acquirer:
        software_triggered(acquirer)
        cycle(acquirer)
        before = own.num_fds(), own.num_threads()
        for _ in range(20):
            cycle(acquirer)
        assert (own.num_fds(), own.num_threads()) == before
    threads = own.num_threads()
    with camera(folder) as acquirer:
        software_triggered(acquirer)
        acquirer.start()
        acquirer.remote_device.node_map.TriggerSoftware.execute()
    # Left while it streamed: the library ends its threads by itself.
    assert own.num_threads() == threads
