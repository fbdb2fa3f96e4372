"""Boards beside a mirror that are harder to measure than the plain white one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim_backend.scenes.mirrors import BoardBesideMirror
from sim_backend.scenes.pose import Length, Share
from sim_backend.surfaces import Material, Surface


class EpipolarMirrorScene(BoardBesideMirror):
    """A white board and a mirror at right angles to the baseline.

    The mirror image of a point then lies on the point's own epipolar line: neither the line nor the second axis tells
    direct from bounced light. It needs a projector at the camera's height, and neither yaw, pitch nor roll.
    """

    PARTS: ClassVar = ("board", "mirror")
    MEASURED: ClassVar = ("board",)

    name: Literal["mirror_epipolar"] = "mirror_epipolar"
    mirror_angle_deg: float = Field(
        90.0, gt=30, lt=175, description="Angle between the scene's x axis and the mirror, °."
    )
    mirror_tilt_deg: float = Field(
        0.0, gt=-60, lt=60, description="Turn of the mirror about its own horizontal middle line, °."
    )

    mirror_reflectance: Share = Field(0.5, description="Share of the light that the mirror reflects.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        return {"board": [self._board()], "mirror": [self._mirror()]}


class TexturedMirrorScene(BoardBesideMirror):
    """A board with dark checks printed on it, beside a mirror: most of the dark parts' light is bounced."""

    PARTS: ClassVar = ("board", "mirror")
    MEASURED: ClassVar = ("board",)

    name: Literal["mirror_textured"] = "mirror_textured"
    check_mm: Length = Field(14.0, ge=2, description="Side of a check, mm.")
    dark_reflectance: Share = Field(0.08, description="Share of the light that the dark checks scatter evenly.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        # Imported here, because finding one's way on a print needs Numba, and the settings alone do not.
        from sim_backend.prints import Print
        from sim_backend.sheets import Sheet

        width, height, side = self.board_width_mm, self.board_height_mm, self.check_mm
        checks = []
        for row in range(int(height / side)):
            for column in range(row % 2, int(width / side), 2):
                x, y = column * side - width / 2, row * side - height / 2
                checks.append(((x, y), (x + side, y), (x + side, y + side), (x, y + side)))
        board = Sheet(
            self.placed((0, 0, 0)),
            self.rotation,
            width,
            height,
            0.0,
            Print.of(checks, []),
            self.board_reflectance,
            self.dark_reflectance,
        )
        return {"board": [board], "mirror": [self._mirror()]}


class EdgeMirrorScene(BoardBesideMirror):
    """A white board beside a mirror, and before it a plate whose edge runs through the bounce."""

    PARTS: ClassVar = ("board", "plate", "mirror")
    MEASURED: ClassVar = ("board", "plate")

    name: Literal["mirror_edge"] = "mirror_edge"
    plate_x_mm: float = Field(78.0, ge=-10_000, le=10_000, description="The plate's middle right of the board's, mm.")
    plate_forward_mm: Length = Field(25.0, description="How far the plate stands before the board, mm.")
    plate_width_mm: Length = Field(30.0, description="Width of the plate, mm.")
    plate_height_mm: Length = Field(70.0, description="Height of the plate, mm.")
    plate_reflectance: Share = Field(0.7, description="Share of the light that the plate scatters evenly.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        w, h = self.plate_width_mm / 2, self.plate_height_mm / 2
        place = self.plate_x_mm, 0.0, -self.plate_forward_mm
        plate = self.rectangle(place, (w, 0, 0), (0, h, 0), Material(self.plate_reflectance))
        return {"board": [self._board()], "plate": [plate], "mirror": [self._mirror()]}


class TranslucentMirrorScene(BoardBesideMirror):
    """A board of wax or nylon beside a mirror: part of its light wanders within before it leaves, and blurs fringes."""

    PARTS: ClassVar = ("board", "mirror")
    MEASURED: ClassVar = ("board",)

    name: Literal["mirror_translucent"] = "mirror_translucent"
    subsurface: Share = Field(0.5, description="Part of the board's scattered light that wanders within it first.")
    spread_mm: float = Field(
        2.0, gt=0, le=50, description="Standard deviation of how far that light wanders along the board, mm."
    )

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        wax = Material(self.board_reflectance, subsurface=self.subsurface, spread_mm=self.spread_mm)
        return {"board": [self._board(wax)], "mirror": [self._mirror()]}


class PolishedScene(BoardBesideMirror):
    """A white board and, in the mirror's place, a polished part that is to be measured too.

    The part scatters little and mirrors much: the camera sees the board's fringes in it brighter than its own (α > 1).
    """

    PARTS: ClassVar = ("board", "part")

    name: Literal["polished"] = "polished"
    part_reflectance: Share = Field(0.3, description="Share of the light that the part scatters evenly.")
    mirror_reflectance: Share = Field(0.3, description="Share of the light that the part reflects.")
    mirror_roughness: Share = Field(
        0.03, description="0 a perfect polish; else its lobe's standard deviation is √2·roughness² rad."
    )

    @model_validator(mode="after")
    def _conserves_energy(self) -> Self:
        if self.part_reflectance + self.mirror_reflectance > 1:
            raise ValueError("part_reflectance + mirror_reflectance must not exceed 1")
        return self

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        polish = Material(self.part_reflectance, self.mirror_reflectance, self.mirror_roughness)
        return {"board": [self._board()], "part": [self._mirror(polish)]}


class MirrorChainScene(BoardBesideMirror):
    """A white board and two mirrors: light reaches it over one after the other.

    The first mirror, at the board's right edge, throws the projector's light along the board; the second, at its left
    edge and with its back to the camera, throws it on the board.
    """

    PARTS: ClassVar = ("board", "mirror", "second")
    MEASURED: ClassVar = ("board",)

    name: Literal["mirror_chain"] = "mirror_chain"
    offset_x_mm: float = Field(-10.0, description="The board's middle to the right of the camera's axis, mm.")
    board_width_mm: Length = Field(200.0, description="Width of the board, mm.")
    mirror_angle_deg: float = Field(
        122.0, gt=30, lt=175, description="Angle between the scene's x axis and the mirror, °."
    )
    mirror_tilt_deg: float = Field(
        2.0, gt=-60, lt=60, description="Turn of the mirror about its own horizontal middle line, °."
    )
    mirror_reflectance: Share = Field(0.85, description="Share of the light that each mirror reflects.")
    second_angle_deg: float = Field(
        70.0, gt=20, lt=160, description="Angle between the board and the second mirror; less leans over the board, °."
    )
    second_width_mm: Length = Field(95.0, description="Length of the second mirror from its foot, mm.")
    second_gap_mm: float = Field(15.0, ge=0, le=1000, description="Gap between the board's left edge and it, mm.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        angle, w, h = math.radians(self.second_angle_deg), self.second_width_mm / 2, self.mirror_height_mm / 2
        away = math.cos(angle), -math.sin(angle)  # (x, z) from the foot
        foot = -self.board_width_mm / 2 + self.second_gap_mm * away[0], self.second_gap_mm * away[1]
        second = self.rectangle(
            (foot[0] + w * away[0], 0, foot[1] + w * away[1]),
            (w * away[0], 0, w * away[1]),
            (0, h, 0),
            Material(0.0, self.mirror_reflectance, self.mirror_roughness),
        )
        return {"board": [self._board()], "mirror": [self._mirror()], "second": [second]}
