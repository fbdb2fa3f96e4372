"""Another exposure between two sequences: which are refused, and that the camera really makes them."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from cameras import plugged_in, simulated
from scripted import PATTERNS, Camera, Projector, take

from drivers import DeviceLostError, DeviceSettingError, DeviceState, SteppedBench, StreamedBench, SystemClock
from sim_backend.clock import VirtualClock


class Adjustable(Camera):
    """A camera that rounds exposures to its lines of 10 µs, and forgets them when it is configured."""

    exposure_s = None

    def configure(self):
        self.exposure_s = 0.02
        return super().configure()

    def set_exposure(self, exposure_s):
        assert self.state is DeviceState.CONFIGURED
        self.move(f"expose {exposure_s:g}")
        self.exposure_s = round(exposure_s, 5)
        return self.exposure_s

    def fetch(self, out, timeout_s):
        self.waited_s = timeout_s
        return super().fetch(out, timeout_s)


@pytest.fixture
def devices():
    clock, log = VirtualClock(), []
    return {
        "projector": Projector("projector", clock, log),
        "camera": Adjustable("camera", clock, log),
        "clock": clock,
        "settle_s": 0.1,
        "exposure_s": 0.02,
    }


def test_the_camera_is_stopped_set_and_started_again(devices):
    with SteppedBench(name="b", **devices) as bench:
        take(bench)
        log = devices["camera"].log
        log.clear()
        assert bench.set_exposure(0.0800001) == 0.08
        assert log == ["camera.stop", "camera.expose 0.0800001", "camera.arm", "camera.start"]
        assert bench.exposure_s == 0.08
        take(bench)
        assert devices["camera"].waited_s == pytest.approx(0.08 + bench.timeout_s)


def test_a_camera_that_was_lost_comes_back_with_the_exposure_of_the_sequence(devices):
    camera = devices["camera"]
    with SteppedBench(name="b", reconnect_s=5, **devices) as bench:
        bench.set_exposure(0.08)
        camera.fail_next["trigger"] = DeviceLostError("camera: gone", "plug it in")
        with pytest.raises(DeviceLostError):
            take(bench)
        take(bench)
        assert camera.exposure_s == 0.08
        camera.fail_next["expose 0.04"] = DeviceLostError("camera: gone", "plug it in")
        with pytest.raises(DeviceLostError):
            bench.set_exposure(0.04)
        assert bench.set_exposure(0.04) == camera.exposure_s == 0.04


@pytest.mark.parametrize("kind", [SteppedBench, StreamedBench])
def test_exposures_that_cut_a_refresh_are_refused(devices, kind):
    with kind(name="b", whole_refreshes=True, **devices | {"exposure_s": 0.06}) as bench:
        for good in (0.06, 0.02, 0.04, 0.0401):
            bench.check_exposure(good)
        for bad in (0.03, 0.01, 0.0405):
            with pytest.raises(
                DeviceSettingError, match=r"refreshes of the projector \(20\.000 ms\), not a whole"
            ) as e:
                bench.check_exposure(bad)
            assert "bench.camera.exposure_us is 3 refreshes" in e.value.remedy
        with pytest.raises(DeviceSettingError):
            bench.set_exposure(0.03)
        assert bench.exposure_s == 0.06
    with kind(name="b", **devices) as bench:
        bench.check_exposure(0.013)


def test_a_streamed_bench_takes_no_longer_exposure_than_its_own(devices):
    with StreamedBench(name="b", **devices) as bench:
        with pytest.raises(DeviceSettingError, match=r"longer than bench\.camera\.exposure_us"):
            bench.check_exposure(0.03)
        take(bench)
        # A camera that counts its frames anew is none that has lost some.
        devices["camera"].next_id = 0
        bench.set_exposure(0.01)
        take(bench)


def test_what_cannot_be_told_or_set_is_refused(devices):
    with SteppedBench(name="b", **devices | {"exposure_s": 0.0}) as bench:
        with pytest.raises(DeviceSettingError, match="not known") as caught:
            bench.set_exposure(0.02)
        assert caught.value.remedy == "Write bench.camera.exposure_us."
    fixed = Camera("camera", devices["clock"], [])
    with (
        SteppedBench(name="b", **devices | {"camera": fixed}) as bench,
        pytest.raises(DeviceSettingError, match="cannot be changed in a scan"),
    ):
        bench.set_exposure(0.04)


class Lamp:
    """A world whose pictures are as bright as they were exposed long: one grey value for 100 µs."""

    def picture(self, request):
        level = round(request.exposure_s * 1e4)
        return np.full((request.height_px, request.width_px), level, np.uint8)


def test_a_genicam_camera_exposes_each_sequence_as_it_was_told(tmp_path_factory):
    """Through harvesters and the GenTL producer, which asks its world for pictures with the exposure it has made."""
    from sim_backend.gentl.feed import PictureServer

    folder, clock = tmp_path_factory.mktemp("lamp"), SystemClock()
    with contextlib.ExitStack() as stack:
        stack.enter_context(PictureServer(folder / "world", Lamp()))
        stack.enter_context(plugged_in(folder, "L::MFS Sim:64x48", folder / "world"))
        bench = stack.enter_context(
            SteppedBench(
                name="b",
                camera=simulated(serial="L", exposure_us=2000.0),
                projector=Projector("projector", VirtualClock(), []),
                clock=clock,
                settle_s=0.0,
                exposure_s=0.002,
            )
        )
        out = np.empty(bench.frame_format.shape, np.uint8)
        seen = []
        for exposure_s in (None, 0.008, 0.0005, 0.002):
            if exposure_s is not None:
                assert bench.set_exposure(exposure_s) == pytest.approx(exposure_s, rel=1e-3)
            bench.prepare(PATTERNS[:2])
            for index in range(2):
                bench.expose(index, out)
                seen.append(int(out.max()))
        assert seen == [20, 20, 80, 80, 5, 5, 20, 20]
        assert bench.describe()["camera"]["exposure_us"] == pytest.approx(2000)
        with pytest.raises(DeviceSettingError, match="ExposureTime"):
            bench.set_exposure(1e6)
        # A refusal leaves a bench that goes on.
        assert bench.set_exposure(0.001) == pytest.approx(0.001)
        bench.prepare(PATTERNS[:1])
        bench.expose(0, out)
        assert out.max() == 10
