"""Real time."""

from __future__ import annotations

import time


class SystemClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        if seconds > 0:
            time.sleep(seconds)
