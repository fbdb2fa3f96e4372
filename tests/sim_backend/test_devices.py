import json

import numpy as np
import pytest

from drivers import (
    Camera,
    DeviceLostError,
    DeviceSettingError,
    DeviceState,
    FrameTimeoutError,
    IllegalCallError,
    Projector,
)
from sim_backend.cache import transport_of
from sim_backend.clock import VirtualClock
from sim_backend.devices import SimulatedCamera, SimulatedProjector
from sim_backend.optics import Optics
from sim_backend.settings import FaultSettings, ProjectorSettings

BLACK, GREY, WHITE = (np.full((400, 640), level, np.uint8) for level in (0, 128, 255))


@pytest.fixture
def projector():
    device = SimulatedProjector(
        ProjectorSettings(width_px=640, height_px=400, refresh_hz=50.0, latency_s=0.03), VirtualClock()
    )
    device.open()
    device.configure()
    return device


@pytest.fixture
def bench(small):
    """Camera and projector that are ready, and their clock; the camera has neither noise nor ambient light."""

    def make(**faults):
        settings = small(
            scene={"name": "plane"},
            camera={"read_noise_dn": 0.0, "ambient_dn": 0.0, "exposure_us": 20_000.0, "readout_s": 0.004},
            projector={"refresh_hz": 50.0, "latency_s": 0.03},
        )
        clock = VirtualClock()
        shown = SimulatedProjector(settings.projector, clock)
        optics = Optics.of(settings, transport_of(settings))
        camera = SimulatedCamera(
            settings.camera, optics, shown, clock, np.random.default_rng(0), FaultSettings(**faults)
        )
        shown.open()
        shown.configure()
        shown.load([WHITE, GREY, BLACK])
        camera.open()
        camera.configure()
        camera.arm()
        camera.start()
        return camera, shown, clock

    return make


def _frame(camera):
    out = np.empty((192, 256), np.uint8)
    camera.trigger()
    camera.fetch(out, 1.0)
    return out


def test_devices_are_what_the_protocols_ask_for(bench):
    camera, projector, _ = bench()
    assert isinstance(camera, Camera)
    assert isinstance(projector, Projector)


def test_projector_shows_at_the_first_refresh_after_the_latency(projector):
    projector.load([GREY, WHITE])
    clock = projector._clock
    clock.sleep(0.005)
    assert projector.show(0) == pytest.approx(0.005)
    # 0.005 + 0.03 s is over at the refresh at 0.04 s.
    (before,) = projector.on_surface(0.0, 0.04)
    assert before[1].max() == 0
    (after,) = projector.on_surface(0.04, 0.06)
    assert after[0] == pytest.approx(1)
    assert (after[1] == 128).all()


def test_exposure_across_a_change_mixes_both_pictures(projector):
    projector.load([GREY, WHITE])
    projector.show(0)
    projector._clock.sleep(0.1)
    projector.show(1)  # on at 0.14 s, because 0.13 s is between refreshes
    mixed = projector.on_surface(0.135, 0.155)
    assert [share for share, _ in mixed] == pytest.approx([0.25, 0.75])
    assert [picture[0, 0] for _, picture in mixed] == [128, 255]


def test_a_picture_that_never_came_on_is_replaced(projector):
    projector.load([GREY, WHITE])
    projector.show(0)
    projector.show(1)
    assert [picture[0, 0] for _, picture in projector.on_surface(0.02, 0.08)] == [0, 255]


def test_projector_refuses_illegal_calls():
    device = SimulatedProjector(ProjectorSettings(width_px=640, height_px=400), VirtualClock())
    with pytest.raises(IllegalCallError, match=r"darken\(\).*CLOSED"):
        device.darken()
    with pytest.raises(IllegalCallError, match=r"arm\(\).*CLOSED"):
        device.load([GREY])
    device.open()
    with pytest.raises(IllegalCallError, match=r"open\(\).*OPEN"):
        device.open()
    device.configure()
    with pytest.raises(IllegalCallError, match=r"show\(\).*CONFIGURED"):
        device.show(0)
    device.load([GREY])
    with pytest.raises(DeviceSettingError, match="no picture 1"):
        device.show(1)
    with pytest.raises(DeviceSettingError, match="float"):
        device.load([GREY.astype(np.float32)])
    with pytest.raises(DeviceSettingError, match="not uint8"):
        device.load([GREY[:, :100]])
    device.close()
    device.close()
    assert device.state is DeviceState.CLOSED


def test_loaded_pictures_are_the_projectors_own(projector):
    mine = GREY.copy()
    projector.load([mine])
    mine[:] = 0
    projector.show(0)
    assert (projector.on_surface(1.0, 1.1)[0][1] == 128).all()


def test_camera_refuses_illegal_calls(bench):
    camera, _, _ = bench()
    frame = np.empty((192, 256), np.uint8)
    with pytest.raises(IllegalCallError, match=r"arm\(\).*RUNNING"):
        camera.arm()
    with pytest.raises(DeviceSettingError, match="buffer"):
        camera.fetch(np.empty((10, 10), np.uint8), 1.0)
    camera.stop()
    with pytest.raises(IllegalCallError, match=r"trigger\(\).*CONFIGURED"):
        camera.trigger()
    with pytest.raises(IllegalCallError, match=r"fetch\(\)"):
        camera.fetch(frame, 1.0)
    camera.close()
    with pytest.raises(IllegalCallError, match=r"configure\(\).*CLOSED"):
        camera.configure()


def test_settled_pictures_are_seen_and_early_ones_are_stale(bench):
    camera, projector, clock = bench()
    dark = _frame(camera)
    assert dark.max() == 0
    projector.show(0)
    stale = _frame(camera)
    assert stale.max() == 0  # over before the picture comes on at 0.06 s
    clock.sleep_until(0.1)
    white = _frame(camera)
    projector.show(2)  # now 0.124 s: black comes on at 0.16 s
    clock.sleep_until(0.15)
    half = _frame(camera)
    lit = white > 100
    assert lit.mean() > 0.3
    np.testing.assert_allclose(half[lit].astype(float), white[lit] / 2, atol=1)


def test_frames_come_in_the_order_of_triggers_with_their_times(bench):
    camera, projector, clock = bench()
    projector.show(0)
    clock.sleep_until(0.2)
    camera.trigger()
    camera.trigger()  # queues behind the first
    out = np.empty((192, 256), np.uint8)
    first, second = camera.fetch(out, 1.0), camera.fetch(out, 1.0)
    assert (first.frame_id, second.frame_id) == (0, 1)
    assert first.t_device_s == pytest.approx(0.2)
    assert first.t_host_s == pytest.approx(0.224)
    assert second.t_device_s == pytest.approx(0.22)
    assert clock.now() == pytest.approx(0.244)


def test_a_frame_that_was_not_triggered_times_out(bench):
    camera, _, clock = bench()
    with pytest.raises(FrameTimeoutError, match=r"0\.5 s"):
        camera.fetch(np.empty((192, 256), np.uint8), 0.5)
    assert clock.now() == pytest.approx(0.5)


def test_a_timeout_shorter_than_the_exposure_does_not_lose_the_frame(bench):
    camera, _, _ = bench()
    out = np.empty((192, 256), np.uint8)
    camera.trigger()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(out, 0.01)
    assert camera.fetch(out, 0.1).frame_id == 0


def test_faults_come_at_their_exposures(bench):
    camera, projector, clock = bench(repeat_frame_at=[1], stale_at=[2], drop_at=[3], lose_camera_at=4)
    frames = []
    for index in (0, 1, 2):
        projector.show(index)
        clock.sleep(0.06)
        frames.append(_frame(camera))
    lit = frames[0] > 100
    np.testing.assert_array_equal(frames[1], frames[0])  # repeated
    np.testing.assert_allclose(frames[2][lit] / frames[0][lit], 128 / 255, atol=0.01)  # grey in place of black
    out = np.empty((192, 256), np.uint8)
    camera.trigger()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(out, 1.0)
    with pytest.raises(DeviceLostError) as lost:
        camera.trigger()
    assert lost.value.remedy
    assert camera.state is DeviceState.FAULT
    with pytest.raises(IllegalCallError):
        camera.fetch(out, 1.0)
    projector.darken()
    camera.close()
    assert camera.state is DeviceState.CLOSED


def test_arming_drops_what_was_left_over(bench):
    camera, _, _ = bench()
    camera.trigger()
    camera.stop()
    camera.arm()
    camera.start()
    with pytest.raises(FrameTimeoutError):
        camera.fetch(np.empty((192, 256), np.uint8), 0.5)


def test_snapshots_are_json_and_say_simulated(bench):
    for device in bench()[:2]:
        snapshot = json.loads(json.dumps(device.describe()))
        assert snapshot["simulated"] is True
        assert snapshot["name"] == device.name
        assert snapshot["state"] == device.state.name
