"""The chessboard with markers in its white squares, every corner of which says which one it is."""

from __future__ import annotations

import difflib
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from calibration.boards.board import Array, Board, Length, rectangle, refuse

Squares = Annotated[int, Field(ge=3, le=200)]


class Charuco(Board):
    """A ChArUco board of OpenCV; the points are the inner corners of its chessboard."""

    kind: Literal["charuco"] = "charuco"
    squares_x: Squares = Field(description="Squares in a row.")
    squares_y: Squares = Field(description="Squares in a column.")
    square_mm: Length = Field(description="Side of a square as printed, mm.")
    marker_mm: Length = Field(description="Side of a marker with its black border, mm.")
    dictionary: str = Field("DICT_5X5_250", description="Name of the markers' dictionary in OpenCV.")
    legacy: bool = Field(
        False, description="The layout of OpenCV before 4.6: with an even number of rows it begins with a white square."
    )

    @field_validator("marker_mm")
    @classmethod
    def _fits_its_square(cls, marker_mm: float, info: ValidationInfo) -> float:
        square_mm = info.data.get("square_mm", np.inf)
        if not marker_mm < square_mm:
            refuse(
                f"found markers of {marker_mm:g} mm in squares of {square_mm:g} mm, expected smaller ones",
                f"give marker_mm about three quarters of square_mm: {0.75 * square_mm:g}",
            )
        return marker_mm

    @field_validator("dictionary")
    @classmethod
    def _has_enough_markers(cls, dictionary: str, info: ValidationInfo) -> str:
        import cv2

        names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_") and name == name.upper())
        if dictionary not in names:
            near = difflib.get_close_matches(dictionary.upper(), names, n=1)
            refuse(
                f"found {dictionary}, expected one of: {', '.join(names)}",
                f"did you mean `{near[0]}`?" if near else "give the full name of one of these",
            )
        needed = info.data.get("squares_x", 0) * info.data.get("squares_y", 0) // 2
        there = len(_opencv_dictionary(dictionary).bytesList)
        if needed > there:
            refuse(
                f"found {dictionary}, which has {there} markers, expected the {needed} of this board",
                "take the larger dictionary of that name, or fewer squares",
            )
        return dictionary

    @cached_property
    def opencv(self) -> Any:
        """The same as `cv2.aruco.CharucoBoard`, in mm."""
        import cv2

        size = (self.squares_x, self.squares_y)
        board = cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, _opencv_dictionary(self.dictionary))
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def points(self) -> Array:
        """((squares_x − 1)(squares_y − 1), 3) mm, the inner corners row by row, with the ids of OpenCV."""
        corners = np.asarray(self.opencv.getChessboardCorners(), np.float64)
        return corners - np.array([*self.pattern_mm, 0.0]) / 2

    @property
    def pattern_mm(self) -> tuple[float, float]:
        """(width, height) of all squares, mm."""
        return self.squares_x * self.square_mm, self.squares_y * self.square_mm

    @property
    def pitch_mm(self) -> float:
        """Side of a square, mm."""
        return self.square_mm

    @property
    def polygons(self) -> list[Array]:
        """The dark squares and the dark runs of the markers' rows, each (4, 2) mm."""
        left, top = -self.pattern_mm[0] / 2, -self.pattern_mm[1] / 2
        side = self.square_mm
        first_is_white = int(self.legacy and self.squares_y % 2 == 0)
        squares = [
            rectangle(left + i * side, top + j * side, side, side)
            for j in range(self.squares_y)
            for i in range(self.squares_x)
            if (i + j) % 2 == first_is_white
        ]
        return squares + [run for marker in self._markers() for run in marker]

    def _markers(self) -> list[list[Array]]:
        dictionary = _opencv_dictionary(self.dictionary)
        cells = dictionary.markerSize + 2
        cell = self.marker_mm / cells
        left, top = -self.pattern_mm[0] / 2, -self.pattern_mm[1] / 2
        markers = []
        for number, corners in zip(self.opencv.getIds().ravel(), self.opencv.getObjPoints(), strict=True):
            dark = dictionary.generateImageMarker(int(number), cells) < 128
            x, y = np.asarray(corners)[:, :2].min(axis=0)
            markers.append(
                [
                    rectangle(left + x + begin * cell, top + y + row * cell, (end - begin) * cell, rows * cell)
                    for row, rows, begin, end in _runs(dark)
                ]
            )
        return markers

    @property
    def equal_turns_deg(self) -> tuple[int, ...]:
        """No turn: markers differ."""
        return ()

    @property
    def wording(self) -> str:
        """Counts, sizes and dictionary in words."""
        return (
            f"ChArUco, {self.squares_x} × {self.squares_y} squares of {self.square_mm:g} mm, markers of "
            f"{self.marker_mm:g} mm from {self.dictionary}{', legacy layout' if self.legacy else ''}"
        )


def _opencv_dictionary(name: str) -> Any:
    import cv2

    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _runs(dark: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> list[tuple[int, int, int, int]]:
    """Cover the true cells by rectangles (row, rows, begin, end): runs along rows, joined where they repeat below."""
    done: list[tuple[int, int, int, int]] = []
    open_runs: dict[tuple[int, int], int] = {}
    for row in range(len(dark) + 1):
        line = dark[row] if row < len(dark) else np.zeros(dark.shape[1], bool)
        steps = np.flatnonzero(np.diff(np.concatenate(([0], line.astype(np.int8), [0]))))
        runs = {(int(begin), int(end)) for begin, end in steps.reshape(-1, 2)}
        for run in [run for run in open_runs if run not in runs]:
            first = open_runs.pop(run)
            done.append((first, row - first, *run))
        for run in runs - set(open_runs):
            open_runs[run] = row
    return sorted(done)
