"""Which cameras the simulated producer has, who owns one, and what becomes of one that is unplugged."""

from __future__ import annotations

import time

import numpy as np
import pytest
from stock_harvesters import (
    SMALL,
    another_process,
    camera,
    documented_picture,
    gentl,
    good,
    harvester,
    shoot,
    software_triggered,
)

from sim_backend.gentl import SimulatedCameraId, installed, plug, producer_path, unplug


def test_cameras_are_listed_as_named(folder):
    named = [
        SimulatedCameraId("A17", "left", "MFS Sim", 64, 48),
        SimulatedCameraId("B2", "rechts außen", "MFS Sim", 128, 96),
        SimulatedCameraId("C", "old", "MFS Sim Legacy", 64, 48),
    ]
    with installed(folder, named) as producer, harvester(producer) as h:
        listed = [(d.serial_number, d.user_defined_name, d.model, d.vendor) for d in h.device_info_list]
        assert listed == [(c.serial, c.user_name, c.model, "MFS Scanner") for c in named]
        assert [d.access_status for d in h.device_info_list] == [1, 1, 1]
        with pytest.raises(ValueError, match="multiple"):
            h.create({"model": "MFS Sim"})
        nodes = h.create({"user_defined_name": "rechts außen"}).remote_device.node_map
        assert (nodes.DeviceSerialNumber.value, nodes.SensorWidth.value, nodes.SensorHeight.value) == ("B2", 128, 96)
        assert h.device_info_list[1].access_status == 5
        nodes.DeviceUserID.value = "middle"
        assert h.device_info_list[1].user_defined_name == "middle"


def test_without_variables_there_is_one_camera(folder, monkeypatch):
    monkeypatch.setenv("MFS_SIM_GENTL_DIR", str(folder))
    monkeypatch.delenv("MFS_SIM_GENTL_DEVICES", raising=False)
    with harvester(producer_path()) as h:
        assert [(d.serial_number, d.model) for d in h.device_info_list] == [("SIM0001", "MFS Sim")]


def test_the_bus_may_be_empty(folder):
    with installed(folder, []) as producer, harvester(producer) as h:
        assert h.device_info_list == []


def test_a_legacy_camera_knows_the_old_names_only(folder):
    with camera(folder, SimulatedCameraId(model="MFS Sim Legacy", width_px=64, height_px=48)) as acquirer:
        nodes = acquirer.remote_device.node_map
        for modern in ("ExposureTime", "Gain", "AcquisitionFrameRate", "TriggerDelay"):
            assert not hasattr(nodes, modern)
        nodes.ExposureTimeAbs.value = 1500.0
        nodes.GainRaw.value = 63
        nodes.TriggerMode.value = "On"
        acquirer.start()
        frame_id, stamp, picture = shoot(acquirer)
        assert (nodes.ExposureTimeAbs.value, nodes.GainRaw.value, frame_id) == (1500.0, 63, 0)
        assert np.array_equal(picture, documented_picture(64, 48, 8, 0))
        assert time.monotonic_ns() - stamp >= 1_500_000


@pytest.mark.parametrize("how", ["feature", "fault", "cable"])
def test_unplugged_and_back_again(folder, how):
    with installed(folder, [SMALL]) as producer, harvester(producer) as h:
        acquirer = h.create({"serial_number": "SIM0001"})
        nodes = software_triggered(acquirer)
        acquirer.start()
        shoot(acquirer)
        nodes.SimReturnAfter.value = 1000
        if how == "feature":
            nodes.SimDisconnect.execute()
        elif how == "fault":
            nodes.SimDisconnectIn.value = 1
            nodes.TriggerSoftware.execute()
        else:
            unplug(folder, "SIM0001", away_s=1.0)
        with pytest.raises(gentl.IoException):
            acquirer.fetch(timeout=20.0)
        assert acquirer.device.module.access_status == 3
        with pytest.raises(gentl.GenericException):
            acquirer.stop()
        acquirer.destroy()
        h.update()
        assert h.device_info_list == []
        time.sleep(1.05)
        h.update()
        acquirer = h.create({"serial_number": "SIM0001"})
        software_triggered(acquirer)
        acquirer.start()
        assert good(shoot(acquirer), 0)


def test_plugged_in_again_by_hand(folder):
    with installed(folder, [SMALL]) as producer, harvester(producer) as h:
        unplug(folder, "SIM0001")
        h.update()
        assert h.device_info_list == []
        plug(folder, "SIM0001")
        h.update()
        assert len(h.device_info_list) == 1


def test_one_camera_has_one_owner(folder):
    with installed(folder, [SMALL]) as producer, harvester(producer) as h:
        acquirer = h.create(0)
        with pytest.raises(gentl.ResourceInUseException):
            h.create(0)
        with another_process(producer) as other:
            assert other.communicate(timeout=30)[0].split("\n")[:2] == ["[4]", "AccessDeniedException"]
        acquirer.destroy()
        with another_process(producer) as other:
            assert [other.stdout.readline().strip() for _ in range(2)] == ["[1]", "open"]
            assert h.device_info_list[0].access_status == 4
            with pytest.raises(gentl.AccessDeniedException):
                h.create(0)
            other.kill()
            other.communicate()
        h.create(0)  # a process that dies lets go
