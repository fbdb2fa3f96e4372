"""A matt sheet with a print on it, flat or slightly bent."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from sim_backend.prints import Print
from sim_backend.surfaces import Array, Material, Mesh, shape_of

_STRIPS = 128  # of a bent sheet: the facets lie within sagitta/128² of it, less than the shadow rays' clearance
_PARTS = 100


@dataclass(frozen=True, eq=False)
class Sheet:
    """A rectangular sheet, bent to a parabola along its width without being stretched.

    Parameters
    ----------
    centre
        (3,) mm.
    rotation
        (3, 3) from the sheet's frame (x right, y down as the print is looked at) to the camera frame.
    width, height
        mm along the sheet.
    bend
        Sagitta of the bend, mm; positive bends the sides away from who looks at the print.
    figures
        What is printed; coordinates along the sheet, from its middle.
    light, dark
        Reflectance of the sheet and of its print.
    """

    centre: Array
    rotation: Array
    width: float
    height: float
    bend: float
    figures: Print
    light: float
    dark: float

    @property
    def lights_itself(self) -> bool:
        """It is bent so little that it hardly does."""
        return False

    def blackened(self) -> Self:
        """The same, but it absorbs all light."""
        return replace(self, light=0.0, dark=0.0)

    @cached_property
    def _half_width(self) -> float:
        """Half of the bent sheet's width from side to side, mm: half its length along the parabola is ``width`` / 2."""
        x = self.width / 2
        for _ in range(50):
            rise = 2 * self.bend / x
            # With z = bend (x/h)², the arc to h is h/2 (√(1 + q²) + asinh(q)/q), q = 2 bend/h.
            x = self.width / (math.hypot(1, rise) + (math.asinh(rise) / rise if rise else 1.0))
        return x

    @property
    def _curvature(self) -> float:
        """Second-order coefficient of its section, 1/mm."""
        return self.bend / self._half_width**2

    @cached_property
    def material(self) -> Material:
        """Its mean, for light that has been elsewhere."""
        w, h = self.width / _PARTS, self.height / _PARTS
        x, y = ((np.arange(_PARTS) + 0.5 - _PARTS / 2) * step for step in (w, h))
        places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        sides = np.broadcast_to(np.diag([w, h]), (len(places), 2, 2))
        return Material(float(self._mixed(self.figures.dark_share(places, sides)).mean()))

    @property
    def mesh(self) -> Mesh:
        """Two triangles for each of the strips that it is cut into along its width."""
        strips = _STRIPS if self.bend else 1
        x = np.linspace(-self._half_width, self._half_width, strips + 1)
        z = self._curvature * x**2
        sides = [np.stack((x, np.full_like(x, y), z), 1) for y in (-self.height / 2, self.height / 2)]
        corners = self.centre + np.concatenate(sides) @ self.rotation.T
        a = np.arange(strips, dtype=np.uint32)
        b, c, d = a + 1, a + strips + 1, a + strips + 2
        triangles = np.concatenate((np.stack((a, b, d), 1), np.stack((a, d, c), 1)))
        return corners.astype(np.float32), triangles.astype(np.uint32)

    @property
    def shape(self) -> Array:
        """Its plane or parabolic cylinder."""
        right, _, away = self.rotation.T
        return shape_of(self.centre, normal=away, along=right, curvature=self._curvature, half_width=self._half_width)

    def reflectance(self, point: Array, sides: Array) -> Array:
        """What the print leaves of the light.

        Parameters
        ----------
        point
            (n, 3) mm on the sheet, camera frame.
        sides
            (n, 2, 3) mm, sides of the parallelogram about the point over which to take the mean; zero for none.

        Returns
        -------
        (n,) 0..1.
        """
        right, down = self.rotation[:, 0], self.rotation[:, 1]
        x, stretch = (point - self.centre) @ right, np.ones(1)
        along = x
        if self.bend:
            slope = 2 * self._curvature * x
            stretch = np.hypot(1, slope)
            along = (slope * stretch + np.arcsinh(slope)) / (4 * self._curvature)
        place = np.stack((along, (point - self.centre) @ down), 1)
        on_sheet = np.stack(((sides @ right) * stretch[:, None], sides @ down), -1)
        return self._mixed(self.figures.dark_share(place, on_sheet))

    def _mixed(self, dark_share: Array) -> Array:
        return self.light + (self.dark - self.light) * dark_share
