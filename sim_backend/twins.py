"""The same bench without bounces on what is measured: what a method is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_backend.settings import SceneSettings
from sim_backend.truth import Truth

_Settings = TypeVar("_Settings", bound=SceneSettings)


@dataclass(frozen=True)
class Twin(Generic[_Settings]):
    """A bench with black emitters, and what is measured on it.

    Parameters
    ----------
    settings
        Of the bench.
    part
        Name of the part that is measured.
    surfaces
        Numbers of its surfaces, as in `Truth.object_id`.
    """

    settings: _Settings
    part: str
    surfaces: tuple[int, ...]

    def pixels(self, truth: Truth) -> NDArray[np.bool_]:
        """(height, width) whether a pixel sees what is measured; the same for the bench and its twin."""
        return np.isin(truth.object_id, self.surfaces)


def without_bounces(settings: _Settings) -> _Settings:
    """The same bench where light is reflected once only.

    It is all the twins of `twins_of` in one: on what they measure, direct light is all that is left.
    """
    transport = settings.transport.model_copy(update={"specular_bounces": 0, "diffuse_bounces": 0})
    return settings.model_copy(update={"transport": transport})


def twins_of(settings: _Settings) -> tuple[Twin[_Settings], ...]:
    """A twin for each part of the scene that is there to be measured: all others are black.

    No paint keeps a part from throwing light on itself; where it may, light is reflected once only, in addition.
    """
    parts, numbers = settings.scene.parts(), settings.scene.part_surfaces()
    twins = []
    for name, some in parts.items():
        if name not in (settings.scene.MEASURED or settings.scene.part_names):
            continue
        others = tuple(other for other in parts if other != name)
        twin = settings.model_copy(update={"scene": settings.scene.model_copy(update={"blackened": others})})
        if len(some) > 1 or some[0].lights_itself:
            twin = without_bounces(twin)
        twins.append(Twin(twin, name, numbers[name]))
    return tuple(twins)
