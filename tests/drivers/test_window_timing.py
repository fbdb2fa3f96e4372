"""What flip times say, on times written by hand."""

import numpy as np
import pytest

from drivers.window.timing import FlipTiming, late_pictures


def flips(period_s, count=100, jitter_s=0.0, warm_up=0):
    intervals = np.full(count, period_s)
    intervals[:warm_up] = 0.1
    intervals[::2] += jitter_s
    return np.cumsum(intervals).tolist()


def test_period_and_jitter_leave_out_the_start():
    timing = FlipTiming.of(flips(0.0125, warm_up=9))
    assert timing.period_s == pytest.approx(0.0125)
    assert timing.jitter_s == pytest.approx(0, abs=1e-12)


def test_jitter_is_what_nine_in_ten_stay_below():
    times = np.cumsum([0.01] * 111)
    times[50:] += 0.005  # one flip that comes late
    assert FlipTiming.of(times.tolist()).jitter_s == pytest.approx(0, abs=1e-12)
    assert FlipTiming.of(flips(0.01, jitter_s=2e-3)).jitter_s == pytest.approx(2e-3)


@pytest.mark.parametrize(
    ("timing", "expected_hz", "said"),
    [
        (FlipTiming(1 / 60, 1e-4), 60.0, ""),
        (FlipTiming(1 / 60, 1e-4), 59.94, ""),
        (FlipTiming(1 / 60, 1e-4), None, ""),
        (FlipTiming(1 / 57.5, 1e-4), 60.0, ""),
        (FlipTiming(1 / 56.5, 1e-4), 60.0, "every 17.70 ms, refreshes every 16.67 ms"),
        (FlipTiming(1 / 60, 1e-4), 120.0, "every 16.67 ms, refreshes every 8.33 ms"),
        (FlipTiming(1 / 60, 1.2e-3), 60.0, "irregularly: ±1.20 ms, allowed are 1 ms"),
        (FlipTiming(1.9e-3, 1e-4), None, "does not wait for the screen"),
    ],
)
def test_flips_keep_step_or_say_why_not(timing, expected_hz, said):
    answer = timing.unlocked(expected_hz, 1e-3)
    assert said in answer
    assert bool(said) == bool(answer)


@pytest.mark.parametrize(
    ("refreshes", "hold", "late"),
    [
        ([0, 1, 2, 3, 4], 1, ()),
        ([0, 1, 2, 4, 5], 1, (3,)),
        ([0, 2, 3, 7, 8], 1, (1, 3)),
        ([0, 1.4, 2, 3.4, 4], 1, ()),
        ([0, 3, 6, 9], 3, ()),
        ([0, 3, 7, 10], 3, (2,)),
        ([5], 1, ()),
        ([], 1, ()),
    ],
)
def test_pictures_are_late_by_a_refresh_or_more(refreshes, hold, late):
    assert late_pictures(np.array(refreshes) / 60, hold, 1 / 60) == late
