"""The error of one frame, told over many pixels by the forms that it can have.

What no waveform explains of a frame is its error and noise. Pixel by pixel the noise hides what would move a phase by
as much as itself. But an error has a form: light that flickers is the same everywhere, a shutter that was late goes
with A, mostly as B does, the picture before goes with the fringe. How much of each is in a frame is known from hundreds
of pixels, whatever bounces do to the waveform.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.sampling import Grid
from scanner.integrity.significance import highest_by_chance
from scanner.integrity.waveform import HARMFUL, STEADY, Waveform, free_harmonics, next_harmonic

_BY_CHANCE = 1e-9
_FEWEST_OF_BAND = 40
_LEAST_VISIBLE = 0.05
_ALIKE = 1e-2
"""Share of its energy that must set a form apart from all others; where the phases are few, they are alike."""


def formed_excess(
    waveform: Waveform, steps_rad: NDArray[np.float64], cells: Grid, former: NDArray[np.float32] | None
) -> NDArray[np.float64]:
    """(N, tiles + 1) how far each frame's error is beyond what does no harm: above 1 is an alarm.

    Parameters
    ----------
    waveform
        Of a sequence with more frames than its waveform needs.
    steps_rad
        (N,) planned steps.
    cells
        Where the pixels lie; they are judged by bands of rows, and all together.
    former
        (P,) the frame that was taken before the first one, DN; None where there was none.
    """
    count = len(steps_rad)
    z = waveform.z[waveform.usable].astype(np.complex128)
    b, phase, band = np.abs(z), np.angle(z), cells.band[waveform.usable]
    forms = np.stack([np.ones_like(b), b, z.real, z.imag], axis=1)
    # The first harmonics that are not free: they go with the phase in all frames.
    orders = free_harmonics(count) + np.arange(1, 3)
    harmonics = np.concatenate([b * np.cos(np.outer(orders, phase)), b * np.sin(np.outer(orders, phase))]).T
    # Where two paths of light meet they do not; there they are at most as large as the last one that is free.
    spoiling = min(next_harmonic(waveform), float(np.abs(waveform.distortion()[-1]))) ** 2 / 2
    level = np.maximum(waveform.mean[waveform.usable], b)
    found = np.zeros((count, cells.bands + 1))
    for region in range(cells.bands + 1):
        there = np.flatnonzero(band == region) if region < cells.bands else np.arange(b.size)
        if there.size < _FEWEST_OF_BAND:
            continue
        steady = STEADY**2 * float(np.square(b[there]).mean()) / (2 * waveform.sigma_dn**2)
        bright = float(np.square(level[there]).mean())
        alike = _scaled(harmonics[there])
        values, vectors = np.linalg.eigh(alike.T @ alike)
        clear = values > _ALIKE * values[-1]
        spoilt = alike @ (vectors[:, clear] / np.sqrt(values[clear]))
        own = _Forms.of(forms[there], spoilt)
        for n in np.flatnonzero(waveform.visible >= _LEAST_VISIBLE):
            mine = own
            if n == 0 and former is not None:
                mine = _Forms.of(np.column_stack([forms[there], former[waveform.usable][there]]), spoilt)
            if not mine.energy.size:
                continue
            along = mine.axes.T @ waveform.errors[n, there]
            error = mine.shown @ (along / mine.energy)
            energy = float((along**2 / mine.energy).sum()) * waveform.visible[n] / waveform.sigma_dn**2
            certain = energy / highest_by_chance(_BY_CHANCE, mine.energy.size, waveform.noise)
            # A phase moves by (2/N) (e/B) sin(φ + δ), its noise is √(2/N) σ/B.
            moved = 2 / count * float(np.square(error * np.sin(phase[there] + steps_rad[n])).mean())
            harm = moved / waveform.sigma_dn**2 / (HARMFUL + steady)
            plausible = np.square(error).mean() * waveform.visible[n] ** 2 / max(spoiling * bright, 1e-9)
            found[n, region] = min(certain, harm, plausible)
    # In the tiles that show most of it.
    held = np.bincount(cells.tile[waveform.usable], minlength=cells.tiles).reshape(cells.bands, -1)
    by_tile = (found[:, :-1, None] * (held > held.max(axis=1, keepdims=True) / 2)).reshape(count, -1)
    return np.concatenate([by_tile, found[:, -1:]], axis=1)


@dataclass(frozen=True)
class _Forms:
    """Forms that an error can have at P pixels, in combinations that what spoils a frame leaves apart.

    Parameters
    ----------
    axes
        (P, k) the combinations without what spoils a frame, at right angles to one another.
    shown
        (P, k) the same with it, as they are in a frame.
    energy
        (k,) that of ``axes``.
    """

    axes: NDArray[np.float64]
    shown: NDArray[np.float64]
    energy: NDArray[np.float64]

    @classmethod
    def of(cls, columns: NDArray[np.float64], spoilt: NDArray[np.float64]) -> _Forms:
        """Of forms (P, n); ``spoilt`` (P, m) are of unit length and at right angles."""
        own = _scaled(columns)
        free = own - spoilt @ (spoilt.T @ own)
        values, vectors = np.linalg.eigh(free.T @ free)
        clear = values > _ALIKE
        return cls(free @ vectors[:, clear], own @ vectors[:, clear], values[clear])


def _scaled(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """The columns, each with unit length."""
    return np.asarray(columns / np.maximum(np.sqrt(np.einsum("ij,ij->j", columns, columns)), 1e-9))
