"""Stepped and streamed benches: order, counting, bringing devices back; the devices are written down move by move."""

from __future__ import annotations

import numpy as np
import pytest
from scripted import PATTERNS, Box, Camera, Projector, take

from drivers import (
    DeviceLostError,
    DeviceSettingError,
    DisplayLatency,
    FrameFormat,
    FrameLossError,
    FrameTimeoutError,
    SequenceFaultError,
    SteppedBench,
    StreamedBench,
    TriggerCounts,
)
from sim_backend.clock import VirtualClock


@pytest.fixture
def parts():
    clock, log = VirtualClock(), []
    return {
        "camera": Camera("camera", clock, log),
        "projector": Projector("projector", clock, log),
        "trigger": Box("box", clock, log),
        "clock": clock,
    }, log


def test_order_of_opening_and_closing(parts):
    devices, log = parts
    with SteppedBench(name="b", settle_s=0.1, **devices):
        assert log == [
            *["projector.open", "projector.configure"],
            *["camera.open", "camera.configure", "camera.arm", "camera.start"],
            *["box.open", "box.configure"],
        ]
        log.clear()
    assert log[0] == "projector.darken"
    assert [entry for entry in log if entry.endswith("close")] == ["box.close", "camera.close", "projector.close"]


@pytest.mark.parametrize("call", ["configure", "arm", "start"])
def test_failed_start_closes_what_was_opened(parts, call):
    devices, log = parts
    devices["camera"].fail_next[call] = DeviceSettingError("camera: no", "change it")
    with pytest.raises(DeviceSettingError), SteppedBench(name="b", settle_s=0.1, **devices):
        pass
    assert log[-3:] == ["camera.close", "projector.darken", "projector.close"]


def test_stepped_waits_from_hand_over_to_trigger(parts):
    devices, log = parts
    with SteppedBench(name="b", settle_s=0.1, **devices) as bench:
        stamps = take(bench)
    assert [s.t_shown_s for s in stamps] == pytest.approx([0.1 * n for n in range(5)])
    assert log.index("projector.show 0") < log.index("box.fire") < log.index("camera.fetch")


def test_stepped_needs_a_latency(parts):
    devices, _ = parts
    with SteppedBench(name="b", **devices) as bench:
        bench.prepare(PATTERNS)
        with pytest.raises(DeviceSettingError, match="how late projector shows"):
            bench.expose(0, np.zeros((4, 6), np.uint8))
        with pytest.raises(DeviceSettingError, match="scan latency"):
            bench.use_latency(None)
        bench.use_latency(DisplayLatency(0.03, 0.05, 50))
        assert bench.settle_s == pytest.approx(0.05 + 0.02)
        take(bench)
        assert bench.describe()["display_latency"]["p99_s"] == 0.05


@pytest.mark.parametrize(
    "counts", [TriggerCounts(4, 5, 0), TriggerCounts(5, 4, 0), TriggerCounts(5, 5, 1), TriggerCounts(6, 6, 0)]
)
@pytest.mark.parametrize("kind", [SteppedBench, StreamedBench])
def test_triggers_exposures_and_frames_must_agree(parts, kind, counts):
    devices, _ = parts
    with kind(name="b", settle_s=0.1, **devices) as bench:
        take(bench)
        devices["trigger"].report = counts
        with pytest.raises(SequenceFaultError, match="5 frames came for 5 patterns") as caught:
            take(bench)
        assert caught.value.repeatable
        devices["trigger"].report = None
        take(bench)


@pytest.mark.parametrize("kind", [SteppedBench, StreamedBench])
def test_disturbed_picture_is_told_with_the_last_frame(parts, kind):
    devices, _ = parts
    with kind(name="b", settle_s=0.1, **devices) as bench:
        devices["projector"].disturbed = SequenceFaultError("projector: it was covered by: mail", "move it away")
        with pytest.raises(SequenceFaultError, match="covered by: mail"):
            take(bench)
        devices["projector"].disturbed = None
        take(bench)


def test_exposures_that_are_not_counted_back_are_not_missed(parts):
    devices, _ = parts
    with SteppedBench(name="b", settle_s=0.1, **devices) as bench:
        devices["trigger"].report = TriggerCounts(5, None, 0)
        take(bench)


@pytest.mark.parametrize("kind", [SteppedBench, StreamedBench])
@pytest.mark.parametrize(("device", "call"), [("camera", "fetch"), ("projector", "load"), ("trigger", "counts")])
def test_lost_device_is_brought_back(parts, kind, device, call):
    devices, log = parts
    with kind(name="b", settle_s=0.1, reconnect_s=5.0, **devices) as bench:
        take(bench)
        devices[device].fail_next[call] = DeviceLostError(f"{device}: gone", "plug it in")
        devices[device].away = 3
        with pytest.raises(DeviceLostError):
            take(bench)
        began = devices["clock"].now()
        log.clear()
        if device != "projector":
            devices["camera"].next_id = 0  # started anew, it counts from the beginning
        first = devices["camera"].next_id
        stamps = take(bench)
        assert [s.frame_id for s in stamps] == [first + n for n in range(5)]
        assert 1.4 <= devices["clock"].now() - began <= 3
        name = devices[device].name
        assert log.index(f"{name}.close") < log.index(f"{name}.open") < log.index(f"{name}.configure")


def test_lost_device_that_stays_away_is_given_up_once(parts):
    devices, _ = parts
    with SteppedBench(name="b", settle_s=0.1, reconnect_s=5.0, **devices) as bench:
        devices["camera"].fail_next["fetch"] = DeviceLostError("camera: gone", "plug it in")
        devices["camera"].away = 1000
        with pytest.raises(DeviceLostError):
            take(bench)
        with pytest.raises(DeviceLostError, match="not there") as caught:
            take(bench)
        assert not caught.value.repeatable
        assert 5 <= devices["clock"].now() < 6


def test_another_camera_in_its_place_is_refused(parts):
    devices, _ = parts
    with SteppedBench(name="b", settle_s=0.1, reconnect_s=5.0, **devices) as bench:
        devices["camera"].fail_next["fetch"] = DeviceLostError("camera: gone", "plug it in")
        with pytest.raises(DeviceLostError):
            take(bench)
        devices["camera"].format = FrameFormat(8, 4, 8)
        with pytest.raises(DeviceSettingError, match="they were 6 × 4"):
            take(bench)


def test_frames_that_a_broken_sequence_left_are_dropped(parts):
    devices, log = parts
    with SteppedBench(name="b", settle_s=0.1, **devices) as bench:
        devices["camera"].fail_next["fetch"] = FrameTimeoutError("camera: no frame", "look")
        with pytest.raises(FrameTimeoutError):
            take(bench)
        log.clear()
        bench.prepare(PATTERNS)
        assert [e for e in log if e.startswith("camera")] == ["camera.stop", "camera.arm", "camera.start"]
        log.clear()
        bench.prepare(PATTERNS)
        assert not [e for e in log if e.startswith("camera")]


def test_streamed_plays_once_and_checks_at_the_end(parts):
    devices, log = parts
    with StreamedBench(name="b", **devices) as bench:
        log.clear()
        take(bench)
        assert log == [
            *["projector.load", "box.arm 5", "projector.play"],
            *["camera.fetch"] * 5,
            *["projector.finish", "box.counts"],
        ]
        devices["projector"].late = (2, 3)
        with pytest.raises(SequenceFaultError, match=r"2 of 5 patterns came a refresh or more too late \(3, 4\)"):
            take(bench)
        bench.prepare(PATTERNS)
        with pytest.raises(SequenceFaultError, match="is the next that the projector plays"):
            bench.expose(3, np.zeros((4, 6), np.uint8))


@pytest.mark.parametrize("jump", [1, 7, -1])
def test_streamed_refuses_frames_out_of_count(parts, jump):
    devices, _ = parts
    with StreamedBench(name="b", **devices) as bench:
        take(bench)
        devices["camera"].next_id += jump
        with pytest.raises(FrameLossError, match="came where 5 was due"):
            take(bench)
        # The camera was started anew, wherever it counts from now.
        take(bench)


def test_projector_that_cannot_play_is_no_streamed_bench(parts):
    devices, _ = parts

    class StepOnly(Projector):
        play = None

    devices["projector"] = object()
    with pytest.raises((TypeError, AttributeError)):
        StreamedBench(name="b", **devices)
