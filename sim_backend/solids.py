"""Solids made of triangles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sim_backend.meshes import Triangles
from sim_backend.surfaces import Array

_SIDES = 240
"""Of a turned solid; its facets lie r·9e-5 below the round, less than a shadow ray's clearance for r < 110 mm."""


def turned_solid(profile: Sequence[tuple[float, float]], sides: int = _SIDES) -> tuple[Array, Triangles]:
    """What a lathe makes: a profile turned about the y axis.

    Parameters
    ----------
    profile
        Two or more (radius, y) in mm from the bottom of the solid (largest y) to its top; a radius of 0 closes an end.
    sides
        Facets round the axis.

    Returns
    -------
    Vertices (n, 3) in mm and triangles (m, 3), fronts outwards.
    """
    radius, y = np.asarray(profile, np.float64).T
    azimuth = np.arange(sides) * (2 * math.pi / sides)
    ring = np.stack(
        (
            radius[:, None] * np.cos(azimuth),
            np.broadcast_to(y[:, None], (radius.size, sides)),
            radius[:, None] * np.sin(azimuth),
        ),
        axis=-1,
    )
    number = np.arange(radius.size * sides).reshape(-1, sides)
    # A ring of radius 0 is one vertex.
    number[radius == 0] = number[radius == 0][:, :1]
    a, b = number[:-1], np.roll(number, -1, axis=1)[:-1]
    c, d = number[1:], np.roll(number, -1, axis=1)[1:]
    triangles = np.concatenate((np.stack((a, b, c), -1).reshape(-1, 3), np.stack((b, d, c), -1).reshape(-1, 3)))
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(1)
    return ring.reshape(-1, 3), triangles[distinct]


def box(width: float, height: float, depth: float) -> tuple[Array, Triangles]:
    """A box about the origin: vertices (8, 3) in mm along x, y and z, and triangles (12, 3), fronts outwards."""
    corner = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    return corner * (width, height, depth), np.concatenate((quads[:, :3], quads[:, [0, 2, 3]]))


def joined(solids: Sequence[tuple[Array, Triangles]]) -> tuple[Array, Triangles]:
    """Several solids as one set of vertices and triangles."""
    begin = np.cumsum([0, *(len(vertices) for vertices, _ in solids)])
    return (
        np.concatenate([vertices for vertices, _ in solids]),
        np.concatenate([triangles + first for (_, triangles), first in zip(solids, begin, strict=False)]),
    )


def prism(profile: Sequence[tuple[float, float]], start: float, stop: float) -> tuple[Array, Triangles]:
    """A polygon of the y-z plane drawn out along x.

    Parameters
    ----------
    profile
        Three or more (y, z) in mm, counterclockwise as seen from +x; all of it can be seen from the first point.
    start, stop
        Where it begins and ends along x, mm.

    Returns
    -------
    Vertices (n, 3) in mm and triangles (m, 3), fronts outwards.
    """
    count = len(profile)
    vertices = np.array([(x, y, z) for x in (start, stop) for y, z in profile], np.float64)
    fan = np.array([(0, k, k + 1) for k in range(1, count - 1)])
    here = np.arange(count)
    ahead = np.roll(here, -1)
    sides = np.concatenate(
        [np.stack((here, ahead, ahead + count), 1), np.stack((here, ahead + count, here + count), 1)]
    )
    return vertices, np.concatenate((fan[:, ::-1], fan + count, sides))
