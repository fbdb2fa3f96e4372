"""Which surface a ray meets, and where: Open3D finds the surface, the surface itself the exact point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.libusb import load_libusb

load_libusb()  # before Open3D, which needs it
import open3d as o3d  # noqa: E402

from sim_backend.kernels import meet  # noqa: E402
from sim_backend.meshes import MeshSurface  # noqa: E402
from sim_backend.sheets import Sheet  # noqa: E402
from sim_backend.surfaces import Array, Surface  # noqa: E402

CLEARANCE_MM = 0.01
"""How far above its surface a ray starts, so that it does not meet that very surface through rounding."""

MISS = -1
"""Surface number of a ray that meets nothing."""


@dataclass(frozen=True)
class Hits:
    """Where rays met a scene.

    Parameters
    ----------
    surface
        (n,) int16 number of the surface, `MISS` for none.
    point
        (n, 3) mm, NaN for none.
    normal
        (n, 3) unit normal on the side the ray came from, NaN for none.
    """

    surface: NDArray[np.int16]
    point: Array
    normal: Array


class RayCaster:
    """Rays against the surfaces of a scene."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = tuple(surfaces)
        self._scene = o3d.t.geometry.RaycastingScene()
        for surface in surfaces:
            vertices, triangles = surface.mesh
            self._scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles))
        self._shapes = np.array([surface.shape for surface in surfaces])
        self.materials = np.array(
            [(m.diffuse, m.specular, m.concentration) for m in (surface.material for surface in surfaces)]
        )
        """(surfaces, 3) diffuse share, specular share, concentration of the lobe."""
        self.sheets = {number: surface for number, surface in enumerate(surfaces) if isinstance(surface, Sheet)}
        """The printed ones, by number."""
        self._meshes = {number: surface for number, surface in enumerate(surfaces) if isinstance(surface, MeshSurface)}

    def first_hits(self, origin: Array, direction: Array, leaving: Array | None = None) -> Hits:
        """What rays meet first.

        Parameters
        ----------
        origin
            (3,) or (n, 3) mm.
        direction
            (n, 3), any length.
        leaving
            (n, 3) unit normals of the surface that the rays start from, if they do.
        """
        start = origin if leaving is None else origin + CLEARANCE_MM * leaving
        cast = self._scene.cast_rays(_rays(start, direction))
        # Open3D's number for "none" is the largest uint32, which becomes -1.
        surface = cast["geometry_ids"].numpy().astype(np.int16)
        begin = np.array(np.broadcast_to(origin, direction.shape), order="C")
        point, normal = meet(self._shapes, surface, begin, direction)
        for number, mesh in self._meshes.items():
            at = np.flatnonzero(surface == number)
            triangle = cast["primitive_ids"].numpy()[at].astype(np.int64)
            point[at], normal[at] = mesh.meet(triangle, begin[at], direction[at])
        return Hits(surface, point, normal)

    def extended(self, surface: NDArray[np.int16], origin: Array, direction: Array) -> Array:
        """(n, 3) mm, where rays from ``origin`` (3,) meet surfaces (n,), or what goes on beyond their edges.

        Of surfaces made of triangles, nothing goes on; what is returned for them means nothing.
        """
        begin = np.array(np.broadcast_to(origin, direction.shape), order="C")
        return np.asarray(meet(self._shapes, surface, begin, direction)[0])

    def diffuse(self, hits: Hits, sides: Array | None = None) -> Array:
        """(n,) share of the light that the surfaces scatter evenly where they are hit.

        Parameters
        ----------
        hits
            (n,) hits.
        sides
            (n, 2, 3) mm, sides of the parallelograms over which the mean of a print is taken; None for points.
        """
        share: Array = self.materials[hits.surface, 0]
        for number, sheet in self.sheets.items():
            at = np.flatnonzero(hits.surface == number)
            share[at] = sheet.reflectance(hits.point[at], np.zeros((at.size, 2, 3)) if sides is None else sides[at])
        return share

    def unprinted(self, hits: Hits) -> Array:
        """(n,) the same as `diffuse` where nothing is printed."""
        light = self.materials[:, 0].copy()
        for number, sheet in self.sheets.items():
            light[number] = sheet.light
        return np.asarray(light[hits.surface])

    def visible(self, point: Array, normal: Array, target: Array) -> NDArray[np.bool_]:
        """Whether nothing stands between points (n, 3), seen from the side of their normals, and ``target`` (3,)."""
        start = point + CLEARANCE_MM * normal
        hidden = self._scene.test_occlusions(_rays(start, target - start), tnear=0.0, tfar=1.0)
        return ~np.asarray(hidden.numpy(), bool)


def _rays(origin: Array, direction: Array) -> Any:
    rays = np.empty((len(direction), 6), np.float32)
    rays[:, :3] = origin
    rays[:, 3:] = direction
    return o3d.core.Tensor.from_numpy(rays)
