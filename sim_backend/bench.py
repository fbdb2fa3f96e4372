"""The bench kind ``simulated``, as configurations name it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel

from drivers import BenchKind, SteppedBench
from sim_backend.clock import VirtualClock
from sim_backend.settings import SceneSettings, SimulatedSettings

if TYPE_CHECKING:
    from sim_backend.truth import Truth


class SimulatedBenchKind:
    """Opens simulated benches; see `drivers.BenchKind`."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the section ``bench:``."""
        return SimulatedSettings

    @contextmanager
    def open(self, settings: SimulatedSettings) -> Iterator[SteppedBench]:
        """An open bench; the scene's light is traced first unless it is in the cache."""
        # Imported here, because tracing needs Open3D and Numba, and the settings alone need neither.
        from sim_backend.cache import transport_of
        from sim_backend.devices import SimulatedCamera, SimulatedProjector
        from sim_backend.optics import Optics

        optics = Optics.of(settings, transport_of(settings))
        clock = VirtualClock(real_time=settings.real_time)
        projector = SimulatedProjector(settings.projector, clock, settings.faults)
        camera = SimulatedCamera(
            settings.camera, optics, projector, clock, np.random.default_rng(settings.seed), settings.faults
        )
        settle_s = settings.settle_s
        if settle_s is None:
            settle_s = settings.projector.latency_s + projector.period_s
        with SteppedBench(
            name=f"simulated {settings.scene.name}",
            camera=camera,
            projector=projector,
            clock=clock,
            settle_s=settle_s,
            exposure_s=camera.exposure_s,
            timeout_s=2.0 + settings.camera.readout_s,
            simulated=True,
            rig=settings.rig().to_json(),
        ) as bench:
            yield bench


def truth_of(settings: SceneSettings) -> Truth:
    """What is really there, for tests that judge a scan."""
    from sim_backend.cache import transport_of
    from sim_backend.optics import Optics
    from sim_backend.truth import Truth

    return Truth(Optics.of(settings, transport_of(settings)), settings.rig())


kind: BenchKind = SimulatedBenchKind()
"""What the entry point names."""
