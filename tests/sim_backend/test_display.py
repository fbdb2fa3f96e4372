"""A display that scans out an array, which the tests write to as an X server would."""

import time

import numpy as np
import pytest

from sim_backend.display import Display
from sim_backend.surface import Surface

REFRESH_HZ = 50.0
PERIOD = 1 / REFRESH_HZ
LATENCY = 0.03


class Watched:
    """A display and all it has shown."""

    def __init__(self):
        self.buffer = np.zeros((6, 8, 4), np.uint8)
        self.surface = Surface(np.zeros((6, 8), np.uint8))
        self.changes = []
        self.display = Display(
            self.buffer[..., 1], self.surface, REFRESH_HZ, 0.5, LATENCY, lambda *change: self.changes.append(change)
        )

    def write(self, level):
        self.buffer[...] = level
        return time.monotonic()

    def wait_for(self, count):
        deadline = time.monotonic() + 3
        while len(self.changes) < count and time.monotonic() < deadline:
            time.sleep(0.001)
        assert len(self.changes) == count
        return self.changes[-1]

    @property
    def refresh_s(self):
        """One refresh, longer by those that a busy machine has made the display miss, and by being late for one."""
        return PERIOD * (1 + self.display.skipped) + 0.006

    @property
    def levels(self):
        return [int(picture[0, 0]) for _, picture in self.changes]


@pytest.fixture
def watched():
    watched = Watched()
    watched.display.start()
    yield watched
    watched.display.close()
    assert not watched.display._thread.is_alive()


def test_a_picture_comes_on_the_latency_after_the_next_scan_out(watched):
    written = watched.write(90)
    moment, _ = watched.wait_for(1)
    scanned = moment - LATENCY
    # The display may look a little later than it says.
    assert -0.005 <= scanned - written <= watched.refresh_s
    # Half a period after a multiple of it, on the machine's monotonic clock.
    assert (scanned / PERIOD) % 1 == pytest.approx(0.5, abs=1e-6)
    ((share, picture),) = watched.surface.during(moment, moment + 0.001)
    assert share == pytest.approx(1)
    assert (picture == 90).all()
    ((_, before),) = watched.surface.during(moment - 0.002, moment - 0.001)
    assert (before == 0).all()


def test_a_picture_that_is_still_being_written_is_waited_for(watched):
    for row in range(6):
        watched.buffer[row] = 200
        time.sleep(0.0003)
    _, picture = watched.wait_for(1)
    assert (picture == 200).all()


def test_equal_pictures_are_the_same_array(watched):
    watched.write(90)
    watched.wait_for(1)
    watched.write(0)
    watched.wait_for(2)
    watched.write(90)
    watched.wait_for(3)
    assert watched.changes[0][1] is watched.changes[2][1]


def test_frozen_it_keeps_its_picture(watched):
    watched.display.freeze(0.2)
    thawed = time.monotonic() + 0.2
    watched.write(90)
    moment, _ = watched.wait_for(1)
    assert thawed - 0.005 <= moment - LATENCY <= thawed + watched.refresh_s


def test_a_dropped_change_comes_a_refresh_later(watched):
    watched.display.drop(1)
    first = watched.write(90)
    moment, _ = watched.wait_for(1)
    assert PERIOD - 0.005 <= moment - LATENCY - first <= PERIOD + watched.refresh_s
    assert watched.display.dropped == 1
    second = watched.write(30)
    moment, _ = watched.wait_for(2)
    assert moment - LATENCY - second <= watched.refresh_s


def test_latency_can_change(watched):
    watched.display.latency_s = 0.1
    written = watched.write(90)
    moment, _ = watched.wait_for(1)
    assert 0.095 <= moment - written <= 0.1 + watched.refresh_s


def test_blacked_out_nothing_is_on_the_surface_and_the_picture_comes_back(watched):
    watched.write(90)
    watched.wait_for(1)
    watched.display.black_out(True)
    watched.wait_for(2)
    watched.write(70)
    watched.display.black_out(False)
    watched.wait_for(3)
    assert watched.levels == [90, 0, 70]


def test_memory_is_bounded_however_long_pictures_change(watched):
    for level in range(1, 80):
        watched.write(level)
        watched.wait_for(level)
    assert len(watched.display._known) <= 64


def test_who_asks_early_is_let_wait_until_the_surface_is_known(watched):
    watched.display.latency_s = 0.0
    watched.write(90)
    end = time.monotonic() + 2 * PERIOD
    watched.display.catch_up(end)
    # Scanned out up to there, and not much later.
    assert end - PERIOD - 0.005 <= time.monotonic() <= end + watched.refresh_s
    assert [int(p[0, 0]) for _, p in watched.surface.during(end - 0.001, end)] == [90]
