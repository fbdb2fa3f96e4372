"""Surfaces made of triangles, shaded as the smooth shape that the triangles stand for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim_backend.surfaces import BLACK, Array, Material, Mesh, shape_of

Triangles = NDArray[np.int64]
"""(m, 3) numbers of vertices."""

_TINY = 1e-12


@dataclass(frozen=True, eq=False)
class MeshSurface:
    """Triangles with a normal at each of their corners.

    Rays meet the flat triangles; reflection and shading follow normals interpolated between the corners (Phong,
    Communications of the ACM 18(6), 1975).

    Parameters
    ----------
    vertices
        (n, 3) mm, camera frame.
    triangles
        (m, 3) numbers of vertices.
    corner_normals
        (m, 3, 3) unit normals at the triangles' corners.
    material
        How it scatters.
    """

    vertices: Array
    triangles: Triangles
    corner_normals: Array
    material: Material

    @classmethod
    def of(cls, vertices: Array, triangles: Triangles, material: Material, crease_deg: float = 30.0) -> MeshSurface:
        """A surface that is smooth except along creases, where triangles meet at more than ``crease_deg``."""
        normals = smooth_normals(vertices, triangles, crease_deg)
        return cls(np.asarray(vertices, np.float64), np.asarray(triangles, np.int64), normals, material)

    @property
    def lights_itself(self) -> bool:
        """It may: nobody says that it is convex."""
        return True

    def blackened(self) -> Self:
        """The same, but it absorbs all light."""
        return replace(self, material=BLACK)

    @property
    def mesh(self) -> Mesh:
        """The triangles."""
        return self.vertices.astype(np.float32), self.triangles.astype(np.uint32)

    @property
    def shape(self) -> Array:
        """A placeholder: its points come from `meet`."""
        return shape_of(np.zeros(3), radius=1.0)

    @cached_property
    def _corners(self) -> Array:
        return self.vertices[self.triangles]

    @cached_property
    def _facing(self) -> Array:
        """(m, 3) normals of the triangles, as long as they are large."""
        a, b, c = np.moveaxis(self._corners, 1, 0)
        return np.cross(b - a, c - a)

    def meet(self, triangle: NDArray[np.int64], origin: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays (n, 3) meet the planes of triangles (n,), and the unit normals there on the side they come from.

        Single precision finds the triangle; here the point is found in double precision.
        """
        facing, start = self._facing[triangle], self._corners[triangle, 0]
        rise = np.einsum("ij,ij->i", direction, facing)
        # A ray that grazes its triangle is known to meet it, so that the plane's distance is rounding only.
        rise = np.where(np.abs(rise) < _TINY, _TINY, rise)
        point = origin + (np.einsum("ij,ij->i", start - origin, facing) / rise)[:, None] * direction
        weight = _barycentric(point, self._corners[triangle], facing)
        normal = np.einsum("ij,ijk->ik", weight, self.corner_normals[triangle])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = np.where(length > _TINY, normal / np.maximum(length, _TINY), self.corner_normals[triangle, 0])
        return point, np.where(rise[:, None] > 0, -normal, normal)


def smooth_normals(vertices: Array, triangles: Triangles, crease_deg: float) -> Array:
    """Unit normals at the corners of triangles.

    A corner's normal is the mean of those of the triangles about its vertex that lean from its own by less than
    ``crease_deg``, weighted by their angles there (Thürmer & Wüthrich, Journal of Graphics Tools 3(1), 1998).

    Parameters
    ----------
    vertices
        (n, 3); triangles that touch share vertices.
    triangles
        (m, 3), without empty ones, all with their fronts to one side.
    crease_deg
        0 makes facets, 180 smooths all.

    Returns
    -------
    (m, 3, 3).
    """
    corners = np.asarray(vertices, np.float64)[triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    ahead = np.roll(corners, -1, axis=1) - corners
    ahead /= np.linalg.norm(ahead, axis=2, keepdims=True)
    angle = np.arccos(np.clip(np.einsum("ijk,ijk->ij", ahead, -np.roll(ahead, 1, axis=1)), -1, 1)).ravel()

    # All pairs of corners at one vertex: the k-th corner of a vertex is paired with each of its corners in turn.
    vertex, triangle = np.asarray(triangles).ravel(), np.repeat(np.arange(len(triangles)), 3)
    by_vertex = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(vertices))
    begin = np.cumsum(count) - count
    valence = count[vertex]
    here = np.repeat(np.arange(vertex.size), valence)
    step = np.arange(here.size) - np.repeat(np.cumsum(valence) - valence, valence)
    other = by_vertex[begin[vertex[here]] + step]
    smooth = np.einsum("ij,ij->i", facing[triangle[here]], facing[triangle[other]]) >= np.cos(np.radians(crease_deg))
    # A triangle is always its own neighbour, whatever rounding says.
    smooth |= here == other
    here, other = here[smooth], other[smooth]
    weighted = angle[other, None] * facing[triangle[other]]
    normal = np.stack([np.bincount(here, weighted[:, k], vertex.size) for k in range(3)], 1)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True)).reshape(-1, 3, 3)


def _barycentric(point: Array, corners: Array, facing: Array) -> Array:
    """(n, 3) shares of the corners (n, 3, 3) in points (n, 3) of their planes; those a little outside are drawn in."""
    area = np.einsum("ij,ij->i", facing, facing)
    share = np.stack(
        [
            np.einsum(
                "ij,ij->i",
                np.cross(corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3], point - corners[:, (k + 1) % 3]),
                facing,
            )
            / area
            for k in range(3)
        ],
        axis=1,
    ).clip(0, 1)
    return np.asarray(share / share.sum(1, keepdims=True))
