"""Where the projector's light goes on: photons from its pixels, followed over mirrors, lobes and matt surfaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_backend.columns import Columns
from sim_backend.raycasting import MISS, Hits, RayCaster
from sim_backend.reflection import scatter_diffuse, scatter_specular, unit
from sim_backend.surfaces import Array, Material
from sim_backend.viewpoint import Viewpoint


@dataclass(frozen=True, eq=False)
class Photons(Columns):
    """Packets of light on a surface.

    Parameters
    ----------
    u, v
        (n,) projector px they come from.
    flux
        (n,) in units of one full projector pixel.
    point, normal
        (n, 3) where they are, mm, and the unit normal on the side they came from.
    direction
        (n, 3) unit direction in which they arrived.
    surface
        (n,) number of the surface.
    lobe_mm
        (n,) how far lobes have spread them, standard deviation in mm; 0 after perfect mirrors.
    choice
        (n, 2) numbers in 0..1 that choose the next direction.
    """

    u: Array
    v: Array
    flux: Array
    point: Array
    normal: Array
    direction: Array
    surface: NDArray[np.int16]
    lobe_mm: Array
    choice: Array


def emit(
    caster: RayCaster, projector: Viewpoint, uv: Array, flux: float, choice: Array, surface: int | None = None
) -> Photons:
    """Photons of ``flux`` each from projector places ``uv`` (n, 2) where they first arrive.

    Those that meet nothing are left out, and with ``surface`` those that meet another one.
    """
    direction = unit(projector.rays(uv))
    hits = caster.first_hits(projector.centre, direction)
    n = len(uv)
    arrived = Photons(
        uv[:, 0], uv[:, 1], np.full(n, flux), hits.point, hits.normal, direction, hits.surface, np.zeros(n), choice
    )
    return arrived[hits.surface != MISS if surface is None else hits.surface == surface]


def follow(
    caster: RayCaster,
    materials: Sequence[Material],
    photons: Photons,
    random: np.random.Generator,
    *,
    bounces: int,
    diffuse: bool,
) -> Iterator[Photons]:
    """Scatter photons up to ``bounces`` times.

    Parameters
    ----------
    caster
        The scene.
    materials
        How its surfaces scatter, by number.
    photons
        At the surface that scatters them first.
    random
        Chooses between two kinds of reflection, and directions after the first.
    bounces
        Reflections at most.
    diffuse
        False: by mirrors and lobes only. True: paths on which at least one reflection was diffuse. The two together
        are all light, nothing twice.

    Yields
    ------
    After each reflection, the photons that arrived somewhere by a path of the wanted kind, before they are scattered.
    """
    wanted = np.zeros(len(photons.u), bool) if diffuse else np.ones(len(photons.u), bool)
    for _ in range(bounces):
        direction, share, lobe_rad, matt = _scatter(caster, materials, photons, random, diffuse)
        on = np.flatnonzero(share > 0)
        if on.size == 0:
            return
        scattered, direction, wanted = photons[on], direction[on], wanted[on] | matt[on]
        hits = caster.first_hits(scattered.point, direction, leaving=scattered.normal)
        travelled = np.linalg.norm(hits.point - scattered.point, axis=1)
        photons = Photons(
            scattered.u,
            scattered.v,
            scattered.flux * share[on],
            hits.point,
            hits.normal,
            direction,
            hits.surface,
            scattered.lobe_mm + travelled * lobe_rad[on],
            random.random((on.size, 2)),
        )
        arrived = hits.surface != MISS
        photons, wanted = photons[arrived], wanted[arrived]
        yield photons[wanted] if diffuse else photons


def _scatter(
    caster: RayCaster, materials: Sequence[Material], photons: Photons, random: np.random.Generator, diffuse: bool
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """New directions, the shares of flux that go there, the lobes' breadth (rad), which reflections were diffuse."""
    n = len(photons.u)
    direction, share, lobe_rad, matt = np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n, bool)
    lot = random.random(n)
    for number, material in enumerate(materials):
        # One of the two kinds of reflection is drawn and carries the light of both: right on average.
        total = material.specular + (material.diffuse if diffuse else 0.0)
        if total == 0:
            continue
        here = photons.surface == number
        glossy = here & (lot * total < material.specular)
        lobe_rad[glossy] = material.lobe_rad
        direction[glossy], share[glossy] = scatter_specular(
            material, photons.direction[glossy], photons.normal[glossy], photons.choice[glossy]
        )
        if material.specular:
            share[glossy] *= total / material.specular
        matt |= here & ~glossy
        share[here & ~glossy] = total
        if number in caster.sheets and material.diffuse:
            # Where the print is dark, less is scattered than on the mean.
            at = np.flatnonzero(here & ~glossy)
            share[at] *= (
                caster.diffuse(Hits(photons.surface[at], photons.point[at], photons.normal[at])) / material.diffuse
            )
    direction[matt] = scatter_diffuse(photons.normal[matt], photons.choice[matt])
    return direction, share, lobe_rad, matt
