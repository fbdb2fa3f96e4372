"""The scenes a simulated bench can look at, parametric in pose, size, reflectance and roughness.

Every scene has its own frame (x right, y down, z away from the camera), whose origin and turn `Pose` gives.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_backend.surfaces import Array, Material, Rectangle, Sphere, Surface

Share = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0, le=10_000)]


class Pose(BaseModel):
    """Where a scene is and how it is turned."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    distance_mm: Length = Field(600.0, description="Distance of the scene's origin along the camera's axis, mm.")
    offset_x_mm: float = Field(0.0, description="The origin's place to the right of the camera's axis, mm.")
    offset_y_mm: float = Field(0.0, description="The origin's place below the camera's axis, mm.")
    yaw_deg: float = Field(
        0.0, ge=-80, le=80, description="Turn about the vertical; positive turns the front to the left, °."
    )
    pitch_deg: float = Field(0.0, ge=-80, le=80, description="Turn about the horizontal after the yaw, °.")

    def turned(self, vector: tuple[float, float, float]) -> Array:
        """(3,) a direction of the scene's frame in the camera frame."""
        yaw, pitch = math.radians(self.yaw_deg), math.radians(self.pitch_deg)
        cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        return np.asarray(about_x @ about_y @ np.array(vector, np.float64))

    def placed(self, point: tuple[float, float, float]) -> Array:
        """(3,) a point of the scene's frame in the camera frame, mm."""
        return np.asarray(np.add(self.turned(point), (self.offset_x_mm, self.offset_y_mm, self.distance_mm)))

    def rectangle(
        self,
        centre: tuple[float, float, float],
        half_width: tuple[float, float, float],
        half_height: tuple[float, float, float],
        material: Material,
    ) -> Rectangle:
        """A rectangle given in the scene's frame."""
        return Rectangle(self.placed(centre), self.turned(half_width), self.turned(half_height), material)


class Finish(BaseModel):
    """What the surface of an object is like."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reflectance: Share = Field(0.8, description="Share of the light that is scattered evenly (white paint: 0.8).")
    gloss: Share = Field(0.0, description="Share of the light that goes into the lobe about the mirror direction.")
    roughness: Share = Field(
        0.3, description="Breadth of that lobe, 0 (mirror) to 1; its standard deviation is √2·roughness² rad."
    )

    @model_validator(mode="after")
    def _conserves_energy(self) -> Self:
        if self.reflectance + self.gloss > 1:
            raise ValueError("reflectance + gloss must not exceed 1: a surface gives back no more than it gets")
        return self

    @property
    def material(self) -> Material:
        """The same for the light transport."""
        return Material(self.reflectance, self.gloss, self.roughness)


class PlaneScene(Pose):
    """A flat board."""

    name: Literal["plane"] = "plane"
    yaw_deg: float = Field(10.0, ge=-80, le=80, description="Turn about the vertical, °.")
    pitch_deg: float = Field(5.0, ge=-80, le=80, description="Turn about the horizontal after the yaw, °.")
    width_mm: Length = Field(260.0, description="Width, mm.")
    height_mm: Length = Field(200.0, description="Height, mm.")
    finish: Finish = Field(Finish(), description="The board's surface.")

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame."""
        w, h = self.width_mm / 2, self.height_mm / 2
        return [self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), self.finish.material)]


class SphereScene(Pose):
    """A ball; the pose's origin is its centre."""

    name: Literal["sphere"] = "sphere"
    radius_mm: Length = Field(70.0, description="Radius, mm.")
    finish: Finish = Field(Finish(), description="The ball's surface.")

    @model_validator(mode="after")
    def _stands_before_the_camera(self) -> Self:
        if self.distance_mm <= self.radius_mm:
            raise ValueError("distance_mm must exceed radius_mm: the camera is inside the sphere")
        return self

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame."""
        return [Sphere(self.placed((0, 0, 0)), self.radius_mm, self.finish.material)]


class StepsScene(Pose):
    """A staircase that comes nearer step by step from left to right, with its risers."""

    name: Literal["steps"] = "steps"
    steps: int = Field(5, ge=2, le=50, description="Number of treads.")
    step_depth_mm: Length = Field(12.0, description="Depth from one tread to the next, mm.")
    step_width_mm: Length = Field(48.0, description="Width of one tread, mm.")
    height_mm: Length = Field(180.0, description="Height of the treads, mm.")
    finish: Finish = Field(Finish(reflectance=0.6), description="The staircase's surface.")

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame: treads from left to right, then risers."""
        half, h, matt = (self.steps - 1) / 2, self.height_mm / 2, self.finish.material
        treads: list[Surface] = [
            self.rectangle(
                ((k - half) * self.step_width_mm, 0, (half - k) * self.step_depth_mm),
                (self.step_width_mm / 2, 0, 0),
                (0, h, 0),
                matt,
            )
            for k in range(self.steps)
        ]
        risers = [
            self.rectangle(
                ((k + 0.5 - half) * self.step_width_mm, 0, (half - k - 0.5) * self.step_depth_mm),
                (0, 0, self.step_depth_mm / 2),
                (0, h, 0),
                matt,
            )
            for k in range(self.steps - 1)
        ]
        return treads + risers


class VGrooveScene(Pose):
    """Two boards that meet in a vertical fold and open towards the camera; each lights the other."""

    name: Literal["v_groove"] = "v_groove"
    pitch_deg: float = Field(
        15.0,
        ge=-80,
        le=80,
        description="Turn about the horizontal, °; near 0 the glossy faces together throw the projector's image into"
        " the camera.",
    )
    opening_deg: float = Field(95.0, gt=10, lt=179, description="Angle between the two faces, °.")
    face_width_mm: Length = Field(110.0, description="Width of one face, from the fold to its free edge, mm.")
    height_mm: Length = Field(180.0, description="Height of the faces, mm.")
    finish: Finish = Field(
        Finish(reflectance=0.65, gloss=0.25, roughness=0.08), description="The surface of both faces."
    )

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame: the left face, the right face."""
        half, h = math.radians(self.opening_deg / 2), self.height_mm / 2
        x, z = self.face_width_mm / 2 * math.sin(half), self.face_width_mm / 2 * math.cos(half)
        return [
            self.rectangle((side * x, 0, -z), (side * x, 0, -z), (0, h, 0), self.finish.material) for side in (-1, 1)
        ]


class _Board(Pose):
    """A matt board; the pose's origin is its centre."""

    offset_x_mm: float = Field(-30.0, description="The board's centre to the right of the camera's axis, mm.")
    board_width_mm: Length = Field(260.0, description="Width of the board, mm.")
    board_height_mm: Length = Field(250.0, description="Height of the board, mm.")
    board_reflectance: Share = Field(0.8, description="Share of the light that the board scatters evenly.")
    mirror_angle_deg: float = Field(
        100.0,
        gt=30,
        lt=175,
        description="Angle between board and mirror, °; 90 stands upright on the board, more opens away from it.",
    )
    mirror_tilt_deg: float = Field(
        5.0,
        gt=-60,
        lt=60,
        description="Turn of the mirror about its own horizontal middle line; sends the bounce up, °.",
    )
    mirror_width_mm: Length = Field(75.0, description="Length of the mirror away from the board, mm.")
    mirror_height_mm: Length = Field(150.0, description="Height of the mirror along the board's edge, mm.")
    mirror_gap_mm: float = Field(
        15.0, ge=0, le=1000, description="Gap between the board's right edge and the mirror, mm."
    )
    mirror_reflectance: Share = Field(0.6, description="Share of the light that the mirror reflects.")
    mirror_roughness: Share = Field(
        0.0, description="0 a perfect mirror; else its lobe's standard deviation is √2·roughness² rad."
    )

    def _board(self) -> Surface:
        w, h = self.board_width_mm / 2, self.board_height_mm / 2
        return self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), Material(self.board_reflectance))

    def _mirror(self) -> Surface:
        angle, tilt = math.radians(self.mirror_angle_deg), math.radians(self.mirror_tilt_deg)
        along = (-math.cos(angle), -math.sin(angle))  # (x, z) away from the board
        middle = self.mirror_gap_mm + self.mirror_width_mm / 2
        w, h = self.mirror_width_mm / 2, self.mirror_height_mm / 2
        face = (-math.sin(angle), math.cos(angle))  # (x, z) of the normal, towards the board's front
        return self.rectangle(
            (self.board_width_mm / 2 + middle * along[0], 0, middle * along[1]),
            (w * along[0], 0, w * along[1]),
            (h * math.sin(tilt) * face[0], h * math.cos(tilt), h * math.sin(tilt) * face[1]),
            Material(0.0, self.mirror_reflectance, self.mirror_roughness),
        )


class MirrorScene(_Board):
    """A white matt board with a plane mirror at its right edge, which throws a bounce on the board."""

    name: Literal["mirror"] = "mirror"

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame: board, mirror."""
        return [self._board(), self._mirror()]


class MirrorRemovedScene(_Board):
    """The scene ``mirror`` without its mirror; it takes the same parameters, so that the two compare."""

    name: Literal["mirror_removed"] = "mirror_removed"

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame: the board."""
        return [self._board()]


Scene = Annotated[
    PlaneScene | SphereScene | StepsScene | VGrooveScene | MirrorScene | MirrorRemovedScene,
    Field(discriminator="name"),
]
"""Any of the scenes, told apart by ``name``."""
