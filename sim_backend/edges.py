"""Edges in the camera's picture, and what the camera's lens makes of them.

A lens blurs what it draws before pixels sample it. Where light varies slowly, pixels may sample first and be blurred
then. At edges of prints and of surfaces that would be wrong: a pixel's square alone lets through structures that the
lens does not (aliasing), and a blur among pixels cannot tell them from coarser ones. So near edges a pixel's light is
the mean over a finer grid, weighted by square and Gaussian together; what is kept is its difference from the light of
pixels that were blurred afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from sim_backend.blur import blurred_within_more, gaussian
from sim_backend.camera_paths import CameraRays, View, square_grid
from sim_backend.kernels import Floats, SparseRows, in_parallel, spread_spots
from sim_backend.raycasting import Hits
from sim_backend.surfaces import Array

WIDEST_PX = 1.0
"""Standard deviation of the blur that is done here: less than 1 % of what no pixel resolves passes it."""

_GRAINS = 6
"""Of the finer grid, per pixel along each axis. A print's edge comes out within 0.2 % of its step."""
_MOST_GRAINS = 12
_PIXELS_AT_ONCE = 50_000
_NEGLIGIBLE = 1e-6
_PRINTED = 1e-3


@dataclass(frozen=True, eq=False)
class LensEdges:
    """What pixels near edges get more, or less, than blurring after sampling gives them.

    Parameters
    ----------
    blur_px
        Standard deviation of the Gaussian that is allowed for, px; wider blurs do the rest after sampling.
    pixel
        (m,) int32 the pixels, counted row by row.
    rows
        (m, projector pixels) the difference of their radiance.
    """

    blur_px: float
    pixel: NDArray[np.int32]
    rows: SparseRows

    @classmethod
    def none(cls) -> LensEdges:
        """No edges, or no blur."""
        nothing = SparseRows(np.zeros(1, np.int64), np.empty(0, np.int32), np.empty(0, np.float32))
        return cls(0.0, np.empty(0, np.int32), nothing)

    def add_to(self, picture: Floats, light_out: Floats, blur_px: float) -> None:
        """Correct ``picture`` (height, width), blurred by ``blur_px``, for the projected ``light_out``."""
        if not self.pixel.size:
            return
        difference = self.rows @ light_out.ravel()
        rest = math.sqrt(max(0.0, blur_px**2 - self.blur_px**2))
        if rest < _NEGLIGIBLE:
            picture.flat[self.pixel] += difference
            return
        spread = np.zeros_like(picture)
        spread.flat[self.pixel] = difference
        picture += blurred_within_more(spread, rest)


def mixing(view: View, focal_px: float) -> NDArray[np.bool_]:
    """(height, width) pixels that mix surfaces, depths, or light and shadow, or whose neighbours differ in these."""
    mixed = view.mixed | _changes(view.surface) | _changes(np.isfinite(view.x_p))
    return np.asarray(mixed | _jumps(view.depth, focal_px))


def lens_edges(rays: CameraRays, view: View, direct: SparseRows, blur_px: float) -> LensEdges:
    """What the lens makes of edges in direct light.

    Parameters
    ----------
    rays
        The camera's.
    view
        What its pixels' centres meet.
    direct
        (camera pixels, projector pixels) direct light of the pixels' own squares.
    blur_px
        Standard deviation of the lens's blur, camera px.

    Returns
    -------
    For pixels whose light comes from anywhere near an edge. Those nearer to the picture's border than the blur reaches
    are left as they are.
    """
    blur_px = min(blur_px, WIDEST_PX)
    if blur_px == 0:
        return LensEdges.none()
    lens = _Lens.of(blur_px, rays.supersample)
    edges = mixing(view, float(rays.camera.lens.matrix[0, 0])) | _prints(view)
    height, width = edges.shape
    near = _dilated(edges, lens.reach)
    inner = np.zeros_like(near)
    inner[lens.reach : height - lens.reach, lens.reach : width - lens.reach] = True
    near &= inner
    at_once = max(1, _PIXELS_AT_ONCE // width)
    blocks = [(first, min(first + at_once, height)) for first in range(0, height, at_once)]
    rows = list(in_parallel(lambda block: _difference(rays, lens, near, direct, *block), blocks))
    return LensEdges(blur_px, np.flatnonzero(near).astype(np.int32), SparseRows.stacked(rows))


@dataclass(frozen=True, eq=False)
class _Lens:
    """Weights of the light around a pixel: of the finer grid's grains, and of pixels that are blurred after sampling.

    Parameters
    ----------
    reach
        How far it comes from, px.
    rays
        (rays, 3) by rows and columns which pixel's, and which of its rays.
    grains
        (rays, grains of a ray) the pixel's square and the Gaussian, at the middle of the grain.
    pixels
        (2 reach + 1,) along rows and columns alike.
    """

    reach: int
    rays: NDArray[np.int64]
    grains: Array
    pixels: Array

    @classmethod
    def of(cls, blur_px: float, supersample: int) -> _Lens:
        per_ray = math.ceil(min(max(_GRAINS, 1 / blur_px), _MOST_GRAINS) / supersample)
        per_pixel = supersample * per_ray
        pixels = gaussian(blur_px).astype(np.float64)
        reach = pixels.size // 2
        # Sampled as finely as that, unlike by pixels, a Gaussian keeps its shape.
        place = np.arange(-reach * per_pixel, reach * per_pixel + 1) / (blur_px * per_pixel)
        bell = np.exp(-(place**2) / 2)
        line = np.convolve(np.full(per_pixel, 1 / per_pixel), bell / bell.sum())
        line = line.reshape(pixels.size, supersample, per_ray)
        weights = np.einsum("psg,qth->pqstgh", line, line).reshape(pixels.size**2, supersample**2, per_ray**2)
        pixel, ray = np.nonzero(weights.sum(2) > _NEGLIGIBLE)
        rays = np.stack((*(np.array(np.divmod(pixel, pixels.size)) - reach), ray), 1)
        return cls(reach, rays, weights[pixel, ray] / weights[pixel, ray].sum(), pixels)


def _difference(
    camera: CameraRays, lens: _Lens, near: NDArray[np.bool_], direct: SparseRows, begin: int, end: int
) -> SparseRows:
    """(pixels near edges in rows ``begin`` to ``end``, projector pixels) light by the finer grid, less by pixels."""
    top, bottom = max(0, begin - lens.reach), min(len(near), end + lens.reach)
    width, projector_size = near.shape[1], camera.projector.lens.size
    projector_pixels = projector_size[0] * projector_size[1]
    here = np.zeros((bottom - top, width), bool)
    here[begin - top : end - top] = near[begin:end]
    y, x = np.nonzero(here)
    if y.size == 0:
        return SparseRows(np.zeros(1, np.int64), np.empty(0, np.int32), np.empty(0, np.float32))

    source_y, source_x = np.nonzero(_dilated(here, lens.reach))
    number = np.full(here.shape, -1)
    number[source_y, source_x] = np.arange(source_y.size)
    hits, direction, sides = camera.samples(source_x.astype(np.float64), (source_y + top).astype(np.float64))
    uv, radiance = camera.lit(hits, -direction, camera.caster.unprinted(hits))
    u, v = np.nan_to_num(uv).astype(np.float32).T
    each = np.arange(len(hits.surface) + 1)
    spots = spread_spots(each, each[:-1].astype(np.int32), radiance.astype(np.float32), u, v, projector_size)

    dy, dx, ray = lens.rays.T
    column = number[y[:, None] + dy, x[:, None] + dx] * camera.supersample**2 + ray
    share = _seen(lens.grains, column, _grain_shares(camera, lens, hits, sides))
    shape = len(y), len(hits.surface)
    fine = _rows_of(share, column, shape) @ _matrix(spots, (shape[1], projector_pixels))

    offset = np.arange(-lens.reach, lens.reach + 1)
    column = ((y[:, None, None] + offset[:, None]) * width + x[:, None, None] + offset).reshape(len(y), -1)
    share = np.broadcast_to(np.outer(lens.pixels, lens.pixels).ravel(), column.shape)
    start = direct.start[top * width : bottom * width + 1]
    a, b = start[0], start[-1]
    by_pixels = SparseRows(start - a, direct.column[a:b], direct.value[a:b])
    shape = len(y), here.size
    difference = fine - _rows_of(share, column, shape) @ _matrix(by_pixels, (shape[1], projector_pixels))
    difference.data[np.abs(difference.data) < _NEGLIGIBLE * radiance.max(initial=0)] = 0
    difference.eliminate_zeros()
    return SparseRows.of(difference)


def _grain_shares(camera: CameraRays, lens: _Lens, hits: Hits, sides: Array | None) -> Floats:
    """(rays, grains) of the light what the print leaves at each grain of the rays; (1, 1) one where there is none."""
    if sides is None:
        return np.ones((1, 1), np.float32)
    per_ray = math.isqrt(lens.grains.shape[1])
    shares = np.ones((len(hits.surface), per_ray**2), np.float32)
    whole = camera.caster.diffuse(hits, sides)
    for surface, sheet in camera.caster.sheets.items():
        if not sheet.light:
            continue
        on_sheet = hits.surface == surface
        shares[on_sheet] = (whole[on_sheet] / sheet.light)[:, None]
        # The grains of a ray differ where it sees the edge of a figure.
        is_even = np.isclose(whole, sheet.light) | np.isclose(whole, sheet.dark)
        at = np.flatnonzero(on_sheet & ~is_even)
        for grain, (right, down) in enumerate(square_grid(per_ray)):
            place = hits.point[at] + right * sides[at, 0] + down * sides[at, 1]
            shares[at, grain] = sheet.reflectance(place, sides[at] / per_ray) / sheet.light
    return shares


@njit(cache=True, nogil=True)
def _seen(grains, column, shares):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """(pixels, rays) how much of each ray's light a pixel gets; ``shares`` (1, 1) holds for all."""
    seen = np.empty(column.shape, np.float32)
    all_alike = shares.size == 1
    for i in range(column.shape[0]):
        for k in range(column.shape[1]):
            total = 0.0
            for grain in range(grains.shape[1]):
                total += grains[k, grain] * (shares[0, 0] if all_alike else shares[column[i, k], grain])
            seen[i, k] = total
    return seen


def _rows_of(value: Floats, column: NDArray[np.int64], shape: tuple[int, int]) -> sparse.csr_array:
    """A matrix whose rows have equally many values (rows, m) in their columns (rows, m)."""
    start = np.arange(0, value.size + 1, value.shape[1], dtype=np.int32)
    return sparse.csr_array((np.ravel(value).astype(np.float32), np.ravel(column).astype(np.int32), start), shape=shape)


def _matrix(rows: SparseRows, shape: tuple[int, int]) -> sparse.csr_array:
    return sparse.csr_array((rows.value, rows.column, rows.start.astype(np.int32)), shape=shape)


def _prints(view: View) -> NDArray[np.bool_]:
    """(height, width) pixels beside which a print changes."""
    gain, box = view.print_gain, np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(gain, box) - cv2.erode(gain, box) > _PRINTED)


def _jumps(depth: Floats, focal_px: float) -> NDArray[np.bool_]:
    """Pixels beside which the depth jumps by more than two pixels are wide there.

    On planes the inverse of the depth is linear in the picture, so that its second difference vanishes.
    """
    near = 1 / depth.astype(np.float64)
    jumps = np.zeros(depth.shape, bool)
    for along, flags in ((near, jumps), (near.T, jumps.T)):
        flags[1:-1] |= np.abs(along[2:] - 2 * along[1:-1] + along[:-2]) > 2 / focal_px * along[1:-1]
    return jumps


def _changes(labels: NDArray[np.int8] | NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose label differs from that of a neighbour."""
    picture = (labels.astype(np.int16) + 1).astype(np.uint8)
    box = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(picture, box) != cv2.erode(picture, box))


def _dilated(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)), bool)
