"""Strays on analytic surfaces."""

import numpy as np

from scanner.strays import strays


def plane(side=40):
    y, x = np.mgrid[:side, :side].astype(np.float32)
    return 200 + 1.1 * x + 0.2 * y, 100 + 0.9 * y


def test_single_and_paired_wrong_pixels_are_strays():
    x, y = plane()
    wrong = np.zeros(x.shape, bool)
    wrong[10, 10] = wrong[20, 20] = wrong[20, 21] = wrong[0, 0] = wrong[30, 39] = True
    x[wrong] += 16
    np.testing.assert_array_equal(strays(x, y), wrong)
    np.testing.assert_array_equal(strays(None, y), np.zeros_like(wrong))
    np.testing.assert_array_equal(strays(x, None), wrong)


def test_borders_corners_steps_and_narrow_parts_are_none():
    x, y = plane()
    x[:, 20:] += 60  # a step in depth
    x[5:30, 8:10] = y[5:30, 8:10] = np.nan  # a hole
    x[12:28, 30:32] += 40  # a part two pixels wide
    assert not strays(x, y).any()


def test_what_is_missing_is_no_stray():
    x, y = plane()
    x[:] = np.nan
    x[4, 4] = 3
    y[:] = np.where(np.isnan(x), np.nan, 5)
    found = strays(x, y)
    assert found[4, 4]
    assert found.sum() == 1


def test_a_steep_face_beside_a_flat_one_is_none():
    # Seen at a grazing angle a pixel spans many times the usual step, along one direction only.
    x, y = plane()
    x[:, 20:] = x[:, 20:21] + 9 * np.arange(20)
    assert not strays(x, y).any()
    assert not strays(x.T.copy(), y.T.copy()).any()
    x[11, 30] += 40
    assert np.argwhere(strays(x, y)).tolist() == [[11, 30]]
