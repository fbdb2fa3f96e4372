"""Light transport of a scene as sparse matrices, so that the light of any projected picture is a few products.

A projector pixel that is fully on sends out a flux of 1; the camera pixel's value is the mean radiance it sees.

- direct light: rays from the camera, `sim_backend.camera_paths`;
- sharp bounces, over mirrors: photons from the projector, splatted one by one into the camera's pixels, and rays from
  the camera into mirrors;
- broad bounces, over rough lobes and matt surfaces: photons as well, but gathered from blocks of projector pixels into
  cells of camera pixels as coarse as the lobe is broad, cells of one surface apart from those of another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scanner.rig import Rig
from sim_backend.camera_paths import Joinable, Paths, View, trace_camera
from sim_backend.kernels import Floats, SparseRows, in_parallel, spread_spots
from sim_backend.projector_paths import Photons, emit, follow
from sim_backend.raycasting import MISS, RayCaster
from sim_backend.settings import TransportSettings
from sim_backend.surfaces import Array, Surface
from sim_backend.viewpoint import Viewpoint, bilinear_shares

_PIXELS_AT_ONCE = 40_000
_PATHS_AT_ONCE = 50_000
_SHARP_PX = 0.5
"""Lobes that spread light by less than this on the camera's picture are splatted photon by photon."""
_LEAST_MASS = 0.05
"""Cells that hold less of a surface than this share get no more radiance than such a share would."""


@dataclass(frozen=True, eq=False)
class BroadBounce:
    """Bounced light too smooth to need single pixels.

    Parameters
    ----------
    diffuse
        Whether a diffuse reflection takes part, or lobes only.
    block_px
        Width of a projector block, px.
    cell_px
        Distance of the camera cells, px.
    surface
        Number of the surface that the cells lie on.
    cell
        (m,) int32 the cells that get any light, counted row by row.
    exchange
        (m, blocks) radiance of a cell for the mean value of a block.
    """

    diffuse: bool
    block_px: int
    cell_px: int
    surface: int
    cell: NDArray[np.int32]
    exchange: SparseRows

    def add_to(self, light: Floats, light_out: Floats, view: View) -> None:
        """Add to ``light`` (height, width) what the projected ``light_out`` (height, width) brings about."""
        cells = np.zeros(_coarse(light.shape, self.cell_px), np.float32)
        cells.flat[self.cell] = self.exchange @ _block_means(light_out, self.block_px).ravel()
        height, width = light.shape
        size = cells.shape[1] * self.cell_px, cells.shape[0] * self.cell_px
        fine = cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        np.add(light, fine, out=light, where=view.surface == self.surface)


@dataclass(frozen=True, eq=False)
class Transport:
    """All the light that goes from projector pixels to camera pixels.

    Parameters
    ----------
    projector_size
        (width, height), px.
    view
        What the pixel centres see.
    direct, sharp
        (camera pixels, projector pixels) direct light, and bounces over mirrors.
    broad
        Smooth bounces.
    seen_in_mirror
        (camera pixels, camera pixels) how bounced light is seen once more in mirrors.
    """

    projector_size: tuple[int, int]
    view: View
    direct: SparseRows
    sharp: SparseRows
    broad: tuple[BroadBounce, ...]
    seen_in_mirror: SparseRows

    def direct_light(self, light_out: Floats) -> Floats:
        """(height, width) radiance of direct light for what the projector sends out, (height, width) in 0..1."""
        return (self.direct @ light_out.ravel()).reshape(self.view.surface.shape)

    def bounced_light(self, light_out: Floats, *, diffuse: bool = True) -> Floats:
        """(height, width) radiance of light that took more than one reflection; without diffuse ones if so asked."""
        light = (self.sharp @ light_out.ravel()).reshape(self.view.surface.shape)
        for bounce in self.broad:
            if diffuse or not bounce.diffuse:
                bounce.add_to(light, light_out, self.view)
        if self.seen_in_mirror.value.size:
            light += (self.seen_in_mirror @ light.ravel()).reshape(light.shape)
        return light

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The same as named arrays, for a file."""
        arrays = {"projector_size": np.array(self.projector_size)}
        arrays |= {f"view.{f.name}": getattr(self.view, f.name) for f in fields(View)}
        for name in ("direct", "sharp", "seen_in_mirror"):
            arrays |= _matrix_arrays(name, getattr(self, name))
        for number, bounce in enumerate(self.broad):
            scalars = [bounce.diffuse, bounce.block_px, bounce.cell_px, bounce.surface]
            arrays |= {f"broad.{number}.scalars": np.array(scalars), f"broad.{number}.cell": bounce.cell}
            arrays |= _matrix_arrays(f"broad.{number}", bounce.exchange)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Transport:
        """Inverse of `to_arrays`."""
        width, height = (int(n) for n in arrays["projector_size"])
        broad = []
        while f"broad.{len(broad)}.cell" in arrays:
            name = f"broad.{len(broad)}"
            diffuse, block, cell, surface = (int(n) for n in arrays[f"{name}.scalars"])
            broad.append(
                BroadBounce(bool(diffuse), block, cell, surface, arrays[f"{name}.cell"], _matrix(name, arrays))
            )
        return cls(
            (width, height),
            View(**{f.name: arrays[f"view.{f.name}"] for f in fields(View)}),
            _matrix("direct", arrays),
            _matrix("sharp", arrays),
            tuple(broad),
            _matrix("seen_in_mirror", arrays),
        )


def trace(surfaces: Sequence[Surface], rig: Rig, settings: TransportSettings) -> Transport:
    """Trace all light of a scene; deterministic."""
    caster, camera, projector = RayCaster(surfaces), Viewpoint.camera(rig), Viewpoint.projector(rig)
    seen = trace_camera(caster, camera, projector, settings.supersample, settings.specular_bounces)
    bounces = _Bounces(caster, camera, projector, seen.view)
    sharp: list[Paths] = [seen.by_mirror]
    broad: list[BroadBounce] = []
    lit = _first_surfaces(caster, projector)
    for number, surface in enumerate(surfaces):
        if surface.material.specular:
            found = bounces.trace(lit == number, number, settings.photons, settings.specular_bounces)
            spread = float(np.median(found.lobe_px)) if found.lobe_px.size else 0.0
            if spread < _SHARP_PX:
                sharp.append(bounces.splatted(found))
            else:
                # Blocks and cells of half the lobe's breadth widen it by a few per cent only.
                coarse = 2 ** max(0, math.floor(math.log2(spread / 2)))
                broad += bounces.gathered(found, coarse, coarse, diffuse=False)
    if any(surface.material.diffuse for surface in surfaces):
        found = bounces.trace(lit != MISS, None, settings.photons, settings.diffuse_bounces)
        block, cell = max(1, rig.projector.size[0] // 40), max(1, rig.camera.size[0] // 64)
        broad += bounces.gathered(found, block, cell, diffuse=True)
    return Transport(
        rig.projector.size,
        seen.view,
        seen.direct,
        _spread_over_projector(Paths.joined(sharp), seen.view.surface.size, rig.projector.size),
        tuple(broad),
        seen.seen_in_mirror,
    )


def _first_surfaces(caster: RayCaster, projector: Viewpoint) -> NDArray[np.int8]:
    """(height, width) number of the surface that each projector pixel's centre lights, −1 for none."""
    width, height = projector.lens.size
    rows = max(1, _PATHS_AT_ONCE // width)

    def block(first: int) -> NDArray[np.int8]:
        y, x = np.mgrid[first : min(first + rows, height), :width].astype(np.float64)
        direction = projector.rays(np.stack((x, y), -1).reshape(-1, 2))
        return caster.first_hits(projector.centre, direction).surface.astype(np.int8).reshape(x.shape)

    return np.concatenate(list(in_parallel(block, range(0, height, rows))))


@dataclass(frozen=True, eq=False)
class _Arrivals(Joinable):
    """Photons on matt surfaces that the camera sees: where from, where in its picture, how bright, how far spread."""

    u: Floats
    v: Floats
    x: Floats
    y: Floats
    weight: Floats
    lobe_px: Floats
    surface: NDArray[np.int16]

    @classmethod
    def none(cls) -> Self:
        """No photons."""
        nothing = np.empty(0, np.float32)
        return cls(nothing, nothing, nothing, nothing, nothing, nothing, np.empty(0, np.int16))


@dataclass(frozen=True, eq=False)
class _Bounces:
    caster: RayCaster
    camera: Viewpoint
    projector: Viewpoint
    view: View

    def trace(self, lit: NDArray[np.bool_], surface: int | None, photons: int, bounces: int) -> _Arrivals:
        """Follow about ``photons`` photons that start from the projector pixels ``lit`` and see where they end.

        Parameters
        ----------
        lit
            (height, width) bool of the projector. Each pixel sends out at least one photon, and as many as there are
            squares in the finest grid on it that the number of photons allows.
        surface
            Number of the surface that has to be met first, and bounces over mirrors and lobes; None for any surface,
            and bounces with a diffuse reflection.
        photons, bounces
            How many photons, and how many reflections at most.
        """
        # One pixel more all round, because the picture of an edge falls between pixel centres.
        row, column = np.nonzero(cv2.dilate(lit.astype(np.uint8), np.ones((3, 3), np.uint8)))
        squares = max(1, math.isqrt(photons // max(1, row.size)))
        at_once = max(1, _PATHS_AT_ONCE // squares**2)

        def batch(first: int) -> _Arrivals:
            random = np.random.default_rng(first)
            here = np.stack((column, row), 1)[first : first + at_once, None] + _grid(squares)
            if surface is None:
                # Off the regular grid, so that few photons per pixel make noise and no moiré.
                here += (random.random(here.shape) - 0.5) / squares
            started = emit(self.caster, self.projector, here.reshape(-1, 2), 1 / squares**2, surface)
            ends = follow(self.caster, started, random, bounces=bounces, diffuse=surface is None)
            return _Arrivals.joined([_Arrivals.none(), *(self.seen(end) for end in ends)])

        return _Arrivals.joined([_Arrivals.none(), *in_parallel(batch, range(0, row.size, at_once))])

    def seen(self, photons: Photons) -> _Arrivals:
        """What the camera sees of photons that have arrived on matt surfaces."""
        diffuse = np.array([s.material.diffuse for s in self.caster.surfaces])[photons.surface]
        xy = self.camera.project(photons.point)
        density = self.camera.density(xy, photons.point, photons.normal)
        at = np.flatnonzero((density > 0) & (diffuse > 0) & (photons.flux > 0))
        at = at[self.caster.visible(photons.point[at], photons.normal[at], self.camera.centre)]
        # Radiance of a Lambertian pixel: flux times reflectance over the area a pixel sees, over π.
        weight = photons.flux[at] * diffuse[at] * density[at] / math.pi
        lobe_px = photons.lobe_mm[at] * np.sqrt(density[at])
        u, v, x, y, bright, spread = (
            a.astype(np.float32) for a in (photons.u[at], photons.v[at], xy[at, 0], xy[at, 1], weight, lobe_px)
        )
        return _Arrivals(u, v, x, y, bright, spread, photons.surface[at])

    def splatted(self, found: _Arrivals) -> Paths:
        """Each photon shared among the four camera pixels about it."""
        pixel, share = bilinear_shares(np.stack((found.x, found.y), 1), self.camera.lens.size)
        weight = (share * found.weight[:, None]).ravel()
        return Paths(pixel.ravel(), np.repeat(found.u, 4), np.repeat(found.v, 4), weight)

    def gathered(self, found: _Arrivals, block_px: int, cell_px: int, *, diffuse: bool) -> list[BroadBounce]:
        """Photons by projector block and camera cell, one `BroadBounce` for each surface they arrived on."""
        shape = self.view.surface.shape
        grid, blocks = _coarse(shape, cell_px), _coarse(self.projector.lens.size[::-1], block_px)
        bounces = []
        for number in np.unique(found.surface):
            there = found.surface == number
            place = (np.stack((found.x, found.y), 1)[there] + 0.5) / cell_px - 0.5
            cell, share = bilinear_shares(np.clip(place, 0, np.array(grid[::-1]) - 1), grid[::-1])
            column, row = (((w[there] + 0.5) // block_px).astype(np.int64) for w in (found.u, found.v))
            block = np.clip(row, 0, blocks[0] - 1) * blocks[1] + np.clip(column, 0, blocks[1] - 1)
            # A cell's radiance is the mean over the pixels it spreads to, so that no light is lost or made.
            mass = np.maximum(_cell_mass(self.view.surface == number, cell_px).ravel(), _LEAST_MASS * cell_px**2)
            value = share * found.weight[there, None] / mass[cell]
            matrix = sparse.csr_array(
                (value.ravel(), (cell.ravel(), np.repeat(block, 4))), shape=(math.prod(grid), math.prod(blocks))
            )
            used = np.flatnonzero(np.diff(matrix.indptr))
            bounces.append(
                BroadBounce(diffuse, block_px, cell_px, int(number), used.astype(np.int32), SparseRows.of(matrix[used]))
            )
        return bounces


def _grid(squares: int) -> Array:
    """(squares², 2) middles of the squares of a grid on a pixel, relative to the pixel's centre."""
    offset = (np.arange(squares) + 0.5) / squares - 0.5
    return np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)


def _coarse(shape: tuple[int, ...], step: int) -> tuple[int, int]:
    """(rows, columns) of a grid with ``step`` px that covers a picture (height, width)."""
    return -(-shape[0] // step), -(-shape[1] // step)


def _block_means(picture: Floats, step: int) -> Floats:
    """Means over blocks of a picture (height, width); blocks over the edge repeat it."""
    rows, columns = _coarse(picture.shape, step)
    missing = rows * step - picture.shape[0], columns * step - picture.shape[1]
    whole = cv2.copyMakeBorder(picture, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def _cell_mass(of_surface: NDArray[np.bool_], step: int) -> Floats:
    """(rows, columns) how many pixels of a surface each cell feeds: the adjoint of the cells' linear interpolation."""
    rows, columns = _coarse(of_surface.shape, step)
    down, across = (_interpolation(n, cells, step) for n, cells in zip(of_surface.shape, (rows, columns), strict=True))
    return np.asarray(down.T @ (across.T @ of_surface.T.astype(np.float32)).T, np.float32)


def _interpolation(pixels: int, cells: int, step: int) -> sparse.csr_array:
    """(pixels, cells) linear interpolation along one axis between cell centres, constant beyond the outermost."""
    place = np.clip((np.arange(pixels) + 0.5) / step - 0.5, 0, cells - 1)
    lower = np.minimum(place.astype(np.intp), max(cells - 2, 0))
    upper = np.minimum(lower + 1, cells - 1)
    share = (place - lower).astype(np.float32)
    pixel = np.arange(pixels)
    entries = np.concatenate((1 - share, share)), (np.tile(pixel, 2), np.concatenate((lower, upper)))
    return sparse.csr_array(entries, shape=(pixels, cells))


def _spread_over_projector(paths: Paths, pixels: int, projector_size: tuple[int, int]) -> SparseRows:
    """(pixels, projector pixels) the matrix of light paths."""
    number = np.arange(paths.pixel.size, dtype=np.int32)
    by_pixel = sparse.csr_array((paths.weight, (paths.pixel, number)), shape=(pixels, max(1, number.size)))
    start = by_pixel.indptr.astype(np.int64)
    ends = np.searchsorted(start, np.arange(_PATHS_AT_ONCE, start[-1] + _PATHS_AT_ONCE, _PATHS_AT_ONCE))
    cuts = np.unique(np.concatenate(([0], np.minimum(ends, pixels), [pixels])))

    def block(begin: int, end: int) -> SparseRows:
        a, b = start[begin], start[end]
        path, weight = by_pixel.indices[a:b].astype(np.int32), by_pixel.data[a:b]
        return spread_spots(start[begin : end + 1] - a, path, weight, paths.u, paths.v, projector_size)

    return SparseRows.stacked(list(in_parallel(lambda cut: block(*cut), itertools.pairwise(cuts.tolist()))))


def _matrix_arrays(name: str, matrix: SparseRows) -> dict[str, NDArray[Any]]:
    return {f"{name}.{f.name}": getattr(matrix, f.name) for f in fields(SparseRows)}


def _matrix(name: str, arrays: Mapping[str, NDArray[Any]]) -> SparseRows:
    return SparseRows(**{f.name: arrays[f"{name}.{f.name}"] for f in fields(SparseRows)})
