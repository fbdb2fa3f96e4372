"""A board on paper: SVG and PDF to true scale, with a ruler that proves it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from drivers.errors import OperatorError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Paper = Literal["A4", "A3", "A2", "A1", "A0", "sheet"]
PAPERS: tuple[Paper, ...] = get_args(Paper)
"""What a board can be printed on; ``sheet`` is as large as board and ruler need."""

_SIZES_MM: dict[str, tuple[float, float]] = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
_EDGE_MM = 5.0  # most printers leave this much of the paper white
_STRIP_MM = 17.0  # below the sheet: ruler and text
_RULERS_MM = (100, 50, 20)
_POINTS_PER_MM = 72 / 25.4


class PrintError(OperatorError):
    """A board cannot be printed as asked."""


def print_board(board: Board, path: str | Path, paper: Paper = "A4") -> None:
    """Write a board as a file for the printer, to true scale.

    One page holds the sheet with its margin, crop marks at its corners, and below it a ruler, the definition of the
    board in words and what the operator is to check.

    Parameters
    ----------
    board
        What to print.
    path
        File to write; ``.pdf`` or ``.svg`` says which kind.
    paper
        Paper size, upright or across as the board fits, or ``sheet`` for a page as large as board and ruler need.

    Raises
    ------
    PrintError
        Unknown suffix or paper, a board larger than the paper, or a place that cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("pdf", "svg"):
        raise PrintError(f"cannot print to {path}: the suffix says no kind of file", "Name it .pdf or .svg.")
    width, height = _page(board, paper)

    import matplotlib as mpl
    from matplotlib.figure import Figure

    # Text as outlines in SVG, as embedded TrueType in PDF: either looks the same on every machine.
    with mpl.rc_context({"pdf.fonttype": 42, "svg.fonttype": "path", "svg.hashsalt": board.name, "path.snap": False}):
        figure = Figure(figsize=(width / 25.4, height / 25.4))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, width), ylim=(height, 0))
        axes.axis("off")
        _draw(axes, board, width, height)
        title = {"Title": f"{board.name}: {board.wording}"}
        dated = {"CreationDate": None} if kind == "pdf" else {"Date": None}
        try:
            figure.savefig(path, format=kind, metadata=title | dated)
        except OSError as error:
            raise PrintError(f"cannot write {path}: {error.strerror}", "Choose a place that can be written.") from None


def _page(board: Board, paper: Paper) -> tuple[float, float]:
    """(width, height) of the page, mm."""
    width, height = board.size_mm
    needed = max(width, _RULERS_MM[-1] + 10) + 2 * _EDGE_MM, height + _STRIP_MM + 2 * _EDGE_MM
    if paper == "sheet":
        return needed
    if paper not in _SIZES_MM:
        raise PrintError(f"no paper is called {paper}", f"Name one of: {', '.join(PAPERS)}.")
    short, long = _SIZES_MM[paper]
    for page in ((short, long), (long, short)):
        if needed[0] <= page[0] and needed[1] <= page[1]:
            return page
    larger = [name for name in PAPERS if name != "sheet" and _fits(needed, _SIZES_MM[name])]
    remedy = f"Print on {larger[0]}, or on a plotter with paper: sheet" if larger else "Print with paper: sheet"
    raise PrintError(
        f"{board.name} is {width:g} × {height:g} mm with its margin and needs {needed[0]:g} × {needed[1]:g} mm with "
        f"ruler and printer edge; {paper} is {short:g} × {long:g} mm",
        f"{remedy}; or make the board smaller. Never let the printer scale it.",
    )


def _fits(needed: tuple[float, float], page: tuple[float, float]) -> bool:
    return max(needed) <= max(page) and min(needed) <= min(page)


def _draw(axes: Axes, board: Board, width: float, height: float) -> None:
    from matplotlib.patches import PathPatch

    sheet_width, sheet_height = board.size_mm
    left, top = (width - sheet_width) / 2, (height - _STRIP_MM - sheet_height) / 2
    middle = np.array([left + sheet_width / 2, top + sheet_height / 2])
    # One path for all, so that no viewer draws hairlines where two parts of a marker touch.
    axes.add_patch(
        PathPatch(_outline(board, middle), facecolor="black", edgecolor="none", antialiased=True, snap=False)
    )
    for x, outward_x in ((left, -1), (left + sheet_width, 1)):
        for y, outward_y in ((top, -1), (top + sheet_height, 1)):
            _line(axes, (x + outward_x, x + 4 * outward_x), (y, y))
            _line(axes, (x, x), (y + outward_y, y + 4 * outward_y))
    bottom = top + sheet_height
    available = max(sheet_width, width - 2 * _EDGE_MM - 12)
    ruler = next((length for length in _RULERS_MM if length + 10 <= available), _RULERS_MM[-1])
    _ruler(axes, (width - ruler) / 2, bottom + 6.5, ruler)
    words = f"{board.name}: {board.wording}, margin {board.margin_mm:g} mm"
    check = f"measure this: it must be {ruler:.1f} mm · print at 100 %, without fitting to the page"
    _fitted_text(axes, width / 2, bottom + 12.5, check, width - 2 * _EDGE_MM)
    _fitted_text(axes, width / 2, bottom + 16.0, words, width - 2 * _EDGE_MM)


def _outline(board: Board, middle: NDArray[np.float64]) -> Any:
    from matplotlib.path import Path as Outline

    parts = [Outline(np.vstack((polygon, polygon[:1])) + middle, closed=True) for polygon in board.polygons]
    circle = Outline.unit_circle()  # eight Bézier arcs, within 1e-5 of the radius
    parts += [Outline(circle.vertices * radius + (x, y) + middle, circle.codes) for x, y, radius in board.discs]
    outline = Outline.make_compound_path(*parts)
    outline.should_simplify = False
    return outline


def _line(axes: Axes, x: tuple[float, float], y: tuple[float, float], width_mm: float = 0.15) -> None:
    axes.plot(x, y, color="black", linewidth=width_mm * _POINTS_PER_MM, solid_capstyle="butt", snap=False)


def _ruler(axes: Axes, left: float, top: float, length: int) -> None:
    _line(axes, (left - 0.075, left + length + 0.075), (top, top))
    for mm in range(length + 1):
        tick = 3.0 if mm % 10 == 0 else 2.2 if mm % 5 == 0 else 1.4
        _line(axes, (left + mm, left + mm), (top, top - tick))
        if mm % 10 == 0:
            _text(axes, left + mm, top + 1.9, f"{mm}", 1.9)
    _text(axes, left + length + 5, top + 1.9, "mm", 1.9)


def _text(axes: Axes, x: float, baseline: float, text: str, size_mm: float) -> Any:
    return axes.text(x, baseline, text, fontsize=size_mm * _POINTS_PER_MM, ha="center", va="baseline", color="black")


def _fitted_text(axes: Axes, x: float, baseline: float, text: str, width_mm: float) -> None:
    """Write a line that shrinks to the paper's width."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    long = TextPath((0, 0), text, size=10.0, prop=FontProperties()).get_extents().width / 10
    _text(axes, x, baseline, text, min(2.6, width_mm / long))
