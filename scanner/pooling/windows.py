"""Overlapping square windows over the picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

WINDOW = 16
"""Side of a window, px: the phase of a bounce must run evenly over so many pixels."""

_STRIDE = 8
"""From window to window, px: every pixel lies in four, and one of them is seldom cut by a border."""


@dataclass(frozen=True)
class Windows:
    """Where the windows begin, their side, and of every row and column the first and last window that covers it."""

    side: int
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    row_range: NDArray[np.intp]
    column_range: NDArray[np.intp]

    @classmethod
    def over(cls, shape: tuple[int, ...], side: int = WINDOW, stride: int = _STRIDE) -> Windows:
        """Those of a picture (H, W), ``stride`` px from each other; none where it is smaller than one."""
        rows, columns = (
            np.unique(np.append(np.arange(0, n - side + 1, stride), n - side)) if n >= side else np.arange(0)
            for n in shape
        )
        return cls(side, rows, columns, _covering(rows, shape[0], side), _covering(columns, shape[1], side))

    @property
    def shape(self) -> tuple[int, int]:
        """(n, m) windows down and across."""
        return len(self.rows), len(self.columns)

    def sums(self, values: NDArray[Any]) -> NDArray[np.float32]:
        """(n, m) sum of (H, W) values over every window."""
        result = np.zeros(self.shape, np.float32)
        for i, y in enumerate(self.rows):
            total = np.concatenate(([0.0], np.cumsum(values[y : y + self.side].sum(axis=0, dtype=np.float64))))
            result[i] = total[self.columns + self.side] - total[self.columns]
        return result


def _covering(starts: NDArray[np.intp], length: int, side: int) -> NDArray[np.intp]:
    """(length, 2) first and last + 1 of the windows that cover a row or column."""
    places = np.arange(length)
    return np.stack(
        [np.searchsorted(starts, places - side, side="right"), np.searchsorted(starts, places, side="right")], axis=1
    )
