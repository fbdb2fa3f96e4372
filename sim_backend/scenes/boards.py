"""A printed calibration board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from sim_backend.scenes.pose import Length, Pose, Share
from sim_backend.surfaces import Surface

_MOST_BEND = 0.1
_Point = tuple[float, float]
_Ring = Annotated[tuple[_Point, ...], Field(min_length=3)]
_Disc = tuple[float, float, Length]


class BoardScene(Pose):
    """A matt sheet with dark figures printed on it; the pose's origin is its middle.

    The figures' coordinates are along the sheet, x to the right and y down as one looks at the print, from the middle.
    """

    seen_once: ClassVar[bool] = True
    PARTS: ClassVar = ("board",)

    name: Literal["board"] = "board"
    width_mm: Length = Field(280.0, description="Width of the sheet, mm.")
    height_mm: Length = Field(200.0, description="Height of the sheet, mm.")
    polygons: tuple[_Ring, ...] = Field(
        (), description="Dark polygons, each a ring of (x, y) in mm; they may touch, but not overlap."
    )
    discs: tuple[_Disc, ...] = Field((), description="Dark discs, each (x, y, radius) in mm.")
    light_reflectance: Share = Field(0.8, description="Share of the light that the blank sheet scatters evenly.")
    dark_reflectance: Share = Field(0.05, description="Share of the light that the print scatters evenly.")
    bend_mm: float = Field(
        0.0,
        description="Sagitta of a parabolic bend along the width, mm: how far the sides lie behind the middle; negative"
        " before it.",
    )

    @model_validator(mode="after")
    def _has_discs_apart(self) -> Self:
        x, y, radius = np.array(self.discs, np.float64).reshape(-1, 3).T
        apart = np.hypot(x[:, None] - x, y[:, None] - y) - radius[:, None] - radius
        if (apart[~np.eye(x.size, dtype=bool)] < 0).any():
            raise ValueError("discs must not overlap; the third number of a disc is its radius")
        return self

    @model_validator(mode="after")
    def _bends_a_little(self) -> Self:
        if abs(self.bend_mm) > _MOST_BEND * self.width_mm:
            raise ValueError(f"bend_mm must stay within {_MOST_BEND:g} of width_mm: a board is nearly flat")
        return self

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        # Imported here, because finding one's way on a print needs Numba, and the settings alone do not.
        from sim_backend.prints import Print
        from sim_backend.sheets import Sheet

        sheet = Sheet(
            self.placed((0, 0, 0)),
            self.rotation,
            self.width_mm,
            self.height_mm,
            self.bend_mm,
            Print.of(self.polygons, self.discs),
            self.light_reflectance,
            self.dark_reflectance,
        )
        return {"board": [sheet]}
