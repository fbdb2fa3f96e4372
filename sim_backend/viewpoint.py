"""Where a lens stands, and how dense its pixels lie on a surface: the radiometry of camera and projector alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanner.rig import Lens, Rig
from sim_backend.kernels import pixel_density
from sim_backend.surfaces import Array

_GRID_PX = 4  # the area a pixel covers changes by less than 1e-3 over this distance


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A lens at its place.

    Parameters
    ----------
    lens
        Camera, or projector seen as one.
    rotation
        (3, 3) from the camera frame into the lens's own.
    centre
        (3,) centre of projection in the camera frame, mm.
    """

    lens: Lens
    rotation: Array
    centre: Array

    @classmethod
    def camera(cls, rig: Rig) -> Viewpoint:
        """The rig's camera."""
        return cls(rig.camera, np.eye(3), np.zeros(3))

    @classmethod
    def projector(cls, rig: Rig) -> Viewpoint:
        """The rig's projector."""
        return cls(rig.projector, rig.rotation, rig.projector_centre_cam)

    def rays(self, px: Array) -> Array:
        """(n, 3) directions of pixels (n, 2) in the camera frame, of any length."""
        return np.asarray(self.lens.rays(px) @ self.rotation)

    def project(self, point: Array) -> Array:
        """(n, 2) px of points (n, 3), NaN behind the lens."""
        return self.lens.project((point - self.centre) @ self.rotation.T)

    @cached_property
    def _density_at_unit_distance(self) -> Array:
        """Pixels per unit area of the plane z = 1, on a grid of every `_GRID_PX`-th pixel."""
        width, height = self.lens.size
        x, y = np.meshgrid(np.arange(0, width, _GRID_PX) + 0.0, np.arange(0, height, _GRID_PX) + 0.0)
        px = np.stack((x, y), axis=-1)
        right, down = np.array([0.5, 0.0]), np.array([0.0, 0.5])
        dx = self.lens.rays(px + right) - self.lens.rays(px - right)
        dy = self.lens.rays(px + down) - self.lens.rays(px - down)
        return np.asarray(1 / np.abs(dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0]))

    def density(self, px: Array, point: Array, normal: Array) -> Array:
        """Pixels per mm² of surface.

        For the projector this is the irradiance where every pixel sends out one unit of flux; for the camera its
        inverse is the area that one pixel sees.

        Parameters
        ----------
        px
            (n, 2) where the points are in the picture.
        point, normal
            (n, 3) mm and unit normals.

        Returns
        -------
        (n,) px/mm²; 0 where the surface faces away or the point is outside the picture's surroundings.
        """
        grid, size = self._density_at_unit_distance, self.lens.size
        return np.asarray(pixel_density(grid, _GRID_PX, size, self.centre, self.rotation[2].copy(), px, point, normal))


def bilinear_shares(px: Array, size: tuple[int, int]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """How a spot of light at a place is shared among the four pixels about it.

    Parameters
    ----------
    px
        (n, 2) places, finite.
    size
        (width, height) of the picture.

    Returns
    -------
    (n, 4) pixel numbers, counted row by row, and (n, 4) shares that add up to 1; what falls outside has share 0.
    """
    width, height = size
    corner = np.floor(px)
    fx, fy = (px - corner).T
    x, y = corner.T.astype(np.int64)
    columns, rows = np.stack((x, x + 1, x, x + 1), 1), np.stack((y, y, y + 1, y + 1), 1)
    share = np.stack(((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy), 1)
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    return np.where(inside, rows * width + columns, 0).astype(np.int32), (share * inside).astype(np.float32)
