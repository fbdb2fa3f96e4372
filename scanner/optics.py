"""The compiled lens model: the pixel of a ray, the ray of a pixel, the depth of a correspondence.

A lens is a flat float64 vector (26,), so that every kernel compiles once:
``[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt (9, row by row), s_max]`` with the
distortion of OpenCV's full model and ``s_max`` the squared radius up to which that model is one-to-one.

`directions_plain` and `triangulate_plain` say the same in NumPy without any shortcut; tests hold the kernels
to them. All kernels live in this one file because numba's cache looks at a kernel's own file only.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEAR_PX = 1e-2  # Newton squares the error: a step that starts this near ends within 1e-7 px
_MAX_STEPS = 30
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
# Division by zero gives inf as in NumPy; sums may be reordered, but NaN and inf keep their meaning.
_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})


def lens_vector(matrix: Array, distortion: Array) -> Array:
    """Pack a camera matrix (3, 3) and 0–14 distortion terms in OpenCV order into the vector of a lens."""
    k = np.zeros(14)
    k[: distortion.size] = distortion
    return np.concatenate(
        (
            [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]],
            k[:12],
            _tilt(k[12], k[13]).ravel(),
            [_largest_squared_radius(k)],
        )
    )


def _tilt(tau_x: float, tau_y: float) -> Array:
    """Homography (3, 3) of a sensor turned by ``tau_x``, ``tau_y``, rad (OpenCV's Scheimpflug model)."""
    cx, sx, cy, sy = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    onto_plane = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return np.asarray(onto_plane @ turn, np.float64)


def _largest_squared_radius(k: Array) -> float:
    """Squared radius s = r² at which the radial model r·N(s)/D(s) first turns back, or D vanishes."""
    s = np.polynomial.Polynomial([0.0, 1.0])
    numerator = np.polynomial.Polynomial([1.0, k[0], k[1], k[4]])
    denominator = np.polynomial.Polynomial([1.0, k[5], k[6], k[7]])
    slope = (numerator + 2 * s * numerator.deriv()) * denominator - 2 * s * numerator * denominator.deriv()
    roots = np.concatenate((slope.trim().roots(), denominator.trim().roots()))
    ends = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(ends.min()) if ends.size else math.inf


def in_blocks(count: int, work: Callable[[int, int], None], at_least: int = 1) -> None:
    """Call ``work(begin, end)`` for blocks of 0..count on all cores; kernels release the GIL."""
    # A few blocks per core even out rows that cost nothing because they hold no data.
    step = max(at_least, math.ceil(count / (4 * _CORES)))
    begins = range(0, count, step)
    if len(begins) <= 1 or _CORES == 1:
        for begin in begins:
            work(begin, min(begin + step, count))
        return
    with ThreadPoolExecutor(_CORES) as pool:
        for done in [pool.submit(work, begin, min(begin + step, count)) for begin in begins]:
            done.result()


@_compiled
def _image(lens: Any, x: Any, y: Any) -> Any:
    """Pixel (u, v) of the direction (x, y, 1) and its derivatives (u_x, u_y, v_x, v_y)."""
    s = x * x + y * y
    numerator = 1.0 + s * (lens[4] + s * (lens[5] + s * lens[8]))
    denominator = 1.0 / (1.0 + s * (lens[9] + s * (lens[10] + s * lens[11])))
    radial = numerator * denominator
    d_numerator = lens[4] + s * (2.0 * lens[5] + s * 3.0 * lens[8])
    d_denominator = lens[9] + s * (2.0 * lens[10] + s * 3.0 * lens[11])
    d_radial = 2.0 * (d_numerator - radial * d_denominator) * denominator  # d radial/dx = x · d_radial
    p1, p2 = lens[6], lens[7]
    xd = x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + s * (lens[12] + s * lens[13])
    yd = y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y + s * (lens[14] + s * lens[15])
    prism_x = 2.0 * (lens[12] + 2.0 * s * lens[13])
    prism_y = 2.0 * (lens[14] + 2.0 * s * lens[15])
    cross = x * y * d_radial + 2.0 * (p1 * x + p2 * y)
    xd_x = radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x
    xd_y = cross + prism_x * y
    yd_x = cross + prism_y * x
    yd_y = radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y
    q = 1.0 / (lens[22] * xd + lens[23] * yd + lens[24])
    xt = (lens[16] * xd + lens[17] * yd + lens[18]) * q
    yt = (lens[19] * xd + lens[20] * yd + lens[21]) * q
    a, b = (lens[16] - xt * lens[22]) * q, (lens[17] - xt * lens[23]) * q
    c, d = (lens[19] - yt * lens[22]) * q, (lens[20] - yt * lens[23]) * q
    fx, fy = lens[0], lens[1]
    return (
        fx * xt + lens[2],
        fy * yt + lens[3],
        fx * (a * xd_x + b * yd_x),
        fx * (a * xd_y + b * yd_y),
        fy * (c * xd_x + d * yd_x),
        fy * (c * xd_y + d * yd_y),
    )


@_compiled
def _direction(lens: Any, u: float, v: float, x: float, y: float) -> Any:
    """Direction (x, y) that pixel (u, v) sees, by Newton from a start (x, y), and its derivative after u.

    NaN where the lens model reaches no such pixel.
    """
    for _ in range(_MAX_STEPS):
        pu, pv, u_x, u_y, v_x, v_y = _image(lens, x, y)
        det = u_x * v_y - u_y * v_x
        if not det > 0.0:
            break
        ru, rv = u - pu, v - pv
        x += (v_y * ru - u_y * rv) / det
        y += (u_x * rv - v_x * ru) / det
        if abs(ru) + abs(rv) < _NEAR_PX:
            if x * x + y * y < lens[25]:
                return x, y, v_y / det, -v_x / det
            break
    return math.nan, math.nan, math.nan, math.nan


@_compiled
def project_points(lens: Any, points: Any, out: Any) -> None:
    """Fill ``out`` (n, 2) with the pixels of ``points`` (n, 3); NaN behind the lens or outside its model."""
    for i in range(points.shape[0]):
        z = points[i, 2]
        u = v = math.nan
        if z > 0.0:
            x, y = points[i, 0] / z, points[i, 1] / z
            if x * x + y * y < lens[25]:
                u, v, _, _, _, _ = _image(lens, x, y)
        out[i, 0] = u
        out[i, 1] = v


@_compiled
def pixel_directions(lens: Any, pixels: Any, out: Any) -> None:
    """Fill ``out`` (n, 3) with the rays (x, y, 1) of ``pixels`` (n, 2)."""
    for i in range(pixels.shape[0]):
        u, v = pixels[i, 0], pixels[i, 1]
        x, y, _, _ = _direction(lens, u, v, (u - lens[2]) / lens[0], (v - lens[3]) / lens[1])
        out[i, 0] = x
        out[i, 1] = y
        out[i, 2] = 1.0 if x == x else math.nan


@_compiled
def row_directions(lens: Any, row: float, out: Any) -> None:
    """Fill ``out`` (width, 2) with the directions (x, y) of all pixels of an image row."""
    x = y = x_u = y_u = math.nan
    for column in range(out.shape[0]):
        # The neighbour, carried on by one pixel, is so good a start that one Newton step is enough.
        x, y = x + x_u, y + y_u
        if x != x:
            x, y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
        x, y, x_u, y_u = _direction(lens, float(column), row, x, y)
        out[column, 0] = x
        out[column, 1] = y


@_compiled
def _weight(sigma: float) -> float:
    return 1.0 / (sigma * sigma) if sigma > 0.0 else math.nan


@_compiled
def triangulate_row(
    directions: Any,
    projector: Any,
    rotation: Any,
    translation: Any,
    x: Any,
    sigma_x: Any,
    y: Any,
    sigma_y: Any,
    axes: int,
    points: Any,
    sigma_point: Any,
    epipolar_px: Any,
    epipolar_sigmas: Any,
) -> None:
    """Depth of one image row's correspondences; see `scanner.triangulation.triangulate`.

    ``directions`` (width, 2) are the camera's rays. ``axes`` is 1 for x, 2 for y, 3 for both: inputs of the
    other axis are not read, epipolar distances are written for both only.
    """
    t0, t1, t2 = translation[0], translation[1], translation[2]
    shift_u = shift_v = 0.0
    for i in range(directions.shape[0]):
        dx, dy = directions[i, 0], directions[i, 1]
        xm = ym = weight_x = weight_y = 0.0
        if axes & 1:
            xm, weight_x = x[i], _weight(sigma_x[i])
        if axes & 2:
            ym, weight_y = y[i], _weight(sigma_y[i])
        w = sigma_w = distance = distance_sigma = math.nan
        if math.isfinite(xm + ym + dx + weight_x + weight_y):
            # Along the ray, X_proj ~ a + w t with w = 1/z.
            a0 = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2]
            a1 = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2]
            a2 = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2]
            # But for distortion both equations are linear in w; the neighbour's corrects the start.
            xn = (xm - shift_u - projector[2]) / projector[0]
            yn = (ym - shift_v - projector[3]) / projector[1]
            bx, by = (t0 - xn * t2) * projector[0], (t1 - yn * t2) * projector[1]
            cx, cy = (xn * a2 - a0) * projector[0], (yn * a2 - a1) * projector[1]
            start = (weight_x * bx * cx + weight_y * by * cy) / (weight_x * bx * bx + weight_y * by * by)
            for _ in range(_MAX_STEPS):
                q = 1.0 / (a2 + start * t2)
                if not q > 0.0:
                    break
                xn, yn = (a0 + start * t0) * q, (a1 + start * t1) * q
                u, v, u_x, u_y, v_x, v_y = _image(projector, xn, yn)
                x_w, y_w = (t0 - xn * t2) * q, (t1 - yn * t2) * q
                u_w, v_w = u_x * x_w + u_y * y_w, v_x * x_w + v_y * y_w
                information = weight_x * u_w * u_w + weight_y * v_w * v_w
                step = (weight_x * u_w * (xm - u) + weight_y * v_w * (ym - v)) / information
                start += step
                if not abs(step) * (abs(u_w) + abs(v_w)) > _NEAR_PX:
                    if start > 0.0 and xn * xn + yn * yn < projector[25]:
                        w = start
                        shift_u = u - projector[0] * xn - projector[2]
                        shift_v = v - projector[1] * yn - projector[3]
                        sigma_w = 1.0 / math.sqrt(information)
                        if axes == 3:
                            along = 1.0 / math.sqrt(u_w * u_w + v_w * v_w)
                            distance = abs((xm - u) * v_w - (ym - v) * u_w) * along
                            distance_sigma = math.sqrt(v_w * v_w / weight_x + u_w * u_w / weight_y) * along
                    break
        z = 1.0 / w
        points[i, 0] = dx * z
        points[i, 1] = dy * z
        points[i, 2] = z
        sigma_point[i] = math.sqrt(1.0 + dx * dx + dy * dy) * z * z * sigma_w
        if axes == 3:
            epipolar_px[i] = distance
            epipolar_sigmas[i] = distance / distance_sigma


@_compiled
def epipolar_crossings(
    directions: Any,
    projector: Any,
    rotation: Any,
    translation: Any,
    axis: int,
    u: Any,
    other: Any,
    slope: Any,
    begin: int,
    end: int,
) -> None:
    """Where the epipolar curves of the camera rays begin..end cross given projector columns (``axis`` 0) or rows (1).

    ``directions`` (n, 3) are the camera's rays, ``u`` (k, n) the coordinates; ``other`` and ``slope`` (k, n) are filled
    with the other coordinate there and its change with ``u``, NaN where no point before camera and projector is there.
    """
    t0, t1, t2 = translation[0], translation[1], translation[2]
    for i in range(begin, end):
        dx, dy = directions[i, 0], directions[i, 1]
        a0 = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2]
        a1 = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2]
        a2 = rotation[2, 0] * dx + rotation[2, 1] * dy + rotation[2, 2]
        for k in range(u.shape[0]):
            other[k, i] = slope[k, i] = math.nan
            wanted = u[k, i]
            if not math.isfinite(wanted + dx + dy):
                continue
            # But for distortion the equation is linear in w = 1/z.
            normal = (wanted - projector[2 + axis]) / projector[axis]
            w = (normal * a2 - (a1 if axis else a0)) / ((t1 if axis else t0) - normal * t2)
            for _ in range(_MAX_STEPS):
                q = 1.0 / (a2 + w * t2)
                if not q > 0.0:
                    break
                xn, yn = (a0 + w * t0) * q, (a1 + w * t1) * q
                x, y, u_x, u_y, v_x, v_y = _image(projector, xn, yn)
                x_w, y_w = (t0 - xn * t2) * q, (t1 - yn * t2) * q
                along, across = u_x * x_w + u_y * y_w, v_x * x_w + v_y * y_w
                if axis:
                    x, y, along, across = y, x, across, along
                step = (wanted - x) / along
                w += step
                if not abs(wanted - x) > _NEAR_PX:
                    if w > 0.0 and xn * xn + yn * yn < projector[25]:
                        other[k, i] = y + across * step
                        slope[k, i] = across / along
                    break


def directions_plain(lens: Array, pixels: Array) -> Array:
    """Twin of `pixel_directions`: directions (n, 2) of ``pixels`` (n, 2) by twenty plain Newton steps."""
    u, v = pixels.T
    x, y = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    with np.errstate(all="ignore"):
        for _ in range(20):
            pu, pv, u_x, u_y, v_x, v_y = _image.py_func(lens, x, y)
            det = u_x * v_y - u_y * v_x
            x = x + (v_y * (u - pu) - u_y * (v - pv)) / det
            y = y + (u_x * (v - pv) - v_x * (u - pu)) / det
        pu, pv, *_ = _image.py_func(lens, x, y)
        reached = (np.abs(pu - u) + np.abs(pv - v) < _NEAR_PX) & (x * x + y * y < lens[25])
    return np.where(reached, (x, y), np.nan).T


def triangulate_plain(
    directions: Array,
    projector: Array,
    rotation: Array,
    translation: Array,
    measured: Array,
    sigma: Array,
) -> tuple[Array, Array, Array]:
    """Twin of `triangulate_row`: depth, its σ, signed epipolar distance by thirty plain Newton steps.

    Parameters
    ----------
    directions
        (n, 2) camera rays.
    projector, rotation, translation
        The rig.
    measured, sigma
        (2, n) projector x and y and their σ, px; σ = inf for an axis that was not measured.

    Returns
    -------
    z, sigma_z, epipolar
        (n,) mm, mm, px; NaN where there is no solution.
    """
    a = rotation @ np.column_stack((directions, np.ones(len(directions)))).T
    t = translation[:, None]
    weight = sigma**-2.0
    normal = (measured - projector[2:4, None]) / projector[:2, None]
    slope = (t[:2] - normal * t[2]) * projector[:2, None]
    offset = (normal * a[2] - a[:2]) * projector[:2, None]
    with np.errstate(all="ignore"):
        w = (weight * slope * offset).sum(0) / (weight * slope * slope).sum(0)
        for _ in range(30):
            q = a[2] + w * t[2]
            xn, yn = (a[:2] + w * t[:2]) / q
            u, v, u_x, u_y, v_x, v_y = _image.py_func(projector, xn, yn)
            x_w, y_w = (t[0] - xn * t[2]) / q, (t[1] - yn * t[2]) / q
            tangent = np.array([u_x * x_w + u_y * y_w, v_x * x_w + v_y * y_w])
            residual = measured - (u, v)
            information = (weight * tangent**2).sum(0)
            step = (weight * tangent * residual).sum(0) / information
            w = w + step
        length = np.hypot(*tangent)
        solved = (w > 0) & (q > 0) & (xn**2 + yn**2 < projector[25]) & (np.abs(step) * length < _NEAR_PX)
        epipolar = (residual[0] * tangent[1] - residual[1] * tangent[0]) / length
        return (
            np.where(solved, 1 / w, np.nan),
            np.where(solved, w**-2.0 * information**-0.5, np.nan),
            np.where(solved, epipolar, np.nan),
        )
