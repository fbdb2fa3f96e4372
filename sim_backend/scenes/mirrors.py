"""Matt objects beside a mirror, and the same without it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim_backend.scenes.pose import Length, Pose, Share
from sim_backend.surfaces import Material, Sphere, Surface


class BesideMirror(Pose):
    """A mirror to the right of an object."""

    offset_x_mm: float = Field(-30.0, description="The object's centre to the right of the camera's axis, mm.")
    mirror_angle_deg: float = Field(
        100.0,
        gt=30,
        lt=175,
        description="Angle between the scene's x axis, in which a board lies, and the mirror; 90 stands upright on it,"
        " more opens away from it, °.",
    )
    mirror_tilt_deg: float = Field(
        5.0,
        gt=-60,
        lt=60,
        description="Turn of the mirror about its own horizontal middle line; sends the bounce up, °.",
    )
    mirror_width_mm: Length = Field(75.0, description="Length of the mirror from its foot towards the camera, mm.")
    mirror_height_mm: Length = Field(150.0, description="Height of the mirror, mm.")
    mirror_gap_mm: float = Field(
        15.0, ge=0, le=1000, description="Gap between the object's right edge and the mirror, mm."
    )
    mirror_reflectance: Share = Field(0.6, description="Share of the light that the mirror reflects.")
    mirror_roughness: Share = Field(
        0.0, description="0 a perfect mirror; else its lobe's standard deviation is √2·roughness² rad."
    )

    def _mirror_from(self, x: float, z: float, material: Material | None = None) -> Surface:
        """The mirror that meets the scene's y = 0 first at (x, z), or something else of another material."""
        angle, tilt = math.radians(self.mirror_angle_deg), math.radians(self.mirror_tilt_deg)
        along = (-math.cos(angle), -math.sin(angle))  # (x, z) away from the foot
        w, h = self.mirror_width_mm / 2, self.mirror_height_mm / 2
        face = (-math.sin(angle), math.cos(angle))  # (x, z) of the normal, towards the object
        return self.rectangle(
            (x + w * along[0], 0, z + w * along[1]),
            (w * along[0], 0, w * along[1]),
            (h * math.sin(tilt) * face[0], h * math.cos(tilt), h * math.sin(tilt) * face[1]),
            Material(0.0, self.mirror_reflectance, self.mirror_roughness) if material is None else material,
        )


class BoardBesideMirror(BesideMirror):
    """A matt board; the pose's origin is its centre."""

    board_width_mm: Length = Field(260.0, description="Width of the board, mm.")
    board_height_mm: Length = Field(250.0, description="Height of the board, mm.")
    board_reflectance: Share = Field(0.8, description="Share of the light that the board scatters evenly.")

    def _board(self, material: Material | None = None) -> Surface:
        w, h = self.board_width_mm / 2, self.board_height_mm / 2
        return self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), material or Material(self.board_reflectance))

    def _mirror(self, material: Material | None = None) -> Surface:
        angle = math.radians(self.mirror_angle_deg)
        gap = self.mirror_gap_mm
        return self._mirror_from(self.board_width_mm / 2 - gap * math.cos(angle), -gap * math.sin(angle), material)


class MirrorScene(BoardBesideMirror):
    """A white matt board with a plane mirror at its right edge, which throws a bounce on the board."""

    PARTS: ClassVar = ("board", "mirror")
    MEASURED: ClassVar = ("board",)

    name: Literal["mirror"] = "mirror"

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        return {"board": [self._board()], "mirror": [self._mirror()]}


class MirrorRemovedScene(BoardBesideMirror):
    """The scene ``mirror`` without its mirror; it takes the same parameters, so that the two compare."""

    PARTS: ClassVar = ("board",)

    name: Literal["mirror_removed"] = "mirror_removed"

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        return {"board": [self._board()]}


class SphereMirrorScene(BesideMirror):
    """A light grey matt ball with a plane mirror to its right, which throws a bounce on it."""

    PARTS: ClassVar = ("ball", "mirror")
    MEASURED: ClassVar = ("ball",)

    name: Literal["sphere_mirror"] = "sphere_mirror"
    radius_mm: Length = Field(45.0, description="Radius of the ball, mm.")
    reflectance: Share = Field(0.65, description="Share of the light that the ball scatters evenly.")
    with_mirror: bool = Field(True, description="False: the same ball without the mirror, to compare.")
    mirror_angle_deg: float = Field(
        105.0,
        gt=30,
        lt=175,
        description="Angle between the scene's x axis and the mirror; more shows it to the camera, °.",
    )
    mirror_forward_mm: float = Field(
        50.0, ge=0, le=1000, description="How far the mirror's foot stands before the ball's centre, mm."
    )

    @model_validator(mode="after")
    def _stands_before_the_camera(self) -> Self:
        if self.distance_mm <= self.radius_mm:
            raise ValueError("distance_mm must exceed radius_mm: the camera is inside the sphere")
        return self

    @property
    def part_names(self) -> tuple[str, ...]:
        """The ball, and the mirror if it is there."""
        return ("ball", "mirror") if self.with_mirror else ("ball",)

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        ball = Sphere(self.placed((0, 0, 0)), self.radius_mm, Material(self.reflectance))
        mirror = self._mirror_from(self.radius_mm + self.mirror_gap_mm, -self.mirror_forward_mm)
        return {"ball": [ball], "mirror": [mirror]} if self.with_mirror else {"ball": [ball]}
