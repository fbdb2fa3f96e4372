import threading
import time

import pytest

from drivers import Clock
from sim_backend.clock import VirtualClock


def test_time_passes_only_by_sleeping():
    clock = VirtualClock()
    assert isinstance(clock, Clock)
    begin = time.monotonic()
    clock.sleep(3600)
    clock.sleep(0.25)
    assert clock.now() == pytest.approx(3600.25)
    clock.sleep_until(10)
    clock.sleep(-5)
    assert clock.now() == pytest.approx(3600.25)
    assert time.monotonic() - begin < 1


def test_real_time_really_passes():
    clock = VirtualClock(real_time=True)
    begin = time.monotonic()
    clock.sleep(0.05)
    assert time.monotonic() - begin >= 0.05
    assert clock.now() == pytest.approx(0.05)


def test_time_never_runs_backwards_among_threads():
    clock = VirtualClock()
    seen: list[list[float]] = [[] for _ in range(4)]

    def use(moments: list[float]) -> None:
        for _ in range(500):
            clock.sleep(0.001)
            moments.append(clock.now())

    threads = [threading.Thread(target=use, args=(moments,)) for moments in seen]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(moments == sorted(moments) for moments in seen)
    assert 0.5 - 1e-9 <= clock.now() <= 2.0 + 1e-9
