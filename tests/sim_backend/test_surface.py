import numpy as np
import pytest

from sim_backend.surface import Surface

A, B, C = (np.full((2, 3), level, np.uint8) for level in (10, 20, 30))


def levels(shares):
    return [(round(share, 9), int(picture[0, 0])) for share, picture in shares]


def test_pictures_share_the_time_they_were_on():
    surface = Surface(A)
    surface.appear(1.0, B)
    surface.appear(2.0, C)
    assert levels(surface.during(0.0, 1.0)) == [(1.0, 10)]
    assert levels(surface.during(0.5, 2.5)) == [(0.25, 10), (0.5, 20), (0.25, 30)]
    assert levels(surface.during(2.0, 9.0)) == [(1.0, 30)]


def test_what_never_came_on_is_replaced():
    surface = Surface(A)
    surface.appear(2.0, B)
    surface.appear(1.5, C)
    assert levels(surface.during(0.0, 3.0)) == [(0.5, 10), (0.5, 30)]


def test_stale_is_the_time_line_without_its_latest_change():
    surface = Surface(A)
    surface.appear(1.0, B)
    surface.appear(2.0, C)
    assert levels(surface.during(1.5, 2.5, stale=True)) == [(1.0, 20)]


@pytest.mark.parametrize("begin", [0.0, 0.7, 1.0, 3.3, 7.0])
def test_forgetting_changes_no_later_answer(begin):
    whole, lean = Surface(A), Surface(A)
    for moment, picture in enumerate((B, C, A, C, B)):
        whole.appear(moment + 1.0, picture)
        lean.appear(moment + 1.0, picture)
    lean.forget(begin)
    for stale in (False, True):
        assert levels(lean.during(begin, 8.0, stale=stale)) == levels(whole.during(begin, 8.0, stale=stale))


def test_what_is_forgotten_takes_no_memory():
    surface = Surface(A)
    for n in range(1000):
        surface.appear(float(n), B)
        surface.forget(float(n) - 5)
    assert len(surface._changes) < 10
