"""Several diffuse objects that stand close together."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from sim_backend.scenes.pose import Finish, Length, Pose
from sim_backend.surfaces import Rectangle, Sphere, Surface

_VASE = (
    (0.0, 0.0),
    (20.0, 0.0),
    (29.0, -24.0),
    (31.0, -38.0),
    (27.0, -54.0),
    (15.0, -74.0),
    (12.5, -86.0),
    (19.0, -104.0),
)
"""(radius, y) of the vase's half section, mm; y = 0 is its foot."""
_BALL_RADIUS = 34.0
_BLOCK = 64.0, 58.0, 46.0
"""Width, height, depth of the block, mm."""


class ObjectsScene(Pose):
    """A vase, a ball and a block on a table before a wall, close together, all nearly matt.

    The block is turned so that its face and the ball, and its side and the vase, make a V; the vase's neck, the foot of
    the wall and the table make concavities. The pose's origin is the middle of the wall.
    """

    PARTS: ClassVar = ("wall", "table", "vase", "ball", "block")

    name: Literal["objects"] = "objects"
    distance_mm: Length = Field(660.0, description="Distance of the wall's middle along the camera's axis, mm.")
    offset_y_mm: float = Field(-20.0, description="The origin's place below the camera's axis, mm.")
    pitch_deg: float = Field(
        22.0, ge=-80, le=80, description="Turn about the horizontal; positive shows it from above, °."
    )
    wall_width_mm: Length = Field(260.0, description="Width of the wall and the table, mm.")
    wall_height_mm: Length = Field(190.0, description="Height of the wall, mm.")
    table_depth_mm: Length = Field(150.0, description="Depth of the table, mm.")
    block_turn_deg: float = Field(32.0, ge=-90, le=90, description="Turn of the block about the vertical, °.")
    finish: Finish = Field(
        Finish(reflectance=0.7, gloss=0.12, roughness=0.15), description="The surface of vase, ball and block."
    )
    ground: Finish = Field(Finish(reflectance=0.75), description="The surface of wall and table.")

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame."""
        # Imported here, as all that computes.
        from scipy.interpolate import PchipInterpolator

        from sim_backend.meshes import MeshSurface
        from sim_backend.solids import turned_solid

        w, h, d, foot = (
            self.wall_width_mm / 2,
            self.wall_height_mm / 2,
            self.table_depth_mm / 2,
            self.wall_height_mm / 2,
        )
        ground, matt = self.ground.material, self.finish.material
        body = [(radius, y) for radius, y in _VASE if radius]
        y = [-k * body[-1][1] / -60 for k in range(61)]
        outline = PchipInterpolator([-v for _, v in body], [r for r, _ in body])
        profile = [(0.0, 0.0), *((float(outline(-v)), v) for v in y), (0.0, y[-1])]
        vertices, triangles = turned_solid(profile)
        vase = MeshSurface.of(
            (vertices + np.array((-48.0, foot, -52.0))) @ self.rotation.T + self.placed((0, 0, 0)), triangles, matt
        )
        return {
            "wall": [self.rectangle((0, 0, 0), (w, 0, 0), (0, h, 0), ground)],
            "table": [self.rectangle((0, foot, -d), (w, 0, 0), (0, 0, d), ground)],
            "vase": [vase],
            "ball": [Sphere(self.placed((74.0, foot - _BALL_RADIUS, -60.0)), _BALL_RADIUS, matt)],
            "block": self._block((14.0, foot - _BLOCK[1] / 2, -44.0)),
        }

    def _block(self, centre: tuple[float, float, float]) -> Sequence[Rectangle]:
        """Front, right and left side, and top; nobody sees the rest."""
        turn = math.radians(self.block_turn_deg)
        right, away, down = (
            (math.cos(turn), 0.0, math.sin(turn)),
            (-math.sin(turn), 0.0, math.cos(turn)),
            (0.0, 1.0, 0.0),
        )
        w, h, d = (size / 2 for size in _BLOCK)
        x, y, z = centre

        def face(
            middle: tuple[float, float, float], side: float, *halves: tuple[tuple[float, float, float], float]
        ) -> Rectangle:
            a, b = ((v[0] * s, v[1] * s, v[2] * s) for v, s in halves)
            place = x + middle[0] * side, y + middle[1] * side, z + middle[2] * side
            return self.rectangle(place, a, b, self.finish.material)

        return [
            face(away, -d, (right, w), (down, h)),
            face(right, w, (away, d), (down, h)),
            face(right, -w, (away, d), (down, h)),
            face(down, -h, (right, w), (away, d)),
        ]
