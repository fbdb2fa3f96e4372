"""Glossy objects before matt boards: a ball in a fold, thin fins."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim_backend.scenes.pose import Finish, Length, Pose, Share
from sim_backend.scenes.windows import Window
from sim_backend.surfaces import Material, Sphere, Surface

_SIDES = (("left", -1), ("right", 1))


class VBoardSphereScene(Pose):
    """A V-shaped white board with a glossy ball in its fold, which throws bounces on both faces.

    The pose's origin is the middle of the fold. The windows W1 on the left face and W2 on the right one lie beside the
    ball, where its bounce is strong.
    """

    PARTS: ClassVar = ("left", "right", "ball")
    MEASURED: ClassVar = ("left", "right")

    name: Literal["v_board_sphere"] = "v_board_sphere"
    distance_mm: Length = Field(640.0, description="Distance of the fold's middle along the camera's axis, mm.")
    opening_deg: float = Field(112.0, gt=60, lt=175, description="Angle between the two faces, °.")
    face_width_mm: Length = Field(140.0, description="Width of one face, from the fold to its free edge, mm.")
    height_mm: Length = Field(190.0, description="Height of the faces, mm.")
    board_reflectance: Share = Field(0.75, description="Share of the light that the faces scatter evenly.")
    radius_mm: Length = Field(46.0, description="Radius of the ball, mm.")
    gap_mm: float = Field(3.0, gt=0, le=1000, description="Gap between the ball and either face, mm.")
    ball: Finish = Field(Finish(reflectance=0.12, gloss=0.8, roughness=0.06), description="The ball's surface.")
    window_width_mm: Length = Field(24.0, description="Width of the windows W1 and W2, mm.")
    window_height_mm: Length = Field(44.0, description="Height of the windows, mm.")
    window_at_mm: Length = Field(86.0, description="Distance of the windows' middles from the fold, mm.")

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.window_at_mm + self.window_width_mm / 2 > self.face_width_mm or self.window_height_mm > self.height_mm:
            raise ValueError("the windows lie beyond the faces: reduce window_at_mm or the windows' size")
        if self.distance_mm <= self._forward_mm + self.radius_mm:
            raise ValueError("distance_mm is too short: the camera is inside the ball")
        return self

    @property
    def _half(self) -> float:
        return math.radians(self.opening_deg / 2)

    @property
    def _forward_mm(self) -> float:
        """How far the ball's centre stands before the fold, mm."""
        return (self.radius_mm + self.gap_mm) / math.sin(self._half)

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        w, h, white = self.face_width_mm / 2, self.height_mm / 2, Material(self.board_reflectance)
        x, z = w * math.sin(self._half), w * math.cos(self._half)
        faces: dict[str, Sequence[Surface]] = {
            name: [self.rectangle((side * x, 0, -z), (side * x, 0, -z), (0, h, 0), white)] for name, side in _SIDES
        }
        return faces | {"ball": [Sphere(self.placed((0, 0, -self._forward_mm)), self.radius_mm, self.ball.material)]}

    def windows(self) -> Mapping[str, Window]:
        """W1 on the left face, W2 on the right one."""
        w, h = self.window_width_mm / 2, self.window_height_mm / 2
        across, back = math.sin(self._half), math.cos(self._half)
        return {
            name: Window(
                number,
                self.placed((side * self.window_at_mm * across, 0, -self.window_at_mm * back)),
                self.turned((side * w * across, 0, -w * back)),
                self.turned((0, h, 0)),
            )
            for number, (name, side) in enumerate((("W1", -1), ("W2", 1)))
        }


class FinsScene(Pose):
    """Thin polished fins that stand upright before a white board, as those of a heat sink: each a few pixels wide.

    Their sides throw narrow bounces on the board; the pose's origin is the board's middle.
    """

    PARTS: ClassVar = ("board", "fins")

    name: Literal["fins"] = "fins"
    board_width_mm: Length = Field(240.0, description="Width of the board, mm.")
    board_height_mm: Length = Field(180.0, description="Height of the board, mm.")
    board_reflectance: Share = Field(0.8, description="Share of the light that the board scatters evenly.")
    count: int = Field(6, ge=1, le=100, description="Number of fins.")
    thickness_mm: Length = Field(3.0, description="Thickness of a fin, mm.")
    depth_mm: Length = Field(16.0, description="How far a fin stands off the board, mm.")
    length_mm: Length = Field(120.0, description="Length of a fin from top to bottom, mm.")
    spacing_mm: Length = Field(34.0, description="Distance from one fin to the next, mm.")
    gap_mm: float = Field(1.0, gt=0, le=1000, description="Gap between the fins and the board, mm.")
    finish: Finish = Field(Finish(reflectance=0.25, gloss=0.6, roughness=0.05), description="The fins' surface.")

    @model_validator(mode="after")
    def _stand_apart(self) -> Self:
        if self.count > 1 and self.spacing_mm <= self.thickness_mm:
            raise ValueError("spacing_mm must exceed thickness_mm: the fins stand in each other")
        return self

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        # Imported here, as all that computes.
        from sim_backend.meshes import MeshSurface
        from sim_backend.solids import box, joined

        w, h = self.board_width_mm / 2, self.board_height_mm / 2
        board = self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), Material(self.board_reflectance))
        fin, triangles = box(self.thickness_mm, self.length_mm, self.depth_mm)
        forward = self.gap_mm + self.depth_mm / 2
        places = [((k - (self.count - 1) / 2) * self.spacing_mm, 0, -forward) for k in range(self.count)]
        vertices, triangles = joined([(fin + place, triangles) for place in places])
        fins = MeshSurface.of(vertices @ self.rotation.T + self.placed((0, 0, 0)), triangles, self.finish.material)
        return {"board": [board], "fins": [fins]}
