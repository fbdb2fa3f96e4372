"""The measured display latency, against the simulated projector's own time line."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import DeviceSettingError, DisplayLatency, HardwareError
from drivers.latency import measure_latency
from sim_backend.clock import VirtualClock
from sim_backend.devices import SimulatedCamera, SimulatedProjector
from sim_backend.settings import CameraSettings, FaultSettings, ProjectorSettings

EXPOSURE_S, READOUT_S = 2e-3, 1e-3


class Wall:
    """A white wall that fills the picture; ``contrast`` is what the projector adds, DN."""

    def __init__(self, contrast: float = 150.0) -> None:
        self.contrast = contrast

    def grey(self, shown):
        light = sum(share * picture.mean() / 255 for share, picture in shown)
        return np.full((48, 64), 20 + self.contrast * light, np.float32)


def devices(latency_s: float, wall: Wall | None = None):
    clock = VirtualClock()
    projector = SimulatedProjector(ProjectorSettings(width_px=64, height_px=40, latency_s=latency_s), clock)
    settings = CameraSettings(width_px=64, height_px=48, exposure_us=EXPOSURE_S * 1e6, readout_s=READOUT_S)
    camera = SimulatedCamera(settings, wall or Wall(), projector, clock, np.random.default_rng(1), FaultSettings())
    projector.open()
    projector.configure()
    camera.open()
    frame_format = camera.configure()
    camera.arm()
    camera.start()
    return camera, projector, clock, frame_format


@pytest.mark.parametrize("latency_s", [0.0, 0.035, 0.2])
def test_latency_is_that_of_the_projector(latency_s):
    camera, projector, clock, frame_format = devices(latency_s)
    true = []
    show = projector.show

    def watched(index):
        handed = show(index)
        true.append(projector.on_surface_from() - handed)
        return handed

    # When the picture comes on is the simulation's own knowledge: the first refresh after the latency.
    projector.on_surface_from = lambda: (
        np.ceil((clock.now() + latency_s) / projector.period_s - 1e-9) * projector.period_s
    )
    projector.show = watched
    found = measure_latency(
        camera, projector, clock, np.random.default_rng(2), frame_format=frame_format, exposure_s=EXPOSURE_S, steps=60
    )
    true = np.array(true[2:])
    # A step is seen to a share of the exposure (noise 1.5 DN over 3000 pixels is nothing beside 5 %); between two
    # exposures it counts with the later one, at most a read-out later.
    late = READOUT_S + 0.06 * EXPOSURE_S
    assert -1e-5 <= found.median_s - np.median(true) <= late
    assert -1e-5 <= found.p99_s - true.max() <= late
    assert found.samples == 60
    assert found.p99_s <= latency_s + projector.period_s + late
    assert found.settle_s(projector.period_s) > true.max() + 0.9 * projector.period_s


def test_every_frame_of_every_step_is_kept_and_shows_it():
    camera, projector, clock, frame_format = devices(0.035)
    kept = []

    def keep(level, frames):
        kept.append((level, [stamp.frame_id for _, stamp in frames], [float(pixels.mean()) for pixels, _ in frames]))

    measure_latency(
        camera, projector, clock, np.random.default_rng(2), frame_format=frame_format,
        exposure_s=EXPOSURE_S, steps=6, keep=keep,
    )  # fmt: skip
    assert [level for level, _, _ in kept] == [0, 255, 0, 255, 0, 255, 0, 255]
    numbers = [number for _, ids, _ in kept for number in ids]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "none is left out"
    for level, _, means in kept[2:]:
        # 35 ms are longer than an exposure and its read-out, so that the first still sees what was there before.
        assert abs(means[0] - (20 if level else 170)) < 1
        assert abs(means[-1] - means[0]) > 0.05 * 150


def test_camera_that_sees_no_projector_is_told(array_bench):
    camera, projector, clock, frame_format = devices(0.03, Wall(contrast=1.0))
    with pytest.raises(HardwareError, match="no difference between black and white"):
        measure_latency(
            camera, projector, clock, np.random.default_rng(2), frame_format=frame_format, exposure_s=EXPOSURE_S
        )


def test_display_that_freezes_is_told():
    camera, projector, clock, frame_format = devices(0.03)
    show, shown = projector.show, []

    def freezing(index):
        shown.append(index)
        return show(index) if len(shown) < 6 else clock.now()

    projector.show = freezing
    with pytest.raises(HardwareError, match="was not on the surface 2 s after"):
        measure_latency(
            camera, projector, clock, np.random.default_rng(2), frame_format=frame_format, exposure_s=EXPOSURE_S
        )


def test_latency_survives_its_document_and_nonsense_is_refused():
    latency = DisplayLatency(0.04, 0.052, 50, "2026-01-01T00:00:00+00:00", "camera", "projector")
    assert DisplayLatency.from_json(latency.to_json()) == latency
    for document in ({}, {**latency.to_json(), "p99_s": 0.01}, {**latency.to_json(), "colour": 1}):
        with pytest.raises(DeviceSettingError, match="cannot be used"):
            DisplayLatency.from_json(document)
