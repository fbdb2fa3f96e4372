"""What all boards have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Annotated, Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

from calibration.observations import BoardPose, Finding

Array = NDArray[np.float64]

Length = Annotated[float, Field(gt=0, le=1000)]
"""A length of the print, mm."""


class Board(BaseModel, ABC):
    """A flat board with points whose places are known.

    The board's frame: origin in the middle of the sheet, x right, y down as the print is looked at, z = 0, mm. The
    sheet is the pattern and a white margin around it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    name: str = Field("board", min_length=1, description="What reports and the print call it.")
    margin_mm: float = Field(10.0, ge=0, le=500, description="White paper around the pattern, mm.")

    @property
    @abstractmethod
    def points(self) -> Array:
        """(n, 3) mm, the points by their ids, row by row."""

    @property
    @abstractmethod
    def pattern_mm(self) -> tuple[float, float]:
        """(width, height) of the pattern without its margin, mm."""

    @property
    @abstractmethod
    def pitch_mm(self) -> float:
        """Distance of a point from its nearest neighbour, mm."""

    @property
    @abstractmethod
    def wording(self) -> str:
        """What is printed, in one line with all that a definition needs."""

    @property
    @abstractmethod
    def equal_turns_deg(self) -> tuple[int, ...]:
        """Turns (°) in its plane, other than 0, after which the print looks the same: its points change their ids."""

    @property
    def polygons(self) -> list[Array]:
        """Dark polygons of the print, each (k, 2) mm."""
        return []

    @property
    def discs(self) -> Array:
        """(m, 3) dark discs of the print: x, y, radius, mm."""
        return np.empty((0, 3))

    @property
    def size_mm(self) -> tuple[float, float]:
        """(width, height) of the sheet, mm."""
        width, height = self.pattern_mm
        return width + 2 * self.margin_mm, height + 2 * self.margin_mm

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is allowed but unwise in this definition."""
        found = []
        if self.equal_turns_deg:
            turns = " and ".join(f"{turn}°" for turn in self.equal_turns_deg)
            found.append(
                Finding(
                    "symmetric_board",
                    False,
                    f"the {self.name} looks the same after a turn by {turns}, so that nobody can tell which corner is "
                    "which; each pose is read as if the print stood upright",
                    self._asymmetry,
                )
            )
        if self.margin_mm < self.pitch_mm / 2:
            found.append(
                Finding(
                    "narrow_margin",
                    False,
                    f"the white margin of {self.name} is {self.margin_mm:g} mm; the finder needs about half a pitch, "
                    f"{self.pitch_mm / 2:g} mm, to tell the outermost row from what lies behind the board",
                    "leave more white around the pattern, or hold the board before something bright",
                )
            )
        return tuple(found)

    @property
    def _asymmetry(self) -> str:
        return "keep the print upright in all poses, or take a ChArUco board, which has no such symmetry"

    def scene(self, pose: BoardPose) -> dict[str, Any]:
        """Describe the board at a pose, as the scene ``board`` of a simulated bench takes it.

        Parameters
        ----------
        pose
            Where the board is held.

        Returns
        -------
        A JSON document: ``name``, ``width_mm`` and ``height_mm`` of the sheet, ``polygons`` (lists of [x, y] mm) and
        ``discs`` ([x, y, radius] mm), and the fields of `BoardPose`.
        """
        return {
            "name": "board",
            "width_mm": self.size_mm[0],
            "height_mm": self.size_mm[1],
            "polygons": [polygon.tolist() for polygon in self.polygons],
            "discs": self.discs.tolist(),
            "distance_mm": pose.distance_mm,
            "offset_x_mm": pose.offset_x_mm,
            "offset_y_mm": pose.offset_y_mm,
            "yaw_deg": pose.yaw_deg,
            "pitch_deg": pose.pitch_deg,
            "roll_deg": pose.roll_deg,
        }


def rectangle(x: float, y: float, width: float, height: float) -> Array:
    """(4, 2) corners of a rectangle with its upper left corner at (x, y), clockwise as looked at."""
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def flat(xy: Iterable[tuple[float, float]] | Array) -> Array:
    """(n, 3) points of the plane z = 0, centred on the middle of their bounding box."""
    points = np.asarray(list(xy), np.float64)
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    return np.column_stack((points, np.zeros(len(points))))


def refuse(what: str, remedy: str) -> NoReturn:
    """Refuse a definition; `scanner.config.explain` tells message and remedy apart."""
    raise PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})
