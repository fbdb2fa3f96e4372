"""Real time."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.devices import Clock

_TOGETHER_S = 1e-4
_READINGS = 20


class SystemClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        if seconds > 0:
            time.sleep(seconds)


def ahead_of_monotonic(clock: Clock) -> float:
    """How far ``clock`` is ahead of the machine's monotonic clock, s; to be added to a monotonic time.

    Notes
    -----
    Both are read one after the other. Where the thread was held up in between, by the scheduler for one, they are read
    again: the time stamps of a device would be wrong by as much. The closest of a few readings counts.
    """
    if type(clock) is SystemClock:
        return 0.0
    least_s, ahead_s = float("inf"), 0.0
    for _ in range(_READINGS):
        before = time.monotonic()
        now = clock.now()
        apart_s = time.monotonic() - before
        if apart_s < least_s:
            least_s, ahead_s = apart_s, now - before - apart_s / 2
        if least_s < _TOGETHER_S:
            break
    return ahead_s
