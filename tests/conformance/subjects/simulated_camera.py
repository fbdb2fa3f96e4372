"""The in-process camera, in front of a matt plane that a projector lights."""

from contextlib import contextmanager

import numpy as np

from sim_backend.cache import transport_of
from sim_backend.clock import VirtualClock
from sim_backend.devices import SimulatedCamera, SimulatedProjector
from sim_backend.optics import Optics
from sim_backend.settings import FaultSettings, SimulatedSettings


@contextmanager
def camera(tmp_path):
    settings = SimulatedSettings.model_validate(
        {
            "scene": {"name": "plane"},
            "camera": {"width_px": 64, "height_px": 48},
            "projector": {"width_px": 64, "height_px": 48},
        }
    )
    clock = VirtualClock()
    projector = SimulatedProjector(settings.projector, clock)
    projector.open()
    projector.configure()
    projector.load([np.random.default_rng(1).integers(0, 256, (48, 64), np.uint8)])
    projector.show(0)
    optics = Optics.of(settings, transport_of(settings))
    yield SimulatedCamera(settings.camera, optics, projector, clock, np.random.default_rng(0), FaultSettings())
