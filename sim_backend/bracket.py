"""The bracket of ``configs/scenes/part.yaml``: a plate, a wall, a fillet, two gussets and a boss with a blind hole.

``python -m sim_backend.bracket configs/scenes/meshes/bracket.stl`` writes the file.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

from drivers.libusb import load_libusb
from sim_backend.meshes import Triangles
from sim_backend.solids import box, joined, prism, turned_solid
from sim_backend.surfaces import Array

_SINK_MM = 0.2
"""Pieces reach so far into those that they stand on: no light leaks between them."""

_WIDTH_MM = 110.0


def bracket() -> tuple[Array, Triangles]:
    """Vertices (n, 3) in mm, z up, x along the wall, and triangles (m, 3), fronts outwards; pieces overlap."""
    plate = _moved(box(_WIDTH_MM, 70, 9), (0, 0, 4.5))
    wall = _moved(box(_WIDTH_MM, 9, 62), (0, 30.5, 31))
    # From the plate's top (18, 9) to the wall's face (26, 17), about (18, 17).
    turns = np.linspace(0, math.pi / 2, 25)
    corner = 26 + _SINK_MM, 9 - _SINK_MM
    fillet = [corner, *((26 - 8 * (1 - math.sin(t)), 17 - 8 * math.cos(t)) for t in turns[::-1])]
    gusset = [corner, (corner[0], 46), (20, 46), (-14, 14), (-14, corner[1])]
    boss = turned_solid([(0, -8.5), (17, -8.5), (17, -38.5), (9, -38.5), (9, -12.5), (0, -12.5)], sides=96)
    return joined(
        [
            plate,
            wall,
            prism(fillet, -_WIDTH_MM / 2, _WIDTH_MM / 2),
            prism(gusset, -42, -34),
            prism(gusset, 34, 42),
            _moved(_upright(boss), (0, -8, 0)),
        ]
    )


def _moved(solid: tuple[Array, Triangles], by: tuple[float, float, float]) -> tuple[Array, Triangles]:
    return solid[0] + np.array(by, np.float64), solid[1]


def _upright(solid: tuple[Array, Triangles]) -> tuple[Array, Triangles]:
    """A solid turned about -y, with that axis up."""
    x, y, z = solid[0].T
    return np.stack([x, z, -y], axis=1), solid[1]


def write(path: Path) -> None:
    """Write the bracket as a binary STL file."""
    load_libusb()
    import open3d

    vertices, triangles = bracket()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    mesh.compute_triangle_normals()
    if not open3d.io.write_triangle_mesh(path, mesh):
        raise SystemExit(f"{path} could not be written")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
