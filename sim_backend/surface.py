"""What is on the lit surface, and since when: the time line between a display and a camera."""

from __future__ import annotations

import math
import threading
from collections import deque

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


class Surface:
    """Pictures one after the other, each on the surface until the next one comes; safe to share among threads.

    Parameters
    ----------
    picture
        (height, width) what is on it from the beginning.
    """

    def __init__(self, picture: Picture) -> None:
        self._changes: deque[tuple[float, Picture]] = deque([(-math.inf, picture)])
        self._lock = threading.Lock()

    def appear(self, moment: float, picture: Picture) -> None:
        """Have ``picture`` (height, width) come on at ``moment``, s; whatever has not come on by then is replaced."""
        with self._lock:
            while self._changes[-1][0] >= moment:
                self._changes.pop()
            self._changes.append((moment, picture))

    def during(self, begin: float, end: float, *, stale: bool = False) -> list[tuple[float, Picture]]:
        """Shares of the time from ``begin`` to ``end`` (s) and the pictures (height, width) that were on.

        Parameters
        ----------
        begin, end
            s.
        stale
            Pretend that the latest change has not come about.
        """
        with self._lock:
            changes = list(self._changes)
        if stale and len(changes) > 1:
            del changes[-1]
        ends = [on for on, _ in changes[1:]] + [math.inf]
        overlaps = [(min(off, end) - max(on, begin), picture) for (on, picture), off in zip(changes, ends, strict=True)]
        return [(overlap / (end - begin), picture) for overlap, picture in overlaps if overlap > 0]

    def forget(self, moment: float) -> None:
        """Let go of the pictures that nobody will ask for who asks for ``moment`` (s) or later, stale or not."""
        with self._lock:
            while len(self._changes) > 2 and self._changes[2][0] <= moment:
                self._changes.popleft()
