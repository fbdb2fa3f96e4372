"""The plain chessboard."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from calibration.boards.board import Array, Board, Length, flat, rectangle

InnerCorners = Annotated[int, Field(ge=3, le=200)]


class Chessboard(Board):
    """Dark and white squares; the points are the inner corners, where four squares meet. The upper left one is dark."""

    kind: Literal["chessboard"] = "chessboard"
    columns: InnerCorners = Field(description="Inner corners in a row: one fewer than squares.")
    rows: InnerCorners = Field(description="Inner corners in a column: one fewer than squares.")
    square_mm: Length = Field(description="Side of a square as printed, mm.")

    @property
    def points(self) -> Array:
        """(columns · rows, 3) mm, the inner corners row by row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return flat(np.column_stack((x.ravel(), y.ravel())) * self.square_mm)

    @property
    def pattern_mm(self) -> tuple[float, float]:
        """(width, height) of all squares, mm."""
        return (self.columns + 1) * self.square_mm, (self.rows + 1) * self.square_mm

    @property
    def pitch_mm(self) -> float:
        """Side of a square, mm."""
        return self.square_mm

    @property
    def polygons(self) -> list[Array]:
        """The dark squares, each (4, 2) mm."""
        left, top = -self.pattern_mm[0] / 2, -self.pattern_mm[1] / 2
        side = self.square_mm
        return [
            rectangle(left + i * side, top + j * side, side, side)
            for j in range(self.rows + 1)
            for i in range(self.columns + 1)
            if (i + j) % 2 == 0
        ]

    @property
    def equal_turns_deg(self) -> tuple[int, ...]:
        """Half a turn keeps the colours where columns + rows is even, a quarter where both are the same even number."""
        if (self.columns + self.rows) % 2:
            return ()
        return (90, 180, 270) if self.columns == self.rows and self.columns % 2 == 0 else (180,)

    @property
    def wording(self) -> str:
        """Counts and size in words."""
        return f"chessboard, {self.columns} × {self.rows} inner corners, squares of {self.square_mm:g} mm"

    @property
    def _asymmetry(self) -> str:
        return (
            f"keep the print upright in all poses, or take {self.columns} × {self.rows - 1} corners: with one number "
            "even and one odd no turn looks the same"
        )
