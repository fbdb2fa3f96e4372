"""Projector coordinates at a board's points, from fringes rendered on its print, against the projector's own view."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from board_pictures import View, camera, phasors

from calibration.boards import Charuco, Chessboard, Circles
from calibration.correspondence import observe
from calibration.observations import BoardPose, BoardView

FREQUENCY = 1 / 16
SIGMA_Z = 1.5 * np.sqrt(2 / 12)
PROJECTOR = np.array([[2000.0, 0, 640], [0, 2000, 400], [0, 0, 1]])
DISTORTION = np.array([-0.1, 0.05, 0, 0, 0])
ROTATION, TRANSLATION = np.array([0.0, 0.4, 0.02]), np.array([170.0, 3, 30])
SEEN = View(BoardPose(430, -5, 8, 25, -20, 6), *camera(k1=-0.15))
BOARDS = {
    "chessboard": Chessboard(columns=8, rows=7, square_mm=10.0),
    "charuco": Charuco(squares_x=6, squares_y=5, square_mm=18.0, marker_mm=11.0),
    "circles": Circles(columns=6, rows=5, spacing_mm=14.0, diameter_mm=7.0),
}


def projected(points):
    cam = points @ SEEN.rotation.T + SEEN.translation
    return cv2.projectPoints(cam[:, None], ROTATION, TRANSLATION, PROJECTOR, DISTORTION)[0][:, 0]


@cache
def recorded(kind):
    """Phasors of the board, and which column every pixel sees, to settle the fringe order."""
    z = phasors(SEEN, BOARDS[kind], lambda points: projected(points)[:, 0], FREQUENCY, blur_px=0.8, fine=3)
    rows, columns = np.nonzero(np.isfinite(z))
    places = SEEN.on_board(np.column_stack((columns, rows)))
    column = np.full(z.shape, np.nan)
    column[rows, columns] = projected(np.column_stack((places, 0 * places[:, 0])))[:, 0]
    return z, column


def decoded(kind, rng):
    """x_p, σ and modulation as a scan with twelve steps has them."""
    z, column = recorded(kind)
    z = z + SIGMA_Z * (rng.normal(size=z.shape) + 1j * rng.normal(size=z.shape))
    x_p = np.angle(z) / (2 * np.pi * FREQUENCY)
    x_p += np.rint((column - x_p) * FREQUENCY) / FREQUENCY
    modulation = np.abs(z)
    sigma = SIGMA_Z / modulation / (2 * np.pi * FREQUENCY)
    return tuple(map_.astype(np.float32) for map_ in (x_p, sigma, modulation))


def view_of(board, sigma=1e-5, xy=None):
    ids = np.arange(len(board.points))
    return BoardView(ids, SEEN.project(board.points) if xy is None else xy, np.full(len(ids), sigma))


@pytest.mark.parametrize("kind", BOARDS)
def test_errors_are_what_sigma_says(kind):
    board, rng = BOARDS[kind], np.random.default_rng(1)
    truth = projected(board.points)[:, 0]
    errors, sigmas = [], []
    for _ in range(3):
        x_p, sigma, modulation = decoded(kind, rng)
        seen = observe("pose", view_of(board), board, x_p, sigma, None, None, modulation)
        assert np.isnan(seen.projector[:, 1]).all()
        errors.append(seen.projector[:, 0] - truth)
        sigmas.append(seen.projector_sigma[:, 0])
    errors, sigma = np.array(errors), np.array(sigmas)
    assert np.isfinite(errors).all()
    # One pixel has 0.02 px; what blur at edges and the local model leave is below a thousandth.
    common = np.mean(errors, axis=0)
    assert np.sqrt(max(np.mean(common**2) - np.mean(sigma**2) / 3, 0)) < 0.0012
    assert np.sqrt(np.mean(errors**2)) < 0.003
    # Markers leave narrow rims, so near to print that blur has a share that σ does not know.
    assert 0.75 < np.sqrt(np.mean((errors / sigma) ** 2)) < (2.0 if kind == "charuco" else 1.4)


def test_an_error_of_the_corner_is_told_from_the_coordinate_s_own():
    board, rng = BOARDS["chessboard"], np.random.default_rng(2)
    truth = projected(board.points)[:, 0]
    x_p, sigma, modulation = decoded("chessboard", rng)
    xy = SEEN.project(board.points) + rng.normal(0, 0.05, (len(board.points), 2))
    seen = observe("pose", view_of(board, 0.05, xy), board, x_p, sigma, None, None, modulation)
    moved = np.einsum("nj,nj->n", seen.projector_gradient[:, 0], xy - SEEN.project(board.points))
    assert moved.std() > 10 * np.median(seen.projector_sigma[:, 0])
    normalised = (seen.projector[:, 0] - truth - moved) / seen.projector_sigma[:, 0]
    assert 0.75 < np.sqrt(np.mean(normalised**2)) < 1.4  # 56 values: ± 10 %


def test_points_do_not_share_their_errors():
    """The mean over the board errs as that of independent points does; shared pixels would double it."""
    board, rng = BOARDS["chessboard"], np.random.default_rng(7)
    truth = projected(board.points)[:, 0]
    means, expected = [], []
    for _ in range(12):
        x_p, sigma, modulation = decoded("chessboard", rng)
        seen = observe("pose", view_of(board), board, x_p, sigma, None, None, modulation)
        means.append(np.mean(seen.projector[:, 0] - truth))
        expected.append(np.sqrt(np.sum(seen.projector_sigma[:, 0] ** 2)) / len(truth))
    assert 0.5 < np.std(means, ddof=1) / np.mean(expected) < 1.6  # 12 values: ± 21 %


def test_both_axes_and_names():
    board = BOARDS["chessboard"]
    x_p, sigma, modulation = decoded("chessboard", np.random.default_rng(3))
    seen = observe("pose 3", view_of(board, 0.01), board, x_p, sigma, x_p + 7, sigma, modulation)
    np.testing.assert_allclose(seen.projector[:, 1] - seen.projector[:, 0], 7, atol=1e-4)
    assert seen.name == "pose 3"
    np.testing.assert_array_equal(seen.points_board, board.points)
    assert seen.camera_sigma.shape == seen.camera.shape == seen.projector.shape


def test_dark_squares_are_never_read():
    board = BOARDS["chessboard"]
    x_p, sigma, modulation = decoded("chessboard", np.random.default_rng(4))
    expected = observe("pose", view_of(board), board, x_p, sigma, None, None, modulation)
    dark = modulation < 40
    spoilt = np.where(dark, x_p + 50, x_p).astype(np.float32)
    claimed = np.where(dark, 1e-4, sigma).astype(np.float32)  # with the best σ of all
    seen = observe("pose", view_of(board), board, spoilt, claimed, None, None, modulation)
    np.testing.assert_array_equal(seen.projector, expected.projector)


def test_wrong_fringe_orders_are_outvoted():
    board, rng = BOARDS["chessboard"], np.random.default_rng(5)
    truth = projected(board.points)[:, 0]
    x_p, sigma, modulation = decoded("chessboard", rng)
    wrong = rng.random(x_p.shape) < 0.15
    x_p[wrong] += rng.choice([-16, 16, 1280], wrong.sum()).astype(np.float32)
    seen = observe("pose", view_of(board), board, x_p, sigma, None, None, modulation)
    assert np.sqrt(np.mean((seen.projector[:, 0] - truth) ** 2)) < 0.003


def test_refused_and_shadowed_pixels_leave_no_coordinate():
    board = BOARDS["chessboard"]
    x_p, sigma, modulation = decoded("chessboard", np.random.default_rng(6))
    xy = SEEN.project(board.points)
    edge = float(np.median(xy[:, 0]))
    columns = np.arange(x_p.shape[1])
    refused = np.broadcast_to(columns < edge, x_p.shape)
    shadow = np.where(columns < edge, 0.05, 1.0).astype(np.float32) * modulation
    for seen in (
        observe("pose", view_of(board), board, x_p, sigma, None, None, modulation, ~refused),
        observe("pose", view_of(board), board, x_p, sigma, None, None, shadow),
    ):
        known = np.isfinite(seen.projector[:, 0])
        np.testing.assert_array_equal(known, np.isfinite(seen.projector_sigma[:, 0]))
        assert not known[xy[:, 0] < edge - 8].any()  # pixels to one side only would be extrapolated
        assert known[xy[:, 0] > edge + 20].all()
        truth = projected(board.points)[:, 0]
        assert np.abs(seen.projector[known, 0] - truth[known]).max() < 0.02


def test_maps_must_belong_together():
    board = BOARDS["chessboard"]
    maps = np.zeros((4, 4), np.float32)
    with pytest.raises(ValueError, match="neither"):
        observe("pose", view_of(board), board, None, None, None, None, maps)
    with pytest.raises(ValueError, match="both be given"):
        observe("pose", view_of(board), board, maps, None, None, None, maps)
    with pytest.raises(ValueError, match="one shape"):
        observe("pose", view_of(board), board, maps, np.zeros((4, 5), np.float32), None, None, maps)
