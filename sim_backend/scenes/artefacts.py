"""Artefacts that show how well a bench measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim_backend.scenes.pose import Finish, Length, Pose
from sim_backend.surfaces import Array, Sphere, Surface


class BallBarScene(Pose):
    """Two balls of one size at a known distance along the scene's x; the pose's origin is midway between them."""

    PARTS: ClassVar = ("left", "right")

    name: Literal["ball_bar"] = "ball_bar"
    radius_mm: Length = Field(25.0, description="Radius of either ball, mm.")
    spacing_mm: Length = Field(150.0, description="Distance between the balls' centres, mm.")
    finish: Finish = Field(Finish(), description="The balls' surface.")

    @model_validator(mode="after")
    def _has_two_balls_before_the_camera(self) -> Self:
        if self.spacing_mm < 2 * self.radius_mm:
            raise ValueError("spacing_mm must be at least twice radius_mm: the balls stand in each other")
        if min(centre[2] for centre in self._centres()) <= self.radius_mm:
            raise ValueError("distance_mm is too short: the camera is inside a ball")
        return self

    def _centres(self) -> list[Array]:
        return [self.placed((side * self.spacing_mm / 2, 0, 0)) for side in (-1, 1)]

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        balls = [Sphere(centre, self.radius_mm, self.finish.material) for centre in self._centres()]
        return {name: [ball] for name, ball in zip(self.PARTS, balls, strict=True)}
