"""How much of a small place is dark, against counting points."""

import itertools

import cv2
import numpy as np
import pytest

from sim_backend.prints import Print

# An L, a triangle run through the other way round, two rectangles that touch.
POLYGONS = (
    ((-20.0, -12.0), (-5.0, -12.0), (-5.0, -8.0), (-14.0, -8.0), (-14.0, 10.0), (-20.0, 10.0)),
    ((3.0, 8.0), (12.0, -3.0), (1.0, -9.0)),
    ((14.0, 0.0), (18.0, 0.0), (18.0, 6.0), (14.0, 6.0)),
    ((18.0, 0.0), (22.0, 0.0), (22.0, 6.0), (18.0, 6.0)),
)
DISCS = ((-6.0, 2.0, 5.0), (15.0, -8.0, 3.5))


def _inside(x, y):
    """Whether points are in a figure: half-planes and distances."""
    left, right = (x > -20) & (x < -14) & (y > -12) & (y < 10), (x > -20) & (x < -5) & (y > -12) & (y < -8)
    triangle = np.ones(np.shape(x), bool)
    corners = np.array(POLYGONS[1])
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        triangle &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) < 0
    boxes = (x > 14) & (x < 22) & (y > 0) & (y < 6)
    return left | right | triangle | boxes | np.any([(x - u) ** 2 + (y - v) ** 2 < r * r for u, v, r in DISCS], axis=0)


def test_points_are_dark_within_the_figures():
    places = np.random.default_rng(0).uniform(-25, 25, (5000, 2))
    dark = Print.of(POLYGONS, DISCS).dark_share(places, np.zeros((5000, 2, 2)))
    np.testing.assert_array_equal(dark, _inside(*places.T))
    assert 0.1 < dark.mean() < 0.5


def test_shares_are_those_that_counting_gives():
    rng = np.random.default_rng(1)
    turn = rng.uniform(0, 2 * np.pi, 100)
    along = rng.random((100, 1))
    rims = [along * np.array(a) + (1 - along) * b for ring in POLYGONS for a, b in itertools.pairwise(ring)]
    rims += [np.column_stack((x + r * np.cos(turn), y + r * np.sin(turn))) for x, y, r in DISCS]
    places = rng.permutation(np.concatenate(rims))[:400] + rng.uniform(-0.2, 0.2, (400, 2))
    sides = rng.uniform(-0.4, 0.4, (400, 2, 2))
    share = Print.of(POLYGONS, DISCS).dark_share(places, sides)
    offset = (np.arange(64) + 0.5) / 64 - 0.5
    a, b = (o.ravel() for o in np.meshgrid(offset, offset))
    points = places[:, None] + a[:, None] * sides[:, None, 0] + b[:, None] * sides[:, None, 1]
    counted = _inside(points[..., 0], points[..., 1]).mean(1)
    on_edge = (counted > 0) & (counted < 1)
    assert on_edge.sum() > 100
    # Of 64² points those along an edge are undecided; where a disc's edge counts as straight, w²/24r of its width too.
    np.testing.assert_allclose(share, counted, atol=0.02)
    assert abs((share - counted)[on_edge].mean()) < 1e-3


def test_a_place_larger_than_all_figures_holds_their_area():
    area = sum(cv2.contourArea(np.array(ring, np.float32)) for ring in POLYGONS)
    share = Print.of(POLYGONS, ()).dark_share(np.array([[1.0, 0.5]]), np.array([[[70.0, 10.0], [-20.0, 90.0]]]))
    assert share[0] == pytest.approx(area / (70 * 90 + 20 * 10), rel=1e-12)


def test_nothing_printed_is_nowhere_dark():
    assert Print.of((), ()).dark_share(np.zeros((3, 2)), np.ones((3, 2, 2))).max() == 0


def test_places_at_infinity_are_light():
    dark = Print.of(POLYGONS, DISCS).dark_share(np.array([[np.nan, 0.0], [1e300, 0.0]]), np.zeros((2, 2, 2)))
    assert dark.tolist() == [0, 0]
