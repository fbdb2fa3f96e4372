"""Prints to true scale: what is in the files, measured in mm, and read back by the detector."""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from requirements import require

from calibration.boards import AsymmetricCircles, Charuco, Chessboard, load_board
from calibration.detection import find_board
from calibration.printing import PrintError, print_board

POINT_MM = 25.4 / 72
BOARDS = Path(__file__).resolve().parents[2] / "configs" / "boards"
SVG = "{http://www.w3.org/2000/svg}"


def paths_of(file):
    """Page (width, height) mm, and all paths of an SVG as lists of (k, 2) mm."""
    root = ElementTree.parse(file).getroot()
    page = [float(root.get(side).removesuffix("pt")) * POINT_MM for side in ("width", "height")]
    assert [float(v) * POINT_MM for v in root.get("viewBox").split()[2:]] == pytest.approx(page)
    found = []
    for path in root.iter(f"{SVG}path"):
        parts = [part for part in path.get("d", "").split("M") if part.strip()]
        numbers = [np.array(re.findall(r"-?[\d.]+(?:e-?\d+)?", part), float) for part in parts]
        found.append([n.reshape(-1, 2) * POINT_MM for n in numbers if len(n) % 2 == 0])
    return page, found


def test_svg_squares_have_their_size(tmp_path):
    board = Chessboard(columns=6, rows=5, square_mm=12.5)
    print_board(board, tmp_path / "board.svg")
    page, paths = paths_of(tmp_path / "board.svg")
    assert page == pytest.approx([210, 297], abs=1e-3)
    squares = next(parts for parts in paths if len(parts) == 21)
    sides = np.array([np.ptp(square, axis=0) for square in squares])
    np.testing.assert_allclose(sides, 12.5, atol=1e-4)
    middle = np.concatenate(squares).mean(axis=0)
    corners = np.concatenate([square[:4] for square in squares])
    expected = np.concatenate(board.polygons)
    np.testing.assert_allclose(corners - (corners.min(axis=0) + corners.max(axis=0)) / 2, expected, atol=1e-4)
    assert abs(middle[0] - 105) < 12.5


def test_svg_ruler_is_100_mm_and_clear_of_the_sheet(tmp_path):
    board = Chessboard(columns=13, rows=9, square_mm=10.0)
    print_board(board, tmp_path / "board.svg")
    _, paths = paths_of(tmp_path / "board.svg")
    lines = [parts[0] for parts in paths if len(parts) == 1 and len(parts[0]) == 2]
    ticks = np.array([line[0, 0] for line in lines if 1 < np.ptp(line[:, 1]) < 3.1 and np.ptp(line[:, 0]) == 0])
    ticks = np.unique(np.round(ticks[(ticks > 50) & (ticks < 160)], 4))
    assert len(ticks) == 101
    np.testing.assert_allclose(np.diff(ticks), 1, atol=2e-4)
    assert ticks[-1] - ticks[0] == pytest.approx(100, abs=1e-3)
    squares = np.concatenate(next(parts for parts in paths if len(parts) == 70))
    ruler_top = min(line[:, 1].min() for line in lines if np.ptp(line[:, 0]) == 0 and 50 < line[0, 0] < 160)
    assert ruler_top > squares[:, 1].max() + board.margin_mm


def test_svg_is_read_by_the_detector(tmp_path):
    """Polygons of the file, drawn at 10 px per mm, hold the board's points where they belong."""
    board = load_board(BOARDS / "chessboard_13x9_10mm.yaml")
    print_board(board, tmp_path / "board.svg")
    page, paths = paths_of(tmp_path / "board.svg")
    squares = next(parts for parts in paths if len(parts) == len(board.polygons))
    scale = 8
    picture = np.full((round(page[1] * scale), round(page[0] * scale)), 220, np.uint8)
    for square in squares:
        cv2.fillConvexPoly(picture, np.rint((square * scale - 0.5) * 256).astype(np.int32), 20, cv2.LINE_AA, shift=8)
    view = find_board(cv2.GaussianBlur(picture, (0, 0), 1.5), board, 1.0)
    spans = view.xy - view.xy[0]
    expected = (board.points[:, :2] - board.points[0, :2]) * scale
    assert np.abs(spans - expected).max() < 0.1  # cv2 draws whole pixels along edges


@pytest.mark.parametrize(("paper", "size"), [("A4", (210, 297)), ("A3", (297, 420)), ("sheet", (170, 147))])
def test_pdf_page_is_the_paper(tmp_path, paper, size):
    board = Chessboard(columns=13, rows=9, square_mm=10.0)
    print_board(board, tmp_path / "board.pdf", paper)
    content = (tmp_path / "board.pdf").read_bytes()
    boxes = re.findall(rb"/MediaBox \[ ([\d. ]+) \]", content)
    assert len(boxes) == 1  # one page
    box = np.array(boxes[0].split(), float) * POINT_MM
    np.testing.assert_allclose(box, [0, 0, *size], atol=1e-3)


def test_pdf_squares_have_their_size(tmp_path):
    board = Chessboard(columns=6, rows=5, square_mm=12.5)
    print_board(board, tmp_path / "board.pdf")
    content = (tmp_path / "board.pdf").read_bytes()
    streams = [zlib.decompressobj().decompress(s) for s in re.findall(rb"stream\r?\n(x.*?)endstream", content, re.S)]
    drawing = next(s for s in streams if s.count(b" l\n") > 60).decode("latin-1")
    squares = [
        np.array([pair.split()[:2] for pair in square.strip().split("\n")], float) * POINT_MM
        for square in re.findall(r"((?:[\d.]+ [\d.]+ [ml]\n?){4,5})\s*h", drawing)
    ]
    sides = np.array([np.ptp(square, axis=0) for square in squares])
    assert (np.abs(sides - 12.5) < 1e-4).all(axis=1).sum() == 21


def test_landscape_where_the_board_is_wide(tmp_path):
    board = Chessboard(columns=21, rows=9, square_mm=11.0)
    print_board(board, tmp_path / "board.svg")
    page, _ = paths_of(tmp_path / "board.svg")
    assert page == pytest.approx([297, 210], abs=1e-3)


def test_prints_are_the_same_each_time(tmp_path):
    board = Chessboard(columns=6, rows=5, square_mm=12.5)
    for kind in ("pdf", "svg"):
        for name in ("a", "b"):
            print_board(board, tmp_path / f"{name}.{kind}")
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()


def test_too_small_paper_is_refused_with_one_that_fits(tmp_path):
    board = load_board(BOARDS / "charuco_12x9_20mm.yaml")
    with pytest.raises(PrintError, match="260 × 200 mm") as caught:
        print_board(board, tmp_path / "board.pdf")
    assert "Print on A3" in caught.value.remedy
    assert not (tmp_path / "board.pdf").exists()
    print_board(board, tmp_path / "board.pdf", "A3")


@pytest.mark.parametrize(("name", "paper", "said"), [("b.png", "A4", ".pdf or .svg"), ("b.pdf", "letter", "A4, A3")])
def test_unknown_file_or_paper_is_refused(tmp_path, name, paper, said):
    with pytest.raises(PrintError) as caught:
        print_board(Chessboard(columns=6, rows=5, square_mm=10.0), tmp_path / name, paper)
    assert said in caught.value.remedy


def test_place_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(PrintError, match="cannot write"):
        print_board(Chessboard(columns=6, rows=5, square_mm=10.0), tmp_path / "no" / "board.pdf")


@pytest.mark.parametrize(
    "board",
    [
        Chessboard(columns=13, rows=9, square_mm=10.0),
        Charuco(squares_x=8, squares_y=6, square_mm=20.0, marker_mm=14.0),
        AsymmetricCircles(columns=6, rows=13, spacing_mm=9.0, diameter_mm=7.0),
    ],
    ids=lambda board: board.kind,
)
def test_rendered_pdf_is_read_by_the_detector(tmp_path, board):
    require(shutil.which("pdftoppm"), "pdftoppm (poppler-utils) is not on this machine")
    print_board(board, tmp_path / "board.pdf")
    dpi = 200
    command = ["pdftoppm", "-r", str(dpi), "-gray", "-singlefile", str(tmp_path / "board.pdf"), str(tmp_path / "board")]
    subprocess.run(command, check=True)
    picture = cv2.GaussianBlur(cv2.imread(str(tmp_path / "board.pgm"), cv2.IMREAD_GRAYSCALE), (0, 0), 1.0)
    view = find_board(picture, board, 1.0)
    assert len(view.ids) == len(board.points)
    spans = (view.xy - view.xy[0]) * 25.4 / dpi
    expected = (board.points[view.ids] - board.points[view.ids[0]])[:, :2]
    assert np.abs(spans - expected).max() < 0.05  # mm; renderers round the page to whole pixels of 0.127 mm
