"""What scenes are made of: analytic surfaces with a material, all in the camera frame, mm."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mesh = tuple[NDArray[np.float32], NDArray[np.uint32]]
"""Vertices (n, 3) in mm and triangles (m, 3)."""


@dataclass(frozen=True)
class Material:
    """How a surface scatters light: a Lambertian part and one lobe about the mirror direction.

    Parameters
    ----------
    diffuse
        Share of the arriving flux that is scattered evenly, 0..1.
    specular
        Share that goes into the lobe, 0..1; ``diffuse + specular`` stays below 1 by energy.
    roughness
        0 a perfect mirror, 1 a very broad lobe, on the perceptual scale of Burley (SIGGRAPH course 2012): the facets'
        slope parameter is its square.
    subsurface
        Part of ``diffuse``, 0..1, that leaves the surface elsewhere than it entered.
    spread_mm
        Standard deviation along each direction of how far from there, mm.
    """

    diffuse: float
    specular: float = 0.0
    roughness: float = 0.0
    subsurface: float = 0.0
    spread_mm: float = 0.0

    @property
    def lobe_rad(self) -> float:
        """Standard deviation of the lobe per axis, rad: facet slopes of α/√2 turn a reflected ray by twice as much."""
        return math.sqrt(2) * self.roughness**2

    @property
    def concentration(self) -> float:
        """κ of the lobe as a von Mises–Fisher distribution, 1/rad²; inf for a perfect mirror."""
        return self.lobe_rad**-2 if self.roughness else math.inf


BLACK = Material(0.0)
"""Absorbs all light."""


class Surface(Protocol):
    """A surface that rays meet; both its sides have the material."""

    @property
    def lights_itself(self) -> bool:
        """Whether light that leaves it can meet it again."""
        ...

    def blackened(self) -> Self:
        """The same, but it absorbs all light."""
        ...

    @property
    def material(self) -> Material:
        """How it scatters."""
        ...

    @property
    def mesh(self) -> Mesh:
        """Triangles that find out *which* surface a ray meets; `shape` says where."""
        ...

    @property
    def shape(self) -> Array:
        """(12,) the exact shape, see `shape_of`."""
        ...


def shape_of(
    centre: Array,
    *,
    radius: float = 0.0,
    normal: Array | None = None,
    along: Array | None = None,
    curvature: float = 0.0,
    half_width: float = 0.0,
) -> Array:
    """(12,) a shape as the kernel `sim_backend.kernels.meet` takes it.

    Parameters
    ----------
    centre
        (3,) mm, of a sphere, or a point of a plane or of the apex line of a parabolic cylinder.
    radius
        Of a sphere, mm; 0 for the others.
    normal
        (3,) unit normal of the plane, or at the apex line.
    along, curvature, half_width
        Of a parabolic cylinder z = c x²: (3,) unit vector along x, at right angles to the normal, which is along z; c,
        1/mm; how far it goes along x, mm.
    """
    nothing = np.zeros(3)
    normal = nothing if normal is None else normal
    return np.concatenate((centre, [radius], normal, [curvature], nothing if along is None else along, [half_width]))


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A flat rectangle.

    Parameters
    ----------
    centre
        (3,) mm.
    half_width, half_height
        (3,) mm, from the centre to the middle of two neighbouring sides, at right angles.
    material
        How it scatters.
    """

    centre: Array
    half_width: Array
    half_height: Array
    material: Material

    @property
    def lights_itself(self) -> bool:
        """A flat one does not."""
        return False

    def blackened(self) -> Self:
        """The same, but it absorbs all light."""
        return replace(self, material=BLACK)

    @cached_property
    def normal(self) -> Array:
        """(3,) unit normal."""
        n = np.cross(self.half_width, self.half_height)
        return np.asarray(n / np.linalg.norm(n))

    @property
    def mesh(self) -> Mesh:
        """Two triangles."""
        a, b = self.half_width, self.half_height
        corners = self.centre + np.array([-a - b, a - b, a + b, -a + b])
        return corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.uint32)

    @property
    def shape(self) -> Array:
        """Its plane."""
        return shape_of(self.centre, normal=self.normal)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A whole sphere.

    Parameters
    ----------
    centre
        (3,) mm.
    radius
        mm.
    material
        How it scatters.
    """

    centre: Array
    radius: float
    material: Material

    @property
    def lights_itself(self) -> bool:
        """A convex one does not."""
        return False

    def blackened(self) -> Self:
        """The same, but it absorbs all light."""
        return replace(self, material=BLACK)

    _RINGS = 200  # facets lie at most r·3e-5 below the sphere, less than the shadow rays' clearance

    @property
    def mesh(self) -> Mesh:
        """An inscribed grid of meridians and parallels."""
        polar = np.linspace(0, math.pi, self._RINGS + 1)[:, None]
        azimuth = np.arange(2 * self._RINGS)[None] * (math.pi / self._RINGS)
        sphere = np.stack(
            np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)),
            axis=-1,
        )
        row, column = np.mgrid[: self._RINGS, : 2 * self._RINGS]
        following = (column + 1) % (2 * self._RINGS)
        a, b = row * 2 * self._RINGS + column, row * 2 * self._RINGS + following
        c, d = a + 2 * self._RINGS, b + 2 * self._RINGS
        triangles = np.stack((np.stack((a, b, c), -1), np.stack((b, d, c), -1))).reshape(-1, 3)
        vertices = self.centre + self.radius * sphere.reshape(-1, 3)
        return vertices.astype(np.float32), triangles.astype(np.uint32)

    @property
    def shape(self) -> Array:
        """Centre and radius."""
        return shape_of(self.centre, radius=self.radius)
