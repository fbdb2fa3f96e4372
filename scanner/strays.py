"""Strays: coordinates that hardly any neighbour continues.

A pixel that mixes two surfaces, or holds a wrong fringe, stands alone in front of or behind what is around it, and no
test of its own fringes needs to notice. On a surface, however narrow, some of the eight neighbours go on with it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from scanner.kernels import over_rows
from scanner.regions import pitch

_FEWEST = 3
"""Neighbours that go on with a coordinate: a line one pixel wide has two, its end one."""

_NEAR_PX = 3.0
"""A neighbour goes on with it up to this and twice the distance that is usual around, px."""

_AROUND_PX = 5
"""Side of what counts as around, camera px: a face that is seen at a grazing angle has its own usual distance."""

_ROUNDS = 2
"""Two or three strays side by side are neighbours of each other, until the first of them is gone."""


def strays(x: NDArray[np.float32] | None, y: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """(H, W) bool, the pixels whose coordinates are strays.

    Parameters
    ----------
    x, y
        (H, W) projector coordinates, px, NaN where there is none; None where the axis was not projected.
    """
    planes = [np.ascontiguousarray(u, np.float32) for u in (x, y) if u is not None]
    limit = _NEAR_PX + 2 * np.maximum.reduce([_usual_step(u) for u in planes])
    first, second = planes[0], planes[-1]
    known = np.isfinite(first) & np.isfinite(second)
    kept = known.copy()
    for _ in range(_ROUNDS):
        before, kept = kept, np.zeros_like(kept)
        over_rows(lambda a, b: _continued(first, second, before, limit, kept, a, b), len(first))  # noqa: B023
    return known & ~kept


def _usual_step(u: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) distance from neighbour to neighbour that is usual around a pixel, in the steeper direction, px."""
    usual = np.full(u.shape, pitch(u, u), np.float32)
    for axis in (0, 1):
        # The last pixel has the step of the one before it.
        step = np.pad(np.abs(np.diff(u, axis=axis)), [(0, int(k == axis)) for k in (0, 1)], mode="edge")
        around = cv2.medianBlur(np.nan_to_num(step, nan=0.0), _AROUND_PX)
        usual = np.maximum(usual, around)
    return usual


@njit(cache=True, nogil=True)
def _continued(x, y, known, limit, kept, start, stop):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    height, width = x.shape
    for i in range(start, stop):
        for j in range(width):
            if not known[i, j]:
                continue
            count = 0
            for k in range(max(i - 1, 0), min(i + 2, height)):
                for m in range(max(j - 1, 0), min(j + 2, width)):
                    if known[k, m] and abs(x[k, m] - x[i, j]) < limit[i, j] and abs(y[k, m] - y[i, j]) < limit[i, j]:
                        count += 1
            # The pixel itself is one of them.
            kept[i, j] = count > _FEWEST
