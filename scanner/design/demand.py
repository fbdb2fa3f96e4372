"""What a plan is wanted for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import OperatorError
from scanner.patterns import Axis

_DELTA_STEP_PX = 1.0
"""Steps of Δu; the residual's size changes within a fringe."""


class DesignError(OperatorError):
    """No plan meets the demand."""


@dataclass(frozen=True)
class Demand:
    """What a plan is wanted for.

    Parameters
    ----------
    size
        Projector (width, height), px.
    frames
        Frames of one round, all axes together, at most.
    from_px, to_px
        Range of Δu, the distance on the projector between the two paths of a pixel, that matters.
    relative_noise
        σ/B: noise of a frame over the fringe modulation.
    false_alarm_rate
        Of the detection.
    axes
        To measure.
    steps
        Least and most phase steps N; from 4 on a stale frame shows.
    shortest_px, longest_px
        Range of the periods: the shortest that projector and camera resolve, the longest for which diffuse bounces
        average out.
    blur_px
        Standard deviation of projector and camera blur together, projector px.
    wrong_orders
        Probability of a wrong fringe order at most.
    separable
        Whether two paths must be separable from this round alone, which MFS asks for: equidistant frequencies whose
        spacing is unambiguous over the projector. Otherwise any frequencies are allowed.
    """

    size: tuple[int, int] = (1280, 800)
    frames: int = 108
    from_px: float = 16
    to_px: float = 600
    relative_noise: float = 0.05
    false_alarm_rate: float = 0.01
    axes: tuple[Axis, ...] = ("x", "y")
    steps: tuple[int, int] = (4, 12)
    shortest_px: float = 12
    longest_px: float = 20
    blur_px: float = 1.0
    wrong_orders: float = 1e-3
    separable: bool = True

    def extent(self, axis: Axis) -> int:
        """Projector pixels along ``axis``."""
        return self.size[0] if axis == "x" else self.size[1]

    def orders(self, axis: Axis) -> NDArray[np.int64]:
        """Fringes over the whole picture, those that the range of periods allows."""
        extent = self.extent(axis)
        return np.arange(math.ceil(extent / self.longest_px - 1e-9), math.floor(extent / self.shortest_px + 1e-9) + 1)

    def deltas(self, axis: Axis) -> NDArray[np.float64]:
        """(n,) Δu that matter along ``axis``, px."""
        return np.arange(self.from_px, min(self.to_px, self.extent(axis)) + 1e-9, _DELTA_STEP_PX)
