"""When a simulated device fails, and how: at the exposures or pictures that settings name, and at random."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sim_backend.settings import FaultSettings


class Fault(StrEnum):
    """What goes wrong with one exposure, or from one picture on."""

    REPEAT = "repeat"
    STALE = "stale"
    TORN = "torn"
    MIXED = "mixed"
    CUT = "cut"
    DARK_FLASH = "dark flash"
    FLICKER = "flicker"
    DROP = "drop"
    LATE = "late"
    INCOMPLETE = "incomplete"
    ID_JUMP = "id jump"
    LOST = "lost camera"
    FREEZE = "freeze"
    LAG = "lag"


class FaultSchedule:
    """Which fault comes at which exposure (of a camera) or picture (of a projector); one at most.

    Parameters
    ----------
    listed
        The numbers, counted from 0, at which each fault comes for certain.
    rates
        The probability of each fault at every other number.
    random
        Draws them, and how large they are.
    """

    def __init__(
        self, listed: Mapping[Fault, Sequence[int]], rates: Mapping[Fault, float], random: np.random.Generator
    ) -> None:
        self._listed = {number: fault for fault, numbers in listed.items() for number in numbers}
        self._kinds = list(rates)
        self._bounds = np.cumsum(list(rates.values()))
        self._random = random

    @classmethod
    def of_exposures(cls, settings: FaultSettings) -> FaultSchedule:
        """What happens to the camera's exposures."""
        rates = settings.rates
        return cls(
            {
                Fault.REPEAT: settings.repeat_frame_at,
                Fault.STALE: settings.stale_at,
                Fault.TORN: settings.torn_at,
                Fault.MIXED: settings.mixed_at,
                Fault.CUT: settings.cut_at,
                Fault.DARK_FLASH: settings.dark_flash_at,
                Fault.FLICKER: settings.flicker_at,
                Fault.DROP: settings.drop_at,
                Fault.LATE: settings.late_at,
                Fault.INCOMPLETE: settings.incomplete_at,
                Fault.ID_JUMP: settings.id_jump_at,
                Fault.LOST: () if settings.lose_camera_at is None else (settings.lose_camera_at,),
            },
            {
                Fault.REPEAT: rates.repeat_frame,
                Fault.STALE: rates.stale,
                Fault.TORN: rates.torn,
                Fault.MIXED: rates.mixed,
                Fault.CUT: rates.cut,
                Fault.DARK_FLASH: rates.dark_flash,
                Fault.FLICKER: rates.flicker,
                Fault.DROP: rates.drop,
                Fault.LATE: rates.late,
                Fault.INCOMPLETE: rates.incomplete,
                Fault.ID_JUMP: rates.id_jump,
                Fault.LOST: rates.lose_camera,
            },
            np.random.default_rng([rates.seed, 0]),
        )

    @classmethod
    def of_pictures(cls, settings: FaultSettings) -> FaultSchedule:
        """What happens to the projector's pictures."""
        rates = settings.rates
        return cls(
            {Fault.FREEZE: settings.freeze_at, Fault.LAG: settings.lag_at},
            {Fault.FREEZE: rates.freeze, Fault.LAG: rates.lag},
            np.random.default_rng([rates.seed, 1]),
        )

    def at(self, number: int) -> Fault | None:
        """The fault at ``number``; numbers are asked for once each, in order."""
        if number in self._listed:
            return self._listed[number]
        if not self._bounds[-1]:
            return None
        drawn = int(np.searchsorted(self._bounds, self._random.random(), side="right"))
        return self._kinds[drawn] if drawn < len(self._kinds) else None

    def between(self, low: float, high: float) -> float:
        """How large, how long or where a fault is."""
        return float(self._random.uniform(low, high))


@dataclass(frozen=True)
class WrongExposure:
    """An exposure that did not show the picture that was asked for, and nothing else: the truth, for tests.

    Parameters
    ----------
    number
        Of the exposure, counted from 0 since the camera was made.
    faults
        What was the matter; empty where the picture simply was not on the surface in time.
    error_dn
        (H, W) expected grey value minus the one that would have been right, in grey values of a frame.
    """

    number: int
    faults: tuple[Fault, ...]
    error_dn: NDArray[np.float32]
