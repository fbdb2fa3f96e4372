"""The simulated bench as an object that things can be put before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from drivers import DeviceSettingError, SteppedBench
from sim_backend.cache import RecentTransports
from sim_backend.devices import SimulatedCamera
from sim_backend.optics import Optics
from sim_backend.scenes import scene_of
from sim_backend.settings import SimulatedSettings

_FAULTS_NAMED = 3


@dataclass
class SimulatedBench(SteppedBench):
    """A stepped bench whose scene can be changed; see `drivers.Presenter`.

    Parameters
    ----------
    settings
        Of the bench.
    transports
        Where light transport comes from.
    """

    camera: SimulatedCamera
    settings: SimulatedSettings = field(kw_only=True)
    transports: RecentTransports = field(kw_only=True)

    def present(self, thing: Mapping[str, Any]) -> None:
        """Look at another scene.

        Parameters
        ----------
        thing
            JSON document of one of `sim_backend.scenes.Scene`.

        Raises
        ------
        DeviceSettingError
            It describes none of them.
        """
        try:
            scene = scene_of(thing)
        except ValidationError as error:
            raise _refused(self.name, error) from None
        settings = self.settings.model_copy(update={"scene": scene})
        self.camera.look_at(Optics.of(settings, self.transports.of(settings)))
        self.settings, self.name = settings, f"simulated {scene.name}"

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of all devices."""
        # The base names the synchronisation by its own class.
        return {**super().describe(), "synchronisation": "stepped"}


def _refused(bench: str, error: ValidationError) -> DeviceSettingError:
    faults = [
        f"{'.'.join(map(str, fault['loc'])) or 'thing'}: {fault['msg']}"
        for fault in error.errors(include_url=False, include_input=False)
    ]
    more = f" and {len(faults) - _FAULTS_NAMED} more" if len(faults) > _FAULTS_NAMED else ""
    return DeviceSettingError(
        f"{bench}: what is to be presented is no object it knows: {'; '.join(faults[:_FAULTS_NAMED])}{more}",
        "Give a document as bench.scene of a configuration has it; `scan schema` lists the objects and their fields.",
    )
