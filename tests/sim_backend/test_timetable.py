import threading
import time

import pytest

from sim_backend.timetable import Timetable


@pytest.fixture
def timetable():
    timetable = Timetable()
    timetable.start()
    yield timetable
    timetable.close()
    assert not timetable._thread.is_alive()


def test_things_happen_in_the_order_of_their_moments(timetable):
    done, finished = [], threading.Event()

    def do(name):
        done.append((name, time.monotonic()))

    begin = time.monotonic() + 0.02
    timetable.at(begin + 0.04, finished.set)
    timetable.at(begin + 0.03, lambda: do("third"))
    timetable.at(begin, lambda: do("first"))
    timetable.at(begin, lambda: do("second"))
    assert finished.wait(2)
    assert [name for name, _ in done] == ["first", "second", "third"]
    for (_, moment), due in zip(done, (begin, begin, begin + 0.03), strict=True):
        assert due <= moment


def test_what_is_late_happens_at_once(timetable):
    done = threading.Event()
    timetable.at(time.monotonic() - 10, done.set)
    assert done.wait(2)


def test_what_had_not_come_when_it_ended_never_does():
    timetable, done = Timetable(), []
    timetable.start()
    timetable.at(time.monotonic() + 0.05, lambda: done.append(1))
    timetable.close()
    time.sleep(0.1)
    assert not done
