"""Definitions of boards: points and print against OpenCV and against counting; what is refused, and how it is said."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards import AsymmetricCircles, Charuco, Chessboard, Circles, board_from, load_board
from calibration.observations import BoardPose
from scanner.config import ConfigError

READY = sorted((Path(__file__).resolve().parents[2] / "configs" / "boards").glob("*.yaml"))


def rasterised(board, scale):
    """(H, W) uint8 of the pattern, from polygons and discs; each pixel is asked at its middle."""
    width, height = (round(side * scale) for side in board.pattern_mm)
    x, y = np.meshgrid((np.arange(width) + 0.5) / scale, (np.arange(height) + 0.5) / scale)
    x, y = x - board.pattern_mm[0] / 2, y - board.pattern_mm[1] / 2
    dark = np.zeros(x.shape, bool)
    for polygon in board.polygons:
        assert polygon.shape == (4, 2)
        begin, end = np.ceil((polygon[[0, 2]] + np.array(board.pattern_mm) / 2) * scale - 0.5).astype(int)
        dark[begin[1] : end[1], begin[0] : end[0]] = True
    for cx, cy, radius in board.discs:
        dark |= np.hypot(x - cx, y - cy) < radius
    return np.where(dark, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("path", READY, ids=lambda path: path.stem)
def test_ready_boards_load_and_fit_a_paper(path):
    board = load_board(path)
    assert max(board.size_mm) < 420
    assert min(board.size_mm) < 297
    np.testing.assert_allclose(board.points[:, :2].min(axis=0), -board.points[:, :2].max(axis=0))  # the middle is 0
    assert all(line.strip().startswith("#") or "#" in line for line in path.read_text().splitlines() if line.strip())


def test_all_kinds_are_ready():
    kinds = {load_board(path).kind for path in READY}
    assert kinds == {"chessboard", "charuco", "circles", "asymmetric_circles"}


@pytest.mark.parametrize("squares", [(5, 4), (6, 5), (5, 6)])
@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_prints_what_opencv_prints(squares, legacy):
    board = Charuco(
        squares_x=squares[0],
        squares_y=squares[1],
        square_mm=9.0,
        marker_mm=6.0,
        dictionary="DICT_4X4_50",
        legacy=legacy,
    )
    theirs = cv2.aruco.CharucoBoard(squares, 9.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    theirs.setLegacyPattern(legacy)
    scale = 8  # squares of 72 px, markers of 48 px, cells of 8 px
    expected = theirs.generateImage((squares[0] * 72, squares[1] * 72))
    assert np.mean(np.abs(rasterised(board, scale).astype(int) - expected) > 128) < 0.002
    corners = theirs.getChessboardCorners() - [squares[0] * 4.5, squares[1] * 4.5, 0]
    np.testing.assert_allclose(board.points, corners, atol=1e-5)


def test_chessboard_squares_meet_at_its_points():
    board = Chessboard(columns=6, rows=5, square_mm=10.0)
    picture = rasterised(board, 8)
    for x, y in (board.points[:, :2] + np.array(board.pattern_mm) / 2) * 8:
        around = picture[int(y) - 3 : int(y) + 3, int(x) - 3 : int(x) + 3]
        np.testing.assert_array_equal(around[:3, :3], around[3:, 3:])
        np.testing.assert_array_equal(around[:3, 3:], around[3:, :3])
        assert {around[0, 0], around[0, 5]} == {0, 255}
    assert picture[0, 0] == 0
    assert len(board.polygons) == 7 * 6 // 2


def test_asymmetric_circles_lie_as_opencv_says():
    board = AsymmetricCircles(columns=4, rows=11, spacing_mm=10.0, diameter_mm=6.0)
    expected = np.array([((2 * j + i % 2) * 10.0, i * 10.0, 0) for i in range(11) for j in range(4)])
    np.testing.assert_allclose(board.points - board.points[0], expected)
    assert board.pattern_mm == (76.0, 106.0)


@pytest.mark.parametrize(
    "board",
    [
        Chessboard(columns=9, rows=6, square_mm=10.0),
        Chessboard(columns=13, rows=9, square_mm=10.0),
        Chessboard(columns=8, rows=6, square_mm=10.0),
        Chessboard(columns=6, rows=6, square_mm=10.0),
        Chessboard(columns=7, rows=7, square_mm=10.0),
        Circles(columns=5, rows=4, spacing_mm=10.0, diameter_mm=5.0),
        Circles(columns=5, rows=5, spacing_mm=10.0, diameter_mm=5.0),
        AsymmetricCircles(columns=4, rows=11, spacing_mm=10.0, diameter_mm=5.0),
        AsymmetricCircles(columns=4, rows=8, spacing_mm=10.0, diameter_mm=5.0),
        Charuco(squares_x=5, squares_y=5, square_mm=10.0, marker_mm=7.0),
    ],
    ids=lambda board: board.wording.split(",")[0] + board.wording.split(",")[1],
)
def test_turns_that_look_the_same_are_those_of_the_print(board):
    picture = rasterised(board, 4)
    same = tuple(
        turn
        for turn in (90, 180, 270)
        if np.rot90(picture, turn // 90).shape == picture.shape
        and np.mean(np.rot90(picture, turn // 90) != picture) < 0.02
    )
    assert board.equal_turns_deg == same
    assert ("symmetric_board" in [finding.code for finding in board.findings]) == bool(same)


def test_narrow_margin_is_told():
    board = Chessboard(columns=9, rows=6, square_mm=10.0, margin_mm=3.0)
    assert [finding.code for finding in board.findings] == ["narrow_margin"]
    assert not board.findings[0].refuses


def test_scene_is_plain_data_and_complete():
    board = Circles(columns=3, rows=2, spacing_mm=20.0, diameter_mm=10.0, margin_mm=5.0)
    scene = board.scene(BoardPose(500.0, 1.0, 2.0, 10.0, 20.0, 30.0))
    assert scene["name"] == "board"
    assert (scene["width_mm"], scene["height_mm"]) == (60.0, 40.0)
    assert scene["discs"][0] == [-20.0, -10.0, 5.0]
    assert scene["polygons"] == []
    assert (scene["distance_mm"], scene["yaw_deg"], scene["roll_deg"]) == (500.0, 10.0, 30.0)


def test_definition_survives_its_document():
    for path in READY:
        board = load_board(path)
        assert board_from(board.model_dump()) == board


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("kind: chess\n", 1, ["chessboard, charuco", "did you mean `chessboard`"]),
        ("kind: chessboard\ncolumns: 13\nrow: 9\nsquare_mm: 10\n", 3, ["did you mean `rows: 9`"]),
        ("kind: chessboard\ncolumns: 13\nrows: 9\nsquare_mm: 10mm\n", 4, ["a number > 0", "write `square_mm: 10`"]),
        ("kind: chessboard\ncolumns: 2\nrows: 9\nsquare_mm: 10\n", 2, ["≥ 3"]),
        ("kind: charuco\nsquares_x: 5\nsquares_y: 5\nsquare_mm: 10\nmarker_mm: 12\n", 5, ["smaller", "7.5"]),
        (
            "kind: charuco\nsquares_x: 5\nsquares_y: 5\nsquare_mm: 10\nmarker_mm: 7\ndictionary: DICT_5x5_50\n",
            6,
            ["did you mean `DICT_5X5_50`"],
        ),
        (
            "kind: charuco\nsquares_x: 12\nsquares_y: 12\nsquare_mm: 10\nmarker_mm: 7\ndictionary: DICT_5X5_50\n",
            6,
            ["50 markers", "the 72 of this board"],
        ),
        ("kind: circles\ncolumns: 5\nrows: 5\nspacing_mm: 10\ndiameter_mm: 9\n", 5, ["at most 8 mm"]),
        ("columns: 5\n", 1, ["add `kind: chessboard`"]),
    ],
)
def test_mistakes_are_told_with_line_and_remedy(tmp_path, text, line, said):
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_board(path)
    assert f"board.yaml, line {line}," in str(caught.value)
    for words in said:
        assert words in str(caught.value)


def test_missing_file_is_told(tmp_path):
    (tmp_path / "chessboard.yaml").write_text("kind: chessboard\n")
    with pytest.raises(ConfigError, match="no such file") as caught:
        load_board(tmp_path / "chesboard.yaml")
    assert "chessboard.yaml" in caught.value.remedy
