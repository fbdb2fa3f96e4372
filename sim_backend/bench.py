"""The bench kind ``simulated``, as configurations name it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from drivers import BenchKind
from sim_backend.clock import VirtualClock
from sim_backend.scenes import scene_of
from sim_backend.settings import SceneSettings, SimulatedSettings

if TYPE_CHECKING:
    from sim_backend.cache import RecentTransports
    from sim_backend.stage import SimulatedBench
    from sim_backend.truth import Truth


class SimulatedBenchKind:
    """Opens simulated benches; see `drivers.BenchKind`."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the section ``bench:``."""
        return SimulatedSettings

    @contextmanager
    def open(self, settings: SimulatedSettings) -> Iterator[SimulatedBench]:
        """An open bench; the scene's light is traced first unless it is in the cache."""
        # Imported here, because tracing needs Open3D and Numba, and the settings alone need neither.
        from sim_backend.devices import SimulatedCamera, SimulatedProjector
        from sim_backend.optics import Optics
        from sim_backend.stage import SimulatedBench

        transports = _transports()
        optics = Optics.of(settings, transports.of(settings))
        clock = VirtualClock(real_time=settings.real_time)
        projector = SimulatedProjector(settings.projector, clock, settings.faults)
        camera = SimulatedCamera(
            settings.camera, optics, projector, clock, np.random.default_rng(settings.seed), settings.faults
        )
        settle_s = settings.settle_s
        if settle_s is None:
            settle_s = settings.projector.latency_s + projector.period_s
        with SimulatedBench(
            name=f"simulated {settings.scene.name}",
            camera=camera,
            projector=projector,
            clock=clock,
            settle_s=settle_s,
            exposure_s=camera.exposure_s,
            timeout_s=2.0 + settings.camera.readout_s,
            simulated=True,
            rig=settings.rig().to_json() if settings.knows_rig else None,
            settings=settings,
            transports=transports,
        ) as bench:
            yield bench

    def truth(self, settings: SimulatedSettings) -> Truth:
        """What is really there; see `drivers.TruthTeller`."""
        return truth_of(settings)


@cache
def _transports() -> RecentTransports:
    """Those of this process: a bench that is opened again for another exposure finds its scene traced."""
    from sim_backend.cache import RecentTransports

    return RecentTransports()


def truth_of(settings: SceneSettings, presented: Mapping[str, Any] | None = None) -> Truth:
    """What is really there, for tests that judge a scan.

    Parameters
    ----------
    settings
        Of the bench.
    presented
        The document of what has been put before it in place of its own scene.
    """
    from sim_backend.optics import Optics
    from sim_backend.truth import Truth

    if presented is not None:
        settings = settings.model_copy(update={"scene": scene_of(presented)})
    optics = Optics.of(settings, _transports().of(settings))
    return Truth(optics, settings.rig(), settings.scene.windows(), settings.scene.part_surfaces())


kind: BenchKind = SimulatedBenchKind()
"""What the entry point names."""
