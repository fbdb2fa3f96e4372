"""A part whose shape comes from mesh files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from sim_backend.scenes.pose import Finish, Length, Pose
from sim_backend.surfaces import Array, Surface

_SUFFIXES = ".stl", ".ply", ".obj"
_UP = {"x": 0, "y": 1, "z": 2}


class Piece(BaseModel):
    """One mesh file and what its surface is like."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: Path = Field(description="STL, PLY or OBJ file in mm, a path relative to the configuration's folder.")
    name: str | None = Field(None, min_length=1, description="What the piece is called; left out, as its file.")
    finish: Finish = Field(
        Finish(reflectance=0.35, gloss=0.4, roughness=0.12),
        description="The piece's surface; that of milled aluminium.",
    )
    crease_deg: float = Field(
        30.0, ge=0, le=180, description="Triangles that meet at less than this are shaded as one smooth surface, °."
    )
    closed: bool = Field(True, description="Whether holes in the mesh are mistakes; false for a sheet.")

    @field_validator("file")
    @classmethod
    def _is_there(cls, file: Path, info: ValidationInfo) -> Path:
        folder = (info.context or {}).get("folder")
        path = file if folder is None else Path(folder).resolve() / file
        if path.suffix.lower() not in _SUFFIXES:
            raise ValueError(f"{file.name} is no mesh that can be read: its name must end in {', '.join(_SUFFIXES)}")
        if not path.is_file():
            raise ValueError(f"there is no file {path}")
        return path

    @property
    def title(self) -> str:
        """What the piece is called."""
        return self.name or self.file.stem


class PartScene(Pose):
    """An industrial part from mesh files; the pose's origin is the middle of its bounding box."""

    name: Literal["part"] = "part"
    pieces: Annotated[tuple[Piece, ...], Field(min_length=1)] = Field(
        description="Mesh files that share one frame, each with its own surface."
    )
    scale: float = Field(
        1.0, gt=0, le=10_000, description="Factor from the files' unit to mm: 1 for mm, 25.4 for inches."
    )
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field("z", description="Axis of the files that points up.")
    turn_deg: float = Field(0.0, ge=-180, le=180, description="Turn of the part about its upright axis, °.")
    largest_mm: Length = Field(
        2000.0, description="A part that comes out larger than this is taken for one in another unit, mm."
    )

    @model_validator(mode="after")
    def _has_different_names(self) -> Self:
        if len(set(self.part_names)) != len(self.pieces):
            raise ValueError(f"two pieces are called the same ({', '.join(self.part_names)}): give them a `name`")
        return self

    @property
    def part_names(self) -> tuple[str, ...]:
        """The pieces' names."""
        return tuple(piece.title for piece in self.pieces)

    def files(self) -> tuple[Path, ...]:
        """The mesh files."""
        return tuple(piece.file for piece in self.pieces)

    def parts(self) -> Mapping[str, Sequence[Surface]]:
        """What there is by name, in the camera frame.

        Raises
        ------
        MeshFileError
            A file cannot be used, or the part comes out too large or too near.
        """
        # Imported here, because reading a mesh needs Open3D, and the settings alone do not.
        from sim_backend.mesh_files import MeshFileError, read_mesh
        from sim_backend.meshes import MeshSurface

        read = [read_mesh(piece.file, closed=piece.closed) for piece in self.pieces]
        upright = [vertices @ self._upright.T * self.scale for vertices, _ in read]
        low, high = (f([f(v, axis=0) for v in upright], axis=0) for f in (np.min, np.max))
        size = float(np.max(high - low))
        if size > self.largest_mm:
            raise MeshFileError(
                f"{self.pieces[0].file}: the part is {size:.6g} mm large, more than largest_mm ({self.largest_mm:g})",
                "Correct bench.scene.scale; the files are taken to be in mm.",
            )
        placed = [(v - (low + high) / 2) @ self.rotation.T + self.placed((0, 0, 0)) for v in upright]
        nearest = min(float(v[:, 2].min()) for v in placed)
        if nearest <= 0:
            raise MeshFileError(
                f"{self.pieces[0].file}: the part reaches {-nearest:.6g} mm behind the camera",
                "Increase bench.scene.distance_mm, or correct bench.scene.scale.",
            )
        return {
            piece.title: [MeshSurface.of(vertices, triangles, piece.finish.material, piece.crease_deg)]
            for piece, vertices, (_, triangles) in zip(self.pieces, placed, read, strict=True)
        }

    @property
    def _upright(self) -> Array:
        """(3, 3) from the files' axes to the scene's frame, in which y points down."""
        axis, sign = _UP[self.up[-1]], -1.0 if self.up.startswith("-") else 1.0
        up = sign * np.eye(3)[axis]
        # The two other axes in their cyclic order go right and away.
        right = np.eye(3)[(axis + 1) % 3]
        away = np.cross(up, right)
        turn = math.radians(self.turn_deg)
        about = np.array([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
        return np.asarray(about @ np.stack((right, -up, away)))
