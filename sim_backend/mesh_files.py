"""Triangle meshes from files, checked until light can be traced on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import OperatorError
from drivers.libusb import load_libusb
from sim_backend.meshes import Triangles
from sim_backend.surfaces import Array

SUFFIXES = (".stl", ".ply", ".obj")
_WELD = 1e-6
"""Vertices closer than this share of the mesh's diagonal are one: STL files repeat them for each triangle."""


class MeshFileError(OperatorError):
    """A mesh file that no surface can be made of."""


def read_mesh(path: Path, *, closed: bool) -> tuple[Array, Triangles]:
    """Vertices (n, 3) and triangles (m, 3) of an STL, PLY or OBJ file, in the file's own unit and axes.

    Equal vertices are joined, empty triangles left out, and the triangles of each piece turned to one side.

    Parameters
    ----------
    path
        The file.
    closed
        Whether to insist on a closed surface.

    Raises
    ------
    MeshFileError
        The file is missing, empty, broken, holds no triangles, or is not closed and should be.
    """
    vertices, triangles = _read(path)
    if not len(triangles):
        if len(vertices):
            raise MeshFileError(
                f"{path}: holds {len(vertices)} points and no triangles", "Export the part as a triangle mesh."
            )
        raise MeshFileError(
            f"{path}: holds no triangles, or is broken", f"Export the part again as {', '.join(SUFFIXES)}."
        )
    if not np.isfinite(vertices).all() or triangles.max() >= len(vertices) or triangles.min() < 0:
        raise MeshFileError(
            f"{path}: is broken: vertices are not numbers, or triangles name vertices that are not there",
            "Export the part again.",
        )
    vertices, triangles = _welded(vertices, triangles)
    if not len(triangles):
        raise MeshFileError(f"{path}: all its triangles are empty", "Export the part again, with a finer resolution.")
    if closed:
        _insist_on_closed(path, vertices, triangles)
    return vertices, _oriented(vertices, triangles)


def _read(path: Path) -> tuple[Array, Triangles]:
    if path.suffix.lower() not in SUFFIXES:
        raise MeshFileError(
            f"{path}: {path.suffix or 'no suffix'} is no mesh that can be read", f"Name one of {', '.join(SUFFIXES)}."
        )
    if not path.is_file():
        raise MeshFileError(f"{path}: no such file", "Correct the path; it counts from the configuration's folder.")
    try:
        if not path.read_bytes():
            raise MeshFileError(f"{path}: is empty", "Export the part again.")
    except OSError as error:
        raise MeshFileError(f"{path}: cannot be read: {error.strerror}", "Ask for the permission to read it.") from None
    load_libusb()  # before Open3D, which needs it
    import open3d as o3d

    # What it would print says less than the errors here.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
    return np.asarray(mesh.vertices, np.float64).reshape(-1, 3), np.asarray(mesh.triangles, np.int64).reshape(-1, 3)


def _welded(vertices: Array, triangles: Triangles) -> tuple[Array, Triangles]:
    step = _WELD * float(np.linalg.norm(np.ptp(vertices, axis=0))) or 1.0
    _, first, number = np.unique(np.rint(vertices / step), axis=0, return_index=True, return_inverse=True)
    vertices, triangles = vertices[first], number.ravel()[triangles]
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    return vertices, triangles[np.linalg.norm(np.cross(b - a, c - a), axis=1) > step**2]


def _edges(triangles: Triangles) -> NDArray[np.int64]:
    """(3 m, 2) sides of triangles, lower vertex first."""
    return np.sort(np.concatenate((triangles[:, :2], triangles[:, 1:], triangles[:, ::2])), axis=1)


def _insist_on_closed(path: Path, vertices: Array, triangles: Triangles) -> None:
    edges, count = np.unique(_edges(triangles), axis=0, return_counts=True)
    # Bodies that touch along an edge share it, two triangles each.
    open_edges = edges[count % 2 == 1]
    if not len(open_edges):
        return
    x, y, z = vertices[open_edges[0]].mean(0)
    raise MeshFileError(
        f"{path}: is not closed: {len(open_edges)} of {len(edges)} edges have a triangle on one side only,"
        f" the first at ({x:.6g}, {y:.6g}, {z:.6g})",
        "Mend the mesh, or write `closed: false` if it is a sheet that is meant to be open.",
    )


def _oriented(vertices: Array, triangles: Triangles) -> Triangles:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))
    mesh.orient_triangles()
    return np.asarray(mesh.triangles, np.int64)
