"""Light transport of a scene as sparse matrices, so that the light of any projected picture is a few products.

A projector pixel that is fully on sends out a flux of 1; the camera pixel's value is the mean radiance it sees.

- direct light: rays from the camera, `sim_backend.camera_paths`;
- light seen in mirrors: rays from the camera as well;
- bounces: photons from the projector, `sim_backend.projector_paths`, gathered in cells of the camera's picture, cells
  of one surface apart from those of another. Light that comes over mirrors keeps the projector's single pixels apart;
  for lobes and diffuse reflections blocks of projector pixels suffice, and cells as coarse as the lobe is broad.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scanner.rig import Rig
from sim_backend.camera_paths import CameraRays, Paths, View, square_grid, trace_camera
from sim_backend.columns import Columns
from sim_backend.edges import LensEdges, lens_edges
from sim_backend.kernels import Floats, SparseRows, in_parallel, spread_spots
from sim_backend.projector_paths import Photons, emit, follow
from sim_backend.raycasting import MISS, RayCaster
from sim_backend.settings import TransportSettings
from sim_backend.surfaces import Array, Material, Surface
from sim_backend.viewpoint import Viewpoint, bilinear_shares

_PATHS_AT_ONCE = 50_000
_PILOT_PHOTONS = 20_000
_SPACING = 0.6
"""Photons at most this far apart, in cells, leave ripples of a few per cent."""
_LEAST_LOBE_PX = 0.5
"""Lobes that spread light by less than this on the camera's picture are traced as mirrors."""
_LEAST_MASS = 0.05
"""Cells that hold less of a surface than this share get no more radiance than such a share would."""


@dataclass(frozen=True, eq=False)
class Bounce:
    """Bounced light that arrives on one surface.

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
        np.add(light, fine * view.print_gain, out=light, where=view.surface == self.surface)


@dataclass(frozen=True)
class Spread:
    """How light wanders within the material of a surface before it leaves.

    Parameters
    ----------
    surface
        Number of the surface.
    share
        Part of its light that does.
    sigma_px
        Standard deviation of how far, along the rows and the columns of the camera's picture, px.
    """

    surface: int
    share: float
    sigma_px: tuple[float, float]

    def of(self, light: Floats, view: View) -> Floats:
        """The ``light`` (height, width) after it has wandered; none leaves the surface's edges."""
        there = view.surface == self.surface

        def blurred(picture: Floats) -> Floats:
            x, y = self.sigma_px
            size = (0, 0)  # as wide as the standard deviations need
            return np.asarray(
                cv2.GaussianBlur(picture, size, sigmaX=x, sigmaY=y, borderType=cv2.BORDER_CONSTANT), np.float32
            )

        spread = blurred(np.where(there, light, np.float32(0))) / np.maximum(blurred(there.astype(np.float32)), 1e-6)
        return np.where(there, light + np.float32(self.share) * (spread - light), light)


@dataclass(frozen=True, eq=False)
class Transport:
    """All the light that goes from projector pixels to camera pixels.

    Parameters
    ----------
    projector_size
        (width, height), px.
    view
        What the pixel centres see.
    direct, by_mirror
        (camera pixels, projector pixels) direct light, and how it is seen in mirrors.
    bounces
        Light that a surface gets from others.
    seen_in_mirror
        (camera pixels, camera pixels) how that light is seen in mirrors.
    spreads
        Surfaces within whose material light wanders.
    edges
        What the camera's lens makes of edges in the direct light.
    """

    projector_size: tuple[int, int]
    view: View
    direct: SparseRows
    by_mirror: SparseRows
    bounces: tuple[Bounce, ...]
    seen_in_mirror: SparseRows
    spreads: tuple[Spread, ...]
    edges: LensEdges

    def direct_light(self, light_out: Floats) -> Floats:
        """(height, width) radiance of direct light for what the projector sends out, (height, width) in 0..1."""
        return self._spread((self.direct @ light_out.ravel()).reshape(self.view.surface.shape))

    def bounced_light(self, light_out: Floats, *, diffuse: bool = True) -> Floats:
        """(height, width) radiance of light that took more than one reflection; without diffuse ones if so asked."""
        light = (self.by_mirror @ light_out.ravel()).reshape(self.view.surface.shape)
        for bounce in self.bounces:
            if diffuse or not bounce.diffuse:
                bounce.add_to(light, light_out, self.view)
        light = self._spread(light)
        if self.seen_in_mirror.value.size:
            light += (self.seen_in_mirror @ light.ravel()).reshape(light.shape)
        return light

    def _spread(self, light: Floats) -> Floats:
        for spread in self.spreads:
            light = spread.of(light, self.view)
        return light

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The same as named arrays, for a file."""
        arrays = {
            "projector_size": np.array(self.projector_size),
            "spreads": np.array([(s.surface, s.share, *s.sigma_px) for s in self.spreads]).reshape(-1, 4),
        }
        arrays |= {f"view.{f.name}": getattr(self.view, f.name) for f in fields(View)}
        for name in ("direct", "by_mirror", "seen_in_mirror"):
            arrays |= _matrix_arrays(name, getattr(self, name))
        arrays |= {"edges.blur_px": np.array(self.edges.blur_px), "edges.pixel": self.edges.pixel}
        arrays |= _matrix_arrays("edges.rows", self.edges.rows)
        for number, bounce in enumerate(self.bounces):
            scalars = [bounce.diffuse, bounce.block_px, bounce.cell_px, bounce.surface]
            arrays |= {f"bounce.{number}.scalars": np.array(scalars), f"bounce.{number}.cell": bounce.cell}
            arrays |= _matrix_arrays(f"bounce.{number}", bounce.exchange)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Transport:
        """Inverse of `to_arrays`."""
        width, height = (int(n) for n in arrays["projector_size"])
        bounces: list[Bounce] = []
        while f"bounce.{len(bounces)}.cell" in arrays:
            name = f"bounce.{len(bounces)}"
            diffuse, block, cell, surface = (int(n) for n in arrays[f"{name}.scalars"])
            bounces.append(Bounce(bool(diffuse), block, cell, surface, arrays[f"{name}.cell"], _matrix(name, arrays)))
        return cls(
            (width, height),
            View(**{f.name: arrays[f"view.{f.name}"] for f in fields(View)}),
            _matrix("direct", arrays),
            _matrix("by_mirror", arrays),
            tuple(bounces),
            _matrix("seen_in_mirror", arrays),
            tuple(Spread(int(s[0]), float(s[1]), (float(s[2]), float(s[3]))) for s in arrays["spreads"]),
            LensEdges(float(arrays["edges.blur_px"]), arrays["edges.pixel"], _matrix("edges.rows", arrays)),
        )


def trace(surfaces: Sequence[Surface], rig: Rig, settings: TransportSettings, blur_px: float = 0.0) -> Transport:
    """Trace all light of a scene; deterministic.

    Parameters
    ----------
    surfaces
        Of the scene.
    rig
        Camera and projector.
    settings
        How finely.
    blur_px
        Standard deviation of the camera lens's blur, camera px, for what it makes of edges.
    """
    caster, camera, projector = RayCaster(surfaces), Viewpoint.camera(rig), Viewpoint.projector(rig)
    rays = CameraRays(caster, camera, projector, settings.supersample, settings.specular_bounces)
    seen = trace_camera(rays)
    alone = len(surfaces) == 1 and not surfaces[0].lights_itself
    bounced = [] if alone else _bounced(surfaces, _Bounces(caster, camera, projector, seen.view), settings)
    return Transport(
        rig.projector.size,
        seen.view,
        seen.direct,
        _over_pixels(seen.by_mirror, seen.view.surface.size, rig.projector.size),
        tuple(bounced),
        seen.seen_in_mirror,
        tuple(_spreads(surfaces, rig, seen.view)),
        lens_edges(rays, seen.view, seen.direct, blur_px),
    )


def _spreads(surfaces: Sequence[Surface], rig: Rig, view: View) -> Iterator[Spread]:
    """How far light wanders within the surfaces, in the camera's picture."""
    for number, material in enumerate(surface.material for surface in surfaces):
        if not (material.subsurface and material.spread_mm and (view.surface == number).any()):
            continue
        point = np.where((view.surface == number)[..., None], rig.camera.pixel_rays() * view.depth[..., None], np.nan)
        # mm from pixel to pixel along the rows and the columns, in the median, since the blur is one for all.
        steps = [np.linalg.norm(np.diff(point, axis=axis), axis=-1) for axis in (1, 0)]
        x, y = (
            material.spread_mm / float(np.median(s[np.isfinite(s)])) if np.isfinite(s).any() else 0.0 for s in steps
        )
        if x and y:
            yield Spread(number, material.subsurface, (x, y))


def _bounced(surfaces: Sequence[Surface], bounces: _Bounces, settings: TransportSettings) -> list[Bounce]:
    """The light that the surfaces throw on one another."""
    bounced: list[Bounce] = []
    lit = _first_surfaces(bounces.caster, bounces.projector)
    materials = [surface.material for surface in surfaces]
    for number, material in enumerate(materials):
        if material.specular:
            here, most = lit == number, settings.specular_bounces
            pilot = bounces.trace(materials, here, number, _PILOT_PHOTONS, most)
            if pilot.u.size:
                cell_px, block_px, lobe = bounces.resolution(pilot, here, settings.photons)
                found = bounces.trace(_with_lobe(materials, number, lobe), here, number, settings.photons, most)
                bounced += bounces.gathered(found, cell_px, block_px)
    anywhere, most = lit != MISS, settings.diffuse_bounces
    if bounces.trace(materials, anywhere, None, _PILOT_PHOTONS, most).u.size:
        found = bounces.trace(materials, anywhere, None, settings.photons, most)
        block, cell = max(1, bounces.projector.lens.size[0] // 40), max(1, bounces.camera.lens.size[0] // 64)
        bounced += bounces.gathered(found, cell, block, diffuse=True)
    return bounced


def _with_lobe(materials: Sequence[Material], number: int, factor: float) -> list[Material]:
    """The materials, but the lobe of one by ``factor`` as broad."""
    changed = list(materials)
    # The lobe's breadth goes with the square of the roughness.
    changed[number] = replace(materials[number], roughness=materials[number].roughness * math.sqrt(factor))
    return changed


def _block(cell_px: int, pixel: float) -> int:
    """Projector pixels that a cell is wide, where a projector pixel is ``pixel`` camera pixels wide."""
    return max(1, round(cell_px / max(pixel, 1e-3)))


def _photons_per_pixel(lit: NDArray[np.bool_], photons: int) -> float:
    """How many photons each of the projector pixels ``lit`` sends out: a square number, or a chance below one."""
    pixels = max(1, int(np.count_nonzero(lit)))
    return float(math.isqrt(photons // pixels) ** 2) or photons / pixels


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
class _Arrivals(Columns):
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

    def trace(
        self,
        materials: Sequence[Material],
        lit: NDArray[np.bool_],
        surface: int | None,
        photons: int,
        bounces: int,
    ) -> _Arrivals:
        """Follow about ``photons`` photons that start from the projector pixels ``lit`` and see where they end.

        Parameters
        ----------
        materials
            How the surfaces scatter, by number.
        lit
            (height, width) bool of the projector. Each pixel sends out one photon from each square of a grid, as fine
            as the number of photons allows; if there are fewer photons than pixels, lot decides.
        surface
            Number of the surface that has to be met first, and bounces over mirrors and lobes; None for any surface,
            and bounces with a diffuse reflection.
        photons, bounces
            How many photons, and how many reflections at most.
        """
        # One pixel more all round, because the picture of an edge falls between pixel centres.
        row, column = np.nonzero(cv2.dilate(lit.astype(np.uint8), np.ones((3, 3), np.uint8)))
        per_pixel = _photons_per_pixel(lit, photons)
        squares = max(1, math.isqrt(int(per_pixel)))
        chosen = np.random.default_rng(0).random(row.size) < per_pixel
        row, column = row[chosen], column[chosen]
        at_once = max(1, _PATHS_AT_ONCE // squares**2)

        def batch(first: int) -> _Arrivals:
            random = np.random.default_rng(first)
            here = np.stack((column, row), 1)[first : first + at_once, None] + square_grid(squares)
            if surface is None:
                # Off the regular grid, so that few photons per pixel make noise and no moiré.
                here += (random.random(here.shape) - 0.5) / squares
            # Each pixel takes the same even set of directions, shifted at random.
            choice = (_even_set(squares**2) + random.random((len(here), 1, 2))) % 1
            started = emit(
                self.caster,
                self.projector,
                here.reshape(-1, 2),
                1 / per_pixel,
                choice.reshape(-1, 2),
                surface,
            )
            ends = follow(self.caster, materials, started, random, bounces=bounces, diffuse=surface is None)
            return _Arrivals.joined([_Arrivals.none(), *(self.seen(end) for end in ends)])

        return _Arrivals.joined([_Arrivals.none(), *in_parallel(batch, range(0, row.size, at_once))])

    def resolution(self, pilot: _Arrivals, lit: NDArray[np.bool_], photons: int) -> tuple[int, int | None, float]:
        """How coarsely to gather the light that a surface reflects, and with what lobe to trace it.

        Wide cells and blocks keep the noise of single photons down, but spread the light themselves. So the widest
        are taken that do not do so more than the lobe, and the lobe that is traced is narrower by as much.

        Parameters
        ----------
        pilot
            Where a few photons of the pixels ``lit`` have arrived.
        lit
            (height, width) bool of the projector.
        photons
            How many there will be.

        Returns
        -------
        Width of the cells, px; width of the blocks, px, None for single pixels with their spots; the share of its
        breadth that the lobe is to have.
        """
        # From one projector pixel's light to the next one's, camera px.
        pixel = _spacing_px(pilot, self.camera.lens.size) * math.sqrt(_photons_per_pixel(lit, _PILOT_PHOTONS))
        lobe = float(np.median(pilot.lobe_px))
        if lobe < _LEAST_LOBE_PX:
            apart = pixel / math.sqrt(_photons_per_pixel(lit, photons))
            return max(1, math.ceil(apart / _SPACING)), None, 0.0

        def widened(cell: int) -> float:
            """Variance, px², beyond that of cells of one pixel (1/6 for sharing) and spots (1/3 of projector px²)."""
            sharing_and_interpolating = cell**2 / 6 * (1 if cell == 1 else 2)
            return sharing_and_interpolating - 1 / 6 + pixel**2 * (_block(cell, pixel) ** 2 / 12 - 1 / 3)

        cell = max(c for c in (1, 2, 4, 8, 16, 32) if c == 1 or widened(c) <= lobe**2)
        return cell, _block(cell, pixel), math.sqrt(max(0.0, 1 - widened(cell) / lobe**2))

    def seen(self, photons: Photons) -> _Arrivals:
        """What the camera sees of photons that have arrived on matt surfaces."""
        diffuse = np.array([s.material.diffuse for s in self.caster.surfaces])[photons.surface]
        xy = self.camera.project(photons.point)
        density = self.camera.density(xy, photons.point, photons.normal)
        with np.errstate(invalid="ignore"):
            in_picture = ((xy >= -0.5) & (xy < np.array(self.camera.lens.size) - 0.5)).all(1)
        at = np.flatnonzero(in_picture & (density > 0) & (diffuse > 0) & (photons.flux > 0))
        at = at[self.caster.visible(photons.point[at], photons.normal[at], self.camera.centre)]
        # Radiance of a Lambertian pixel: flux times reflectance over the area a pixel sees, over π.
        weight = photons.flux[at] * diffuse[at] * density[at] / math.pi
        lobe_px = photons.lobe_mm[at] * np.sqrt(density[at])
        u, v, x, y, bright, spread = (
            a.astype(np.float32) for a in (photons.u[at], photons.v[at], xy[at, 0], xy[at, 1], weight, lobe_px)
        )
        return _Arrivals(u, v, x, y, bright, spread, photons.surface[at])

    def gathered(self, found: _Arrivals, cell_px: int, block_px: int | None, *, diffuse: bool = False) -> list[Bounce]:
        """Photons by camera cell and projector block, one `Bounce` for each surface they arrived on.

        With ``block_px`` None the projector's single pixels and their spots are kept apart.
        """
        grid = _coarse(self.view.surface.shape, cell_px)
        bounces = []
        for number in np.unique(found.surface):
            there = found[found.surface == number]
            place = (np.stack((there.x, there.y), 1) + 0.5) / cell_px - 0.5
            cell, share = bilinear_shares(np.clip(place, 0, np.array(grid[::-1]) - 1), grid[::-1])
            # A cell's radiance is the mean over the pixels it spreads to, so that no light is lost or made.
            mass = np.maximum(_cell_mass(self.view.surface == number, cell_px).ravel(), _LEAST_MASS * cell_px**2)
            used, row = np.unique(cell, return_inverse=True)
            paths = Paths(
                row.ravel().astype(np.int32),
                np.repeat(there.u, 4),
                np.repeat(there.v, 4),
                (share * there.weight[:, None] / mass[cell]).ravel().astype(np.float32),
            )
            if block_px is None:
                exchange = _over_pixels(paths, used.size, self.projector.lens.size)
            else:
                exchange = _over_blocks(paths, used.size, self.projector.lens.size, block_px)
            bounces.append(Bounce(diffuse, block_px or 1, cell_px, int(number), used, exchange))
        return bounces


def _spacing_px(found: _Arrivals, camera_size: tuple[int, int]) -> float:
    """How far photons lie apart in the camera's picture, by the number of them in squares of 1/64 of its width."""
    if found.x.size == 0:
        return 0.0
    side = camera_size[0] / 64
    square = (found.y // side).astype(np.int64) * 64 + (found.x // side).astype(np.int64)
    _, which, count = np.unique(square, return_inverse=True, return_counts=True)
    return float(side / np.sqrt(np.median(count[which])))


def _even_set(count: int) -> Array:
    """(count, 2) points that fill the unit square evenly (Roberts' R₂ sequence, from the plastic number)."""
    plastic = 1.3247179572447460
    return np.asarray(np.arange(count)[:, None] * np.array([1 / plastic, 1 / plastic**2]) % 1)


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


def _over_blocks(paths: Paths, rows: int, projector_size: tuple[int, int], step: int) -> SparseRows:
    """(rows, blocks) the matrix of light paths from blocks of projector pixels."""
    down, across = _coarse(projector_size[::-1], step)
    column, row = (((w + 0.5) // step).astype(np.int64) for w in (paths.u, paths.v))
    block = np.clip(row, 0, down - 1) * across + np.clip(column, 0, across - 1)
    return SparseRows.of(sparse.csr_array((paths.weight, (paths.pixel, block)), shape=(rows, down * across)))


def _over_pixels(paths: Paths, rows: int, projector_size: tuple[int, int]) -> SparseRows:
    """(rows, projector pixels) the matrix of light paths from spots of projector pixels."""
    number = np.arange(paths.pixel.size, dtype=np.int32)
    by_row = sparse.csr_array((paths.weight, (paths.pixel, number)), shape=(rows, max(1, number.size)))
    start = by_row.indptr.astype(np.int64)
    ends = np.searchsorted(start, np.arange(_PATHS_AT_ONCE, start[-1] + _PATHS_AT_ONCE, _PATHS_AT_ONCE))
    cuts = np.unique(np.concatenate(([0], np.minimum(ends, rows), [rows])))

    def block(begin: int, end: int) -> SparseRows:
        a, b = start[begin], start[end]
        path, weight = by_row.indices[a:b].astype(np.int32), by_row.data[a:b]
        return spread_spots(start[begin : end + 1] - a, path, weight, paths.u, paths.v, projector_size)

    return SparseRows.stacked(list(in_parallel(lambda cut: block(*cut), itertools.pairwise(cuts.tolist()))))


def _matrix_arrays(name: str, matrix: SparseRows) -> dict[str, NDArray[Any]]:
    return {f"{name}.{f.name}": getattr(matrix, f.name) for f in fields(SparseRows)}


def _matrix(name: str, arrays: Mapping[str, NDArray[Any]]) -> SparseRows:
    return SparseRows(**{f.name: arrays[f"{name}.{f.name}"] for f in fields(SparseRows)})
