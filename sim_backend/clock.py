"""Time that passes only when somebody waits for it."""

from __future__ import annotations

import threading
import time


class VirtualClock:
    """A clock that starts at 0 and jumps ahead when asked to sleep; safe to share among threads.

    Parameters
    ----------
    real_time
        Let the same real time pass as well.
    """

    def __init__(self, *, real_time: bool = False) -> None:
        self._now = 0.0
        self._real_time = real_time
        self._lock = threading.Lock()

    def now(self) -> float:
        """Virtual time, s."""
        with self._lock:
            return self._now

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        self.sleep_until(self.now() + seconds)

    def sleep_until(self, moment: float) -> None:
        """Let time pass until ``moment``, s; does nothing if that is over."""
        if self._real_time:
            time.sleep(max(0.0, moment - self.now()))
        with self._lock:
            self._now = max(self._now, moment)
