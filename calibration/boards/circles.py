"""Grids of dark discs; the points are their centres."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from calibration.boards.board import Array, Board, Length, flat, refuse

Discs = Annotated[int, Field(ge=2, le=200)]

_LARGEST_SHARE = 0.8  # of the distance to the next centre: below, blur leaves white between two discs


class _Grid(Board):
    _neighbour: ClassVar[float] = 1.0  # distance of nearest neighbours in units of spacing_mm

    columns: Discs = Field(description="Discs in a row.")
    rows: Discs = Field(description="Rows of discs.")
    spacing_mm: Length = Field(description="Distance from row to row, mm.")
    diameter_mm: Length = Field(description="Diameter of a disc as printed, mm.")

    @field_validator("diameter_mm")
    @classmethod
    def _keeps_apart(cls, diameter_mm: float, info: ValidationInfo) -> float:
        distance = cls._neighbour * info.data.get("spacing_mm", math.inf)
        if diameter_mm > _LARGEST_SHARE * distance:
            refuse(
                f"found discs of {diameter_mm:g} mm whose centres lie {distance:.3g} mm apart, expected at most "
                f"{_LARGEST_SHARE * distance:.3g} mm",
                f"give diameter_mm about half the distance: {distance / 2:.2g}",
            )
        return diameter_mm

    @property
    def pitch_mm(self) -> float:
        """Distance of nearest neighbours, mm."""
        return self._neighbour * self.spacing_mm

    @property
    def discs(self) -> Array:
        """(columns · rows, 3) x, y, radius, mm."""
        points = self.points
        points[:, 2] = self.diameter_mm / 2
        return points

    @property
    def pattern_mm(self) -> tuple[float, float]:
        """(width, height) of all discs, mm."""
        width, height = np.ptp(self.points[:, :2], axis=0) + self.diameter_mm
        return float(width), float(height)


class Circles(_Grid):
    """Discs in rows and columns."""

    kind: Literal["circles"] = "circles"

    @property
    def points(self) -> Array:
        """(columns · rows, 3) mm, the centres row by row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return flat(np.column_stack((x.ravel(), y.ravel())) * self.spacing_mm)

    @property
    def equal_turns_deg(self) -> tuple[int, ...]:
        """Half a turn always, a quarter of a square grid."""
        return (90, 180, 270) if self.columns == self.rows else (180,)

    @property
    def wording(self) -> str:
        """Counts and sizes in words."""
        return (
            f"circles, {self.columns} × {self.rows}, spacing {self.spacing_mm:g} mm, diameter {self.diameter_mm:g} mm"
        )


class AsymmetricCircles(_Grid):
    """Discs whose every second row is shifted by half the distance within a row, as OpenCV counts them.

    Rows lie ``spacing_mm`` apart, the discs of a row twice as much.
    """

    _neighbour: ClassVar[float] = math.sqrt(2)

    kind: Literal["asymmetric_circles"] = "asymmetric_circles"

    @property
    def points(self) -> Array:
        """(columns · rows, 3) mm, the centres row by row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return flat(np.column_stack(((2 * x + y % 2).ravel(), y.ravel())) * self.spacing_mm)

    @property
    def equal_turns_deg(self) -> tuple[int, ...]:
        """Half a turn where the number of rows is even."""
        return () if self.rows % 2 else (180,)

    @property
    def wording(self) -> str:
        """Counts and sizes in words."""
        return (
            f"asymmetric circles, {self.columns} in each of {self.rows} rows, rows {self.spacing_mm:g} mm apart, "
            f"diameter {self.diameter_mm:g} mm"
        )

    @property
    def _asymmetry(self) -> str:
        return f"keep the print upright in all poses, or take an odd number of rows, such as {self.rows - 1}"
