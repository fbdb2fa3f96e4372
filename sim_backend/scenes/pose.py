"""Where a scene is, how it is turned, what it consists of, and what a surface is like."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sim_backend.scenes.windows import Window
from sim_backend.surfaces import Array, Material, Rectangle, Surface

Share = Annotated[float, Field(ge=0, le=1)]
Length = Annotated[float, Field(gt=0, le=10_000)]


class Pose(BaseModel):
    """Where a scene is, how it is turned, and which of its parts are black."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        json_schema_extra=lambda schema, scene: _list_parts(schema, scene),
    )

    seen_once: ClassVar[bool] = False
    """Whether it is not worth keeping on disk how its light goes, because it will not be seen like this again."""

    PARTS: ClassVar[tuple[str, ...]] = ()
    """Names of what the scene consists of, where its fields do not change them."""

    MEASURED: ClassVar[tuple[str, ...] | None] = None
    """Parts that are there to be measured; None for all."""

    distance_mm: Length = Field(600.0, description="Distance of the scene's origin along the camera's axis, mm.")
    offset_x_mm: float = Field(0.0, description="The origin's place to the right of the camera's axis, mm.")
    offset_y_mm: float = Field(0.0, description="The origin's place below the camera's axis, mm.")
    yaw_deg: float = Field(
        0.0, ge=-80, le=80, description="Turn about the vertical; positive turns the front to the left, °."
    )
    pitch_deg: float = Field(0.0, ge=-80, le=80, description="Turn about the horizontal after the yaw, °.")
    roll_deg: float = Field(
        0.0,
        ge=-180,
        le=180,
        description="Turn about the scene's own z before the yaw; positive turns it clockwise for the camera, °.",
    )

    blackened: tuple[str, ...] = Field(
        (),
        description="Parts that are painted black: they absorb what would bounce off them, and the others are measured"
        " as if alone. `scan schema` says which parts a scene has.",
    )

    @model_validator(mode="after")
    def _blackens_what_there_is(self) -> Self:
        unknown = [name for name in self.blackened if name not in self.part_names]
        if unknown:
            raise ValueError(f"blackened: {', '.join(unknown)}: this scene's parts are {', '.join(self.part_names)}")
        return self

    @property
    def part_names(self) -> tuple[str, ...]:
        """What the scene consists of, in the order of `parts`."""
        return self.PARTS

    @abstractmethod
    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame, before anything is blackened."""

    def part_surfaces(self) -> Mapping[str, tuple[int, ...]]:
        """Numbers of the surfaces of every part, in the order of `surfaces`."""
        numbers, first = {}, 0
        for name, some in self.parts().items():
            numbers[name] = tuple(range(first, first + len(some)))
            first += len(some)
        return numbers

    def surfaces(self) -> list[Surface]:
        """What there is, in the camera frame and in the order of `parts`; blackened parts are black."""
        return [
            surface.blackened() if name in self.blackened else surface
            for name, some in self.parts().items()
            for surface in some
        ]

    def windows(self) -> Mapping[str, Window]:
        """Places on the surfaces that results are to be judged in, by name."""
        return {}

    def files(self) -> tuple[Path, ...]:
        """Files that the surfaces are made from, beside the fields."""
        return ()

    @property
    def rotation(self) -> Array:
        """(3, 3) from the scene's frame to the camera frame: Rx(pitch)·Ry(yaw)·Rz(roll)."""
        yaw, pitch, roll = (math.radians(a) for a in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
        about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
        return np.asarray(about_x @ about_y @ about_z)

    def turned(self, vector: tuple[float, float, float]) -> Array:
        """(3,) a direction of the scene's frame in the camera frame."""
        return np.asarray(self.rotation @ np.array(vector, np.float64))

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


def _list_parts(schema: dict[str, Any], scene: type[Pose]) -> None:
    """Say in a scene's JSON schema which parts can be blackened."""
    if scene.PARTS:
        schema["properties"]["blackened"]["items"]["enum"] = list(scene.PARTS)


class Finish(BaseModel):
    """What the surface of an object is like."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    reflectance: Share = Field(0.8, description="Share of the light that is scattered evenly (white paint: 0.8).")
    gloss: Share = Field(0.0, description="Share of the light that goes into the lobe about the mirror direction.")
    roughness: Share = Field(
        0.3, description="Breadth of that lobe, 0 (mirror) to 1; its standard deviation is √2·roughness² rad."
    )

    subsurface: Share = Field(
        0.0,
        description="Part of the evenly scattered light that wanders within the material first (wax: 0.5 and more).",
    )
    spread_mm: float = Field(
        2.0, gt=0, le=50, description="Standard deviation of how far that light wanders along the surface, mm."
    )

    @model_validator(mode="after")
    def _conserves_energy(self) -> Self:
        if self.reflectance + self.gloss > 1:
            raise ValueError("reflectance + gloss must not exceed 1: a surface gives back no more than it gets")
        return self

    @property
    def material(self) -> Material:
        """The same for the light transport."""
        return Material(self.reflectance, self.gloss, self.roughness, self.subsurface, self.spread_mm)
