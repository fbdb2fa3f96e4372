"""Plain objects: a plane, a ball, a staircase, a fold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim_backend.scenes.pose import Finish, Length, Pose
from sim_backend.surfaces import Sphere, Surface


class PlaneScene(Pose):
    """A flat board."""

    PARTS: ClassVar = ("board",)

    name: Literal["plane"] = "plane"
    yaw_deg: float = Field(10.0, ge=-80, le=80, description="Turn about the vertical, °.")
    pitch_deg: float = Field(5.0, ge=-80, le=80, description="Turn about the horizontal after the yaw, °.")
    width_mm: Length = Field(260.0, description="Width, mm.")
    height_mm: Length = Field(200.0, description="Height, mm.")
    finish: Finish = Field(Finish(), description="The board's surface.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        w, h = self.width_mm / 2, self.height_mm / 2
        return {"board": [self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), self.finish.material)]}


class SphereScene(Pose):
    """A ball; the pose's origin is its centre."""

    PARTS: ClassVar = ("ball",)

    name: Literal["sphere"] = "sphere"
    radius_mm: Length = Field(70.0, description="Radius, mm.")
    finish: Finish = Field(Finish(), description="The ball's surface.")

    @model_validator(mode="after")
    def _stands_before_the_camera(self) -> Self:
        if self.distance_mm <= self.radius_mm:
            raise ValueError("distance_mm must exceed radius_mm: the camera is inside the sphere")
        return self

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        return {"ball": [Sphere(self.placed((0, 0, 0)), self.radius_mm, self.finish.material)]}


class StepsScene(Pose):
    """A staircase that comes nearer step by step from left to right, with its risers."""

    PARTS: ClassVar = ("treads", "risers")
    MEASURED: ClassVar = ("treads",)

    name: Literal["steps"] = "steps"
    steps: int = Field(5, ge=2, le=50, description="Number of treads.")
    step_depth_mm: Length = Field(12.0, description="Depth from one tread to the next, mm.")
    step_width_mm: Length = Field(48.0, description="Width of one tread, mm.")
    height_mm: Length = Field(180.0, description="Height of the treads, mm.")
    finish: Finish = Field(Finish(reflectance=0.6), description="The staircase's surface.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame, each from left to right."""
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
        return {"treads": treads, "risers": risers}


class VGrooveScene(Pose):
    """Two boards that meet in a vertical fold and open towards the camera; each lights the other."""

    PARTS: ClassVar = ("left", "right")

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

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        half, h = math.radians(self.opening_deg / 2), self.height_mm / 2
        x, z = self.face_width_mm / 2 * math.sin(half), self.face_width_mm / 2 * math.cos(half)
        return {
            name: [self.rectangle((side * x, 0, -z), (side * x, 0, -z), (0, h, 0), self.finish.material)]
            for name, side in (("left", -1), ("right", 1))
        }
