"""The in-process projector, whose surface is asked for its light over the next refresh."""

from contextlib import contextmanager

import numpy as np

from sim_backend.clock import VirtualClock
from sim_backend.devices import SimulatedProjector
from sim_backend.settings import ProjectorSettings


@contextmanager
def projector(tmp_path):
    clock = VirtualClock()
    device = SimulatedProjector(ProjectorSettings(width_px=64, height_px=48), clock)

    def read_surface():
        clock.sleep(0.2)
        light = device.on_surface(clock.now(), clock.now() + 1e-3)
        return np.rint(sum(share * picture for share, picture in light)).astype(np.uint8)

    yield device, read_surface
