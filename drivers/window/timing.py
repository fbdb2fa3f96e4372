"""When pictures were flipped, and what that says about the screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_WARM_UP = 10
_SHORTEST_PERIOD_S = 2e-3
_LARGEST_DEVIATION = 0.05


@dataclass(frozen=True)
class FlipTiming:
    """How regularly flips came one after the other.

    Parameters
    ----------
    period_s
        Median time between two flips, s.
    jitter_s
        Nine in ten times differ less from the median than this, s.
    """

    period_s: float
    jitter_s: float

    @classmethod
    def of(cls, flips_s: Sequence[float]) -> FlipTiming:
        """Judge a row of flips (s) that followed each other as fast as they could; the first ten do not count."""
        intervals = np.diff(flips_s)[_WARM_UP:]
        period = float(np.median(intervals))
        return cls(period, float(np.quantile(np.abs(intervals - period), 0.9)))

    def unlocked(self, expected_hz: float | None, max_jitter_s: float) -> str:
        """Why flips do not keep step with a screen of ``expected_hz`` (Hz, None for unknown); empty where they do."""
        if self.period_s < _SHORTEST_PERIOD_S:
            return f"a flip takes {self.period_s * 1e3:.2f} ms: it does not wait for the screen"
        if expected_hz is not None and abs(self.period_s * expected_hz - 1) > _LARGEST_DEVIATION:
            return f"flips come every {self.period_s * 1e3:.2f} ms, refreshes every {1e3 / expected_hz:.2f} ms"
        if self.jitter_s > max_jitter_s:
            return f"flips come irregularly: ±{self.jitter_s * 1e3:.2f} ms, allowed are {max_jitter_s * 1e3:g} ms"
        return ""


def late_pictures(shown_s: Sequence[float], hold: int, refresh_s: float) -> tuple[int, ...]:
    """Numbers of the pictures that came half a refresh or more later after the one before than they should have.

    Parameters
    ----------
    shown_s
        When each was flipped, s.
    hold
        For how many refreshes each is on.
    refresh_s
        Time of one refresh, s.
    """
    late = np.diff(shown_s) > (hold + 0.5) * refresh_s
    return tuple(int(number) + 1 for number in np.flatnonzero(late))
