"""Sparse matrices of light, and the compiled loops that fill them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

Floats = NDArray[np.float32]
_Part = TypeVar("_Part")
_Result = TypeVar("_Result")

_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
_POOL = ThreadPoolExecutor(_CORES, thread_name_prefix="light")
_ROWS_AT_ONCE = 100_000
_LEAST_BRDF = 1e-6


def in_parallel(work: Callable[[_Part], _Result], parts: Iterable[_Part]) -> Iterator[_Result]:
    """``work`` over ``parts`` on all cores, results in the order of the parts."""
    return _POOL.map(work, parts)


@dataclass(frozen=True, eq=False)
class SparseRows:
    """A float32 matrix in compressed rows.

    Parameters
    ----------
    start
        (rows + 1,) int64, where each row begins in the other two.
    column
        (nonzeros,) int32.
    value
        (nonzeros,) float32.
    """

    start: NDArray[np.int64]
    column: NDArray[np.int32]
    value: Floats

    def __matmul__(self, x: Floats) -> Floats:
        """The product with a vector (columns,) as (rows,) float32."""
        return np.concatenate(list(in_parallel(lambda block: block @ x[: block.shape[1]], self._blocks)))

    @cached_property
    def _blocks(self) -> list[Any]:
        """Views of some rows each, one for a core at a time."""
        columns = int(self.column.max(initial=0)) + 1
        blocks = []
        for first in range(0, self.start.size - 1, _ROWS_AT_ONCE):
            start = self.start[first : first + _ROWS_AT_ONCE + 1]
            a, b = start[0], start[-1]
            block = sparse.csr_array((start.size - 1, columns), dtype=np.float32)
            # Set one by one, because the constructor copies views.
            block.data, block.indices = self.value[a:b], self.column[a:b]
            block.indptr = (start - a).astype(np.int32)
            blocks.append(block)
        return blocks

    @classmethod
    def of(cls, matrix: sparse.csr_array) -> SparseRows:
        """A SciPy matrix in this form, its repeated entries added up."""
        matrix.sum_duplicates()
        return cls(matrix.indptr.astype(np.int64), matrix.indices.astype(np.int32), matrix.data.astype(np.float32))

    @classmethod
    def stacked(cls, blocks: list[SparseRows]) -> SparseRows:
        """Blocks of rows one below the other; empties the list, so that memory peaks at little over one copy."""
        counts = np.concatenate([np.diff(b.start) for b in blocks])
        start = np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))
        column, value = np.empty(start[-1], np.int32), np.empty(start[-1], np.float32)
        at = 0
        blocks.reverse()
        while blocks:
            block = blocks.pop()
            column[at : at + block.value.size] = block.column
            value[at : at + block.value.size] = block.value
            at += block.value.size
        return cls(start, column, value)


def spread_spots(
    start: NDArray[np.int64],
    path: NDArray[np.int32],
    weight: Floats,
    u: Floats,
    v: Floats,
    projector_size: tuple[int, int],
) -> SparseRows:
    """Rows of light paths become rows over the projector pixels whose spots feed them.

    A projector pixel lights a cubic B-spline spot, 4 px wide. The spots add up to one everywhere, and a fringe of
    12 px or longer keeps its phase to better than 1e-3 px, because the spline's aliases fall with the 4th power.

    Parameters
    ----------
    start
        (rows + 1,) where each row begins in ``path`` and ``weight``.
    path, weight
        (n,) which light path feeds the row, and by how much.
    u, v
        Projector coordinates of the paths, px.
    projector_size
        (width, height), px; spots outside are dark.
    """
    width, height = projector_size
    u, v = np.ascontiguousarray(u), np.ascontiguousarray(v)  # so that the kernel is compiled once
    out_start, column, value = _spread(start, path, weight, u, v, width, height)
    # A copy, because the kernel's buffers are as long as the rows could have become.
    return SparseRows(out_start, column[: out_start[-1]].copy(), value[: out_start[-1]].copy())


@njit(cache=True, nogil=True)
def _spread(start, path, weight, u, v, width, height):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    rows = start.size - 1
    out_start = np.zeros(rows + 1, np.int64)
    column = np.empty(16 * weight.size, np.int32)
    value = np.empty(16 * weight.size, np.float32)
    # Gustavson's sparse accumulator: where a column stands in the output, valid if not before the row's beginning.
    place = np.full(width * height, -1, np.int64)
    wx, wy = np.empty(4, np.float32), np.empty(4, np.float32)
    end = 0
    for row in range(rows):
        begin = end
        for k in range(start[row], start[row + 1]):
            p = path[k]
            if weight[k] == 0:
                continue
            iu, iv = int(np.floor(u[p])), int(np.floor(v[p]))
            _spline(u[p] - iu, wx)
            _spline(v[p] - iv, wy)
            for j in range(4):
                y = iv - 1 + j
                if y < 0 or y >= height:
                    continue
                for i in range(4):
                    x = iu - 1 + i
                    if x < 0 or x >= width:
                        continue
                    c = y * width + x
                    at = place[c]
                    w = weight[k] * wx[i] * wy[j]
                    if at >= begin:
                        value[at] += w
                    else:
                        place[c] = end
                        column[end] = c
                        value[end] = w
                        end += 1
        out_start[row + 1] = end
    return out_start, column, value


@njit(inline="always")
def _spline(t, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    s = 1 - t
    out[0] = s * s * s / 6
    out[1] = (3 * t * t * t - 6 * t * t + 4) / 6
    out[2] = (3 * s * s * s - 6 * s * s + 4) / 6
    out[3] = t * t * t / 6


@njit(cache=True, nogil=True)
def meet(shapes, surface, origin, direction):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Exact points (n, 3) and normals (n, 3) towards the origin where rays meet the surfaces they are known to meet.

    ``shapes`` (surfaces, 12) as `sim_backend.surfaces.shape_of`, ``surface`` (n,) with -1 for a miss, which gives NaN,
    ``origin`` and ``direction`` (n, 3).
    """
    point, normal = np.full(direction.shape, np.nan), np.full(direction.shape, np.nan)
    for i in range(surface.size):
        if surface[i] < 0:
            continue
        shape = shapes[surface[i]]
        ox, oy, oz = origin[i, 0] - shape[0], origin[i, 1] - shape[1], origin[i, 2] - shape[2]
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        radius = shape[3]
        if radius > 0:
            a, b = dx * dx + dy * dy + dz * dz, dx * ox + dy * oy + dz * oz
            root = np.sqrt(max(0.0, b * b - a * (ox * ox + oy * oy + oz * oz - radius * radius)))
            t = (-b - root) / a
            if t <= 0:
                t = (-b + root) / a
            nx, ny, nz = (ox + t * dx) / radius, (oy + t * dy) / radius, (oz + t * dz) / radius
        else:
            nx, ny, nz = shape[4], shape[5], shape[6]
            above, rise = ox * nx + oy * ny + oz * nz, dx * nx + dy * ny + dz * nz
            t = -above / rise
            if shape[7] != 0:
                ax, ay, az = shape[8], shape[9], shape[10]
                x, run = ox * ax + oy * ay + oz * az, dx * ax + dy * ay + dz * az
                t = _parabola(shape[7], shape[11], x, run, above, rise)
                slope = 2 * shape[7] * (x + t * run)
                length = math.sqrt(1 + slope * slope)
                nx, ny, nz = (nx - slope * ax) / length, (ny - slope * ay) / length, (nz - slope * az) / length
        side = -1.0 if dx * nx + dy * ny + dz * nz > 0 else 1.0
        point[i, 0], point[i, 1], point[i, 2] = origin[i, 0] + t * dx, origin[i, 1] + t * dy, origin[i, 2] + t * dz
        normal[i, 0], normal[i, 1], normal[i, 2] = side * nx, side * ny, side * nz
    return point, normal


@njit(inline="always")
def _parabola(curvature, half_width, x, run, z, rise):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Where on the ray (x + t run, z + t rise) z = curvature x², within ``half_width`` if it is anywhere."""
    a, b, c = curvature * run * run, 2 * curvature * x * run - rise, curvature * x * x - z
    q = -0.5 * (b + math.copysign(math.sqrt(max(0.0, b * b - 4 * a * c)), b))
    # The first is that of the plane, but for the curvature; the second lies far off, unless the ray grazes the sheet.
    t = c / q
    if a != 0:
        other = q / a
        if other > 0 and abs(x + other * run) <= half_width and (t <= 0 or other < t or abs(x + t * run) > half_width):
            t = other
    return t


@njit(cache=True, nogil=True)
def pixel_density(grid, step, size, centre, axis, px, point, normal):  # type: ignore[no-untyped-def]  # pragma: no cover
    """See `sim_backend.viewpoint.Viewpoint.density`; ``axis`` (3,) is the lens's direction of view."""
    density = np.zeros(len(px))
    for i in range(len(px)):
        x, y = px[i, 0], px[i, 1]
        # Two pixels round the picture are as far as a spot reaches; NaN fails the comparison.
        if not (-2 < x < size[0] + 1 and -2 < y < size[1] + 1):
            continue
        lx, ly, lz = centre[0] - point[i, 0], centre[1] - point[i, 1], centre[2] - point[i, 2]
        z = -(lx * axis[0] + ly * axis[1] + lz * axis[2])
        facing = lx * normal[i, 0] + ly * normal[i, 1] + lz * normal[i, 2]
        if facing > 0 and z > 0:
            column = min(max(int(x / step + 0.5), 0), grid.shape[1] - 1)
            row = min(max(int(y / step + 0.5), 0), grid.shape[0] - 1)
            # cos θ of the surface times r / z³: inverse square law, and the slant of the picture plane to the ray.
            density[i] = grid[row, column] * facing / z**3
    return density


@njit(cache=True, nogil=True)
def reflected_radiance(materials, diffuse, surface, light, point, normal, to_eye, irradiance):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Radiance (n,) towards the eye that irradiance (n,) from ``light`` (3,) causes; see `sim_backend.reflection`.

    ``materials`` (surfaces, 3): diffuse and specular share, concentration of the lobe (inf for a perfect mirror, whose
    lobe no finite light hits); ``diffuse`` (n,) the diffuse share at the very points.
    """
    radiance = np.zeros(len(irradiance))
    for i in range(len(irradiance)):
        if irradiance[i] <= 0 or surface[i] < 0:
            continue
        _, specular, concentration = materials[surface[i]]
        value = diffuse[i] / math.pi
        if specular > 0 and concentration < math.inf:
            lx, ly, lz = light[0] - point[i, 0], light[1] - point[i, 1], light[2] - point[i, 2]
            length = math.sqrt(lx * lx + ly * ly + lz * lz)
            nx, ny, nz = normal[i]
            ex, ey, ez = to_eye[i]
            cos_in = (lx * nx + ly * ny + lz * nz) / length
            cos_out = ex * nx + ey * ny + ez * nz
            cos_lobe = 2 * cos_in * cos_out - (lx * ex + ly * ey + lz * ez) / length
            peak = concentration / (2 * math.pi * -math.expm1(-2 * concentration))
            value += specular * peak * math.exp(concentration * (cos_lobe - 1)) / max(cos_in, cos_out)
        if value > _LEAST_BRDF:  # a lobe fades out and never ends
            radiance[i] = irradiance[i] * value
    return radiance
