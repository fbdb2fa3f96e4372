"""From projector coordinates to points: the place on each viewing ray that both lens models agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.errors import OperatorError
from scanner import optics
from scanner.patterns import Axis
from scanner.rig import Lens, Rig

Map = NDArray[np.float32] | NDArray[np.float64]


class TriangulationError(OperatorError):
    """The maps do not belong to the rig."""


@dataclass(frozen=True)
class Triangulation:
    """Points of all camera pixels, float32, NaN where there is none.

    Parameters
    ----------
    points
        (H, W, 3) mm in the camera frame.
    sigma_point
        (H, W) predicted standard deviation along the viewing ray, mm.
    epipolar_px
        (H, W) distance of the measured (x_p, y_p) from the pixel's epipolar curve, px; None with one axis.
    epipolar_sigmas
        The same in units of its predicted standard deviation.
    """

    points: NDArray[np.float32]
    sigma_point: NDArray[np.float32]
    epipolar_px: NDArray[np.float32] | None = None
    epipolar_sigmas: NDArray[np.float32] | None = None

    @property
    def depth(self) -> NDArray[np.float32]:
        """(H, W) mm along the camera's z; a view of `points`."""
        return self.points[..., 2]


def triangulate(
    rig: Rig,
    x_p: Map | None,
    sigma_x: Map | None,
    y_p: Map | None = None,
    sigma_y: Map | None = None,
) -> Triangulation:
    """Points from projector columns, rows, or both.

    The point of a pixel is X = d/w on its undistorted viewing ray d = (x, y, 1). The projector's full lens
    model gives the coordinates (x_p(w), y_p(w)) of that point; w minimises Σ (measured − predicted)²/σ² over
    the axes there are, by Gauss-Newton from the closed form that a projector without distortion has. One axis
    has an exact solution: the ray meets the curved sheet of light. Errors are propagated to first order:
    σ_w⁻² = Σ (∂u/∂w)²/σ_u², σ_point = |d| z² σ_w.

    Parameters
    ----------
    rig
        The calibrated rig.
    x_p, y_p
        (H, W) measured projector column and row, px; None where the axis was not measured.
    sigma_x, sigma_y
        (H, W) their standard deviations, px, positive.

    Returns
    -------
    Triangulation
        NaN where any given coordinate is NaN, any σ is not positive, the point would lie behind the camera or
        the projector, or a lens model does not reach it.

    Raises
    ------
    TriangulationError
        No axis, a coordinate without its σ, or maps of another size than the camera.
    """
    width, height = rig.camera.size
    axes = 0
    for bit, name, u, sigma in ((1, "x", x_p, sigma_x), (2, "y", y_p, sigma_y)):
        if u is None:
            continue
        axes |= bit
        for label, values in ((f"{name}_p", u), (f"sigma_{name}", sigma)):
            if values is None or values.shape != (height, width):
                raise TriangulationError(
                    f"{label} is {'missing' if values is None else f'{values.shape} px'}, "
                    f"the rig's camera has {height} rows × {width} columns",
                    "Use the rig that belongs to these frames, and the frames in full size.",
                )
    if not axes:
        raise TriangulationError("neither x_p nor y_p is given", "Measure at least one axis across the baseline.")

    result = Triangulation(
        np.empty((height, width, 3), np.float32),
        np.empty((height, width), np.float32),
        np.empty((height, width), np.float32) if axes == 3 else None,
        np.empty((height, width), np.float32) if axes == 3 else None,
    )
    nothing = np.empty(0, np.float32)

    def row_of(values: Map | None, row: int) -> NDArray[np.float64]:
        return np.empty(0) if values is None else np.ascontiguousarray(values[row], np.float64)

    def rows(begin: int, end: int) -> None:
        directions = np.empty((width, 2))
        for row in range(begin, end):
            optics.row_directions(rig.camera.vector, float(row), directions)
            optics.triangulate_row(
                directions,
                rig.projector.vector,
                rig.rotation,
                rig.translation,
                row_of(x_p, row),
                row_of(sigma_x, row),
                row_of(y_p, row),
                row_of(sigma_y, row),
                axes,
                result.points[row],
                result.sigma_point[row],
                nothing if result.epipolar_px is None else result.epipolar_px[row],
                nothing if result.epipolar_sigmas is None else result.epipolar_sigmas[row],
            )

    optics.in_blocks(height, rows)
    return result


def epipolar_crossings(rig: Rig, pixels: NDArray[np.intp], u: Map, axis: Axis) -> tuple[Map, Map]:
    """Where the epipolar curves of camera pixels cross given projector columns or rows.

    Parameters
    ----------
    rig
        The calibrated rig.
    pixels
        (P,) flat numbers of camera pixels.
    u
        (K, P) projector column (``axis`` x) or row (y), px.

    Returns
    -------
    other, slope
        (K, P) the other coordinate, px, and its change with ``u``; NaN where the place is not one of a point in front
        of camera and projector.
    """
    width = rig.camera.size[0]
    if not pixels.size:
        return np.empty(u.shape), np.empty(u.shape)
    rows, columns = np.divmod(pixels, width)
    directions = rig.camera.rays(np.stack([columns, rows], axis=1).astype(np.float64))
    values = np.ascontiguousarray(u, np.float64)
    other, slope = np.empty_like(values), np.empty_like(values)

    def some(begin: int, end: int) -> None:
        optics.epipolar_crossings(
            directions, rig.projector.vector, rig.rotation, rig.translation, 0 if axis == "x" else 1, values, other,
            slope, begin, end,
        )  # fmt: skip

    optics.in_blocks(pixels.size, some, at_least=4096)
    return other, slope


def compile_all() -> None:
    """Compile the lens and triangulation kernels into Numba's cache, so that no scan waits for it."""
    lens = Lens(np.eye(3), np.empty(0), (2, 1))
    rig = Rig(lens, lens, np.eye(3), np.array([1.0, 0.0, 0.0]))
    lens.project(lens.rays(np.zeros((1, 2))))
    triangulate(rig, np.ones((1, 2), np.float32), np.ones((1, 2), np.float32))
    epipolar_crossings(rig, np.zeros(1, np.intp), np.ones((1, 1)), "x")
