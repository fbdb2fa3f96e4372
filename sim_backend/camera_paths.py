"""What the camera sees: rays from its pixels to lit surfaces, at first sight or by way of a mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sim_backend.columns import Columns
from sim_backend.kernels import Floats, SparseRows, in_parallel, reflected_radiance, spread_spots
from sim_backend.raycasting import Hits, RayCaster
from sim_backend.reflection import scatter_specular, unit
from sim_backend.surfaces import Array
from sim_backend.viewpoint import Viewpoint, bilinear_shares

_RAYS_AT_ONCE = 50_000
_MIRROR_LIKE_RAD = 0.02
"""Lobes up to this broad are followed from the camera; broader ones would need more rays than a pixel has."""


@dataclass(frozen=True, eq=False)
class View(Columns):
    """What the rays through the camera's pixel centres meet; arrays of the camera's (height, width).

    Parameters
    ----------
    surface
        int8, number of the surface, −1 for none.
    depth
        float32, mm along the camera's axis, NaN for none.
    x_p, y_p
        float32, the projector px that lights the point, NaN where no direct light comes from.
    mixed
        bool, the pixel's rays meet different surfaces, or light and shadow.
    print_gain
        float32, how much brighter a printed surface is there than on the mean; 1 on others.
    """

    surface: NDArray[np.int8]
    depth: Floats
    x_p: Floats
    y_p: Floats
    mixed: NDArray[np.bool_]
    print_gain: Floats


@dataclass(frozen=True, eq=False)
class Paths(Columns):
    """Light paths that end in camera pixels.

    Parameters
    ----------
    pixel
        (n,) int32 camera pixel, counted row by row.
    u, v
        (n,) float32 projector px they began at.
    weight
        (n,) float32 what the pixel's radiance gets of a full projector pixel.
    """

    pixel: NDArray[np.int32]
    u: Floats
    v: Floats
    weight: Floats


@dataclass(frozen=True, eq=False)
class Glimpses(Columns):
    """What pixels see in a mirror.

    Parameters
    ----------
    pixel, of
        (n,) int32 the pixel, and the one that sees the same place directly.
    share
        (n,) float32 part of that one's radiance.
    """

    pixel: NDArray[np.int32]
    of: NDArray[np.int32]
    share: Floats


@dataclass(frozen=True, eq=False)
class CameraPaths:
    """All that rays from the camera find.

    Parameters
    ----------
    view
        What the pixel centres see.
    direct
        (camera pixels, projector pixels) radiance of direct light.
    by_mirror
        Light that goes projector, surface, mirror, camera.
    seen_in_mirror
        (camera pixels, camera pixels) what a pixel sees of others' places in a mirror.
    """

    view: View
    direct: SparseRows
    by_mirror: Paths
    seen_in_mirror: SparseRows


def trace_camera(rays: CameraRays) -> CameraPaths:
    """Follow the rays of all the camera's pixels.

    A pixel's value is the mean radiance (flux per mm² and sr) of what its rays meet; a projector pixel that is fully
    on sends out a flux of 1.
    """
    width, height = rays.camera.lens.size
    rows = max(1, _RAYS_AT_ONCE // (width * rays.supersample**2))
    blocks = in_parallel(lambda r: rays.trace(r, min(r + rows, height)), range(0, height, rows))
    views, direct, by_mirror, seen_in_mirror = (list(parts) for parts in zip(*blocks, strict=True))
    glimpses = Glimpses.joined(seen_in_mirror)
    pixels = width * height
    seen = sparse.csr_array((glimpses.share, (glimpses.pixel, glimpses.of)), shape=(pixels, pixels))
    return CameraPaths(
        View.joined(views),
        SparseRows.stacked(direct),
        Paths.joined(by_mirror),
        SparseRows.of(seen),
    )


def square_grid(squares: int) -> Array:
    """(squares², 2) x and y of the middles of a pixel's squares, row by row, relative to its centre."""
    offset = (np.arange(squares) + 0.5) / squares - 0.5
    return np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class CameraRays:
    """Follows rays of the camera's pixels.

    Parameters
    ----------
    caster
        Of the scene.
    camera, projector
        Where they stand.
    supersample
        Rays per pixel along each axis.
    bounces
        Mirrors that a ray is followed by, at most.
    """

    caster: RayCaster
    camera: Viewpoint
    projector: Viewpoint
    supersample: int
    bounces: int

    def trace(self, first_row: int, end_row: int) -> tuple[View, SparseRows, Paths, Glimpses]:
        """Rows ``first_row`` to ``end_row`` of the picture."""
        width, rays = self.camera.lens.size[0], self.supersample**2
        shape = (end_row - first_row, width)
        y, x = np.mgrid[first_row:end_row, :width].astype(np.float64)

        direction = unit(self.camera.rays(np.stack((x, y), -1).reshape(-1, 2)))
        centre = self.caster.first_hits(self.camera.centre, direction)
        uv, radiance = self.lit(centre, -direction, self.caster.diffuse(centre))
        x_p, y_p = np.where(self.in_picture(uv) & (radiance > 0), uv.T, np.nan)

        hits, direction, sides = self.samples(x.ravel(), y.ravel())
        sub_uv, sub_radiance = self.lit(hits, -direction, self.caster.diffuse(hits, sides))

        surfaces, lit = hits.surface.reshape(-1, rays), (sub_radiance > 0).reshape(-1, rays)
        mixed = (surfaces != centre.surface[:, None]).any(1) | (lit != (radiance > 0)[:, None]).any(1)
        u, v = np.nan_to_num(sub_uv).astype(np.float32).T
        direct = spread_spots(
            np.arange(0, len(direction) + 1, rays, dtype=np.int64),
            np.arange(len(direction), dtype=np.int32),
            (sub_radiance / rays).astype(np.float32),
            u,
            v,
            self.projector.lens.size,
        )
        view = View(
            centre.surface.astype(np.int8).reshape(shape),
            centre.point[:, 2].astype(np.float32).reshape(shape),
            x_p.astype(np.float32).reshape(shape),
            y_p.astype(np.float32).reshape(shape),
            mixed.reshape(shape),
            self.brighter(centre, hits, sides).astype(np.float32).reshape(shape),
        )
        pixel = np.repeat(np.arange(first_row * width, end_row * width, dtype=np.int32), rays)
        return view, direct, *self.by_mirror(pixel, direction, hits)

    def samples(self, x: Array, y: Array) -> tuple[Hits, Array, Array | None]:
        """What the rays of pixels meet, pixel by pixel in rows.

        Parameters
        ----------
        x, y
            (n,) the pixels' centres.

        Returns
        -------
        Hits of all n · ``supersample``² rays; their directions (rays, 3), unit; the sides (rays, 2, 3), mm, of what
        each ray's square in the picture covers of its surface, None where nothing is printed.
        """
        dx, dy = square_grid(self.supersample).T
        px = np.stack((x[:, None] + dx, y[:, None] + dy), -1).reshape(-1, 2)
        direction = unit(self.camera.rays(px))
        hits = self.caster.first_hits(self.camera.centre, direction)
        return hits, direction, self.sides(x, y, hits) if self.caster.sheets else None

    def sides(self, x: Array, y: Array, hits: Hits) -> Array:
        """(rays, 2, 3) as of `samples`; the pixels' squares stand for those of all their rays."""
        # Where a pixel sees several surfaces, one does for all: its print is not what matters there.
        surface = hits.surface.reshape(-1, self.supersample**2).max(1)
        ends = []
        for dx, dy in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
            direction = self.camera.rays(np.stack((x + dx, y + dy), -1))
            ends.append(self.caster.extended(surface, self.camera.centre, direction))
        sides = np.stack((ends[0] - ends[1], ends[2] - ends[3]), 1) / self.supersample
        return np.repeat(sides, self.supersample**2, axis=0)

    def brighter(self, centre: Hits, hits: Hits, sides: Array | None) -> Array:
        """(pixels,) how much brighter than on the mean is what the pixels' rays see of the print at their centres."""
        factor = np.ones(len(centre.surface))
        if sides is None:
            return factor
        rays = self.supersample**2
        same = hits.surface.reshape(-1, rays) == centre.surface[:, None]
        share = (self.caster.diffuse(hits, sides).reshape(-1, rays) * same).sum(1) / np.maximum(same.sum(1), 1)
        for number in self.caster.sheets:
            mean = self.caster.materials[number, 0]
            at = np.flatnonzero((centre.surface == number) & same.any(1))
            factor[at] = share[at] / mean if mean else 1.0
        return factor

    def lit(self, hits: Hits, to_eye: Array, diffuse: Array) -> tuple[Array, Array]:
        """Projector px (n, 2) of hit points, and the radiance (n,) that direct light gives them towards the eye.

        ``diffuse`` (n,) is the share of the light that they scatter evenly.
        """
        uv = self.projector.project(hits.point)
        irradiance = self.projector.density(uv, hits.point, hits.normal)
        radiance = reflected_radiance(
            self.caster.materials,
            diffuse,
            hits.surface,
            self.projector.centre,
            hits.point,
            hits.normal,
            to_eye,
            irradiance,
        )
        at = np.flatnonzero(radiance > 0)
        radiance[at] *= self.caster.visible(hits.point[at], hits.normal[at], self.projector.centre)
        return uv, radiance

    def in_picture(self, uv: Array) -> NDArray[np.bool_]:
        """(n,) whether projector px (n, 2) are within the projector's picture."""
        size = np.array(self.projector.lens.size)
        with np.errstate(invalid="ignore"):
            return np.asarray((np.abs(uv - (size - 1) / 2) <= size / 2).all(1))

    def by_mirror(self, pixel: NDArray[np.int32], direction: Array, hits: Hits) -> tuple[Paths, Glimpses]:
        """Follow rays that have met a mirror to lit surfaces, and to what other pixels see directly."""
        none, nowhere = np.empty(0, np.float32), np.empty(0, np.int32)
        paths, glimpses = [Paths(nowhere, none, none, none)], [Glimpses(nowhere, nowhere, none)]
        random = np.random.default_rng(int(pixel[0]))
        share = np.full(len(pixel), 1 / self.supersample**2)
        for _ in range(self.bounces):
            turned, reflected = np.empty_like(direction), np.zeros(len(direction))
            for number, surface in enumerate(self.caster.surfaces):
                if surface.material.specular > 0 and surface.material.lobe_rad <= _MIRROR_LIKE_RAD:
                    at = np.flatnonzero(hits.surface == number)
                    turned[at], reflected[at] = scatter_specular(
                        surface.material, direction[at], hits.normal[at], random.random((at.size, 2))
                    )
            on = np.flatnonzero(reflected > 0)
            if on.size == 0:
                break
            pixel, direction, share = pixel[on], turned[on], share[on] * reflected[on]
            hits = self.caster.first_hits(hits.point[on], direction, leaving=hits.normal[on])
            uv, radiance = self.lit(hits, -direction, self.caster.diffuse(hits))
            at = np.flatnonzero(radiance > 0)
            u, v = uv[at].T.astype(np.float32)
            paths.append(Paths(pixel[at], u, v, (share * radiance)[at].astype(np.float32)))
            glimpses.append(self.glimpses(pixel, share, hits))
        return Paths.joined(paths), Glimpses.joined(glimpses)

    def glimpses(self, pixel: NDArray[np.int32], share: Array, hits: Hits) -> Glimpses:
        """Which camera pixels see the hit points directly."""
        xy = self.camera.project(hits.point)
        at = np.flatnonzero(self.camera.density(xy, hits.point, hits.normal) > 0)
        at = at[self.caster.visible(hits.point[at], hits.normal[at], self.camera.centre)]
        of, part = bilinear_shares(xy[at], self.camera.lens.size)
        return Glimpses(np.repeat(pixel[at], 4), of.ravel(), (part * share[at, None]).astype(np.float32).ravel())
