"""Places of a scene that results are judged in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.surfaces import Array


@dataclass(frozen=True, eq=False)
class Window:
    """What of a surface lies before or behind a rectangle, seen at right angles to it.

    Parameters
    ----------
    surface
        Number of the surface, in the order of the scene's ``surfaces()``.
    centre
        (3,) mm, camera frame.
    half_width, half_height
        (3,) mm, from the centre to the middle of two neighbouring sides, at right angles.
    """

    surface: int
    centre: Array
    half_width: Array
    half_height: Array

    def holds(self, points: NDArray[np.float64], object_id: NDArray[np.int8]) -> NDArray[np.bool_]:
        """(height, width) whether pixels see a point of the window.

        Parameters
        ----------
        points
            (height, width, 3) mm in the camera frame that the pixels see, NaN for none.
        object_id
            (height, width) numbers of the surfaces that the points lie on.
        """
        offset = points - self.centre
        with np.errstate(invalid="ignore"):
            within = [np.abs(offset @ half) <= half @ half for half in (self.half_width, self.half_height)]
        return np.asarray((object_id == self.surface) & within[0] & within[1], bool)
