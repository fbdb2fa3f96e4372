"""What makes the simulated producer expose a frame."""

from __future__ import annotations

import time

import numpy as np
import pytest
from stock_harvesters import camera, next_frame, shoot, software_triggered


def test_a_trigger_during_an_exposure_is_ignored_and_counted(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer, exposure_us=400_000)
        acquirer.start()
        for _ in range(4):
            nodes.TriggerSoftware.execute()
        assert next_frame(acquirer)[0] == 0
        assert acquirer.try_fetch(timeout=0.15) is None
        assert nodes.SimTriggersIgnored.value == 3
        assert shoot(acquirer)[0] == 1


def test_lines_trigger_by_source_and_edge(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer)
        nodes.TriggerSource.value = "Line1"
        nodes.TriggerActivation.value = "FallingEdge"
        acquirer.start()
        nodes.TriggerSoftware.execute()
        nodes.SimPulseLine0.execute()
        assert acquirer.try_fetch(timeout=0.05) is None
        nodes.SimPulseLine1.execute()
        assert next_frame(acquirer)[0] == 0


def test_trigger_delay_postpones_the_exposure(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer)
        nodes.TriggerDelay.value = 50_000.0
        acquirer.start()
        before = time.monotonic_ns()
        nodes.TriggerSoftware.execute()
        after = time.monotonic_ns()
        _, stamp, _ = next_frame(acquirer)
        assert before <= stamp - 50_000_000 <= after


def test_an_acquisition_may_wait_for_its_own_trigger(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer)
        nodes.TriggerSelector.value = "AcquisitionStart"
        assert nodes.TriggerMode.value == "Off"  # each trigger has settings of its own
        nodes.TriggerMode.value = "On"
        nodes.TriggerSource.value = "Line0"
        nodes.TriggerSelector.value = "FrameStart"
        acquirer.start()
        nodes.TriggerSoftware.execute()
        assert acquirer.try_fetch(timeout=0.05) is None
        nodes.SimPulseLine0.execute()
        assert shoot(acquirer)[0] == 0


def test_single_and_multi_frame(folder):
    with camera(folder) as acquirer:
        nodes = acquirer.remote_device.node_map
        nodes.ExposureTime.value = 100.0
        nodes.AcquisitionMode.value = "MultiFrame"
        nodes.AcquisitionFrameCount.value = 5
        acquirer.num_buffers = 16
        acquirer.start()
        assert [next_frame(acquirer)[0] for _ in range(5)] == [0, 1, 2, 3, 4]
        assert acquirer.try_fetch(timeout=0.05) is None
        acquirer.stop()
        nodes.AcquisitionMode.value = "SingleFrame"
        acquirer.start()
        next_frame(acquirer)
        assert acquirer.try_fetch(timeout=0.05) is None


def test_free_run_keeps_its_rate(folder):
    with camera(folder) as acquirer:
        nodes = acquirer.remote_device.node_map
        nodes.ExposureTime.value = 1000.0
        nodes.AcquisitionFrameRateEnable.value = True
        nodes.AcquisitionFrameRate.value = 200.0
        acquirer.num_buffers = 40  # none is lost, however slowly they are fetched
        acquirer.start()
        frames = [next_frame(acquirer)[:2] for _ in range(40)]
        assert [frame_id for frame_id, _ in frames] == list(range(40))
        assert set(np.diff([stamp for _, stamp in frames])) == {5_000_000}
        acquirer.stop()
        nodes.AcquisitionFrameRateEnable.value = False
        nodes.ExposureTime.value = 10_000.0
        assert nodes.AcquisitionFrameRate.max == pytest.approx(100.0)
        acquirer.start()
        stamps = [next_frame(acquirer)[1] for _ in range(3)]
        assert list(np.diff(stamps)) == [10_000_000] * 2


def test_lines_and_their_directions(folder):
    with camera(folder) as acquirer:
        nodes = software_triggered(acquirer, exposure_us=400_000)
        directions = {}
        for line in ("Line0", "Line1", "Line2"):
            nodes.LineSelector.value = line
            directions[line] = nodes.LineMode.value, nodes.LineSource.value
        assert directions == {
            "Line0": ("Input", "Off"),
            "Line1": ("Input", "Off"),
            "Line2": ("Output", "ExposureActive"),
        }
        acquirer.start()
        assert not nodes.LineStatus.value
        nodes.TriggerSoftware.execute()
        assert nodes.LineStatus.value
        next_frame(acquirer)
        assert not nodes.LineStatus.value
