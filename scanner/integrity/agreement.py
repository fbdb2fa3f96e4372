"""Do the sequences of a round agree? A fault too small for any pixel of one sequence stands out over all of them.

What the frequencies of an axis say of a pixel is one coordinate. The residual of each phase against all the others is
the very error that would go into a coordinate, and its noise is known. A frame that is off by e moves the phase φ by
(2/N) (e/B) sin(φ + δ), and what e can be is known as well: over hundreds of pixels a tenth of the noise is seen.

Two things are not to be taken for a fault. Bounces and depth edges fit no coordinate: only pixels vote whose other
phases agree, and of these the majority; and what changes smoothly with the frequency is a bounce. And there is what
makes all phases a little wrong, as gamma does with few steps, or the optics: a sequence is compared with the others
of its round.

And a picture has whole grey levels. What that moves a phase by is the same wherever the same projector pixel is seen:
in a small region with little noise it may look like a fault. But it is known, and taken away as far as it is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.sampling import Grid
from scanner.integrity.waveform import FEWEST, HARMFUL
from scanner.patterns import Axis

_FEWEST_FREQUENCIES = 3
_TYPICAL = 0.4
"""The share of the sequences that one is measured by: in TPS with one axis, a wrong one makes two of three look so."""

_STANDS_OUT = 4.0
"""A sequence with so many times the energy of a typical one stands out; systematic errors are alike in all."""

_BY_CHANCE = 1e-9
_CONFIRMED, _STAYS = 0.5, 0.5
_LEAST_WEIGHT = 0.05
"""Of a coordinate's information. A frequency far below the others carries none, and sees bounces that they do not."""

_LEAST_LEFT = 0.1
"""Of the energy of an error that must be left in a residual for it to tell anything."""

_REFUSED = 0.1
"""The share of good pixels that do not vote."""

_CLEAN = 0.25
"""So many pixels, at least, see one path of light."""

_MOST = 2.0
"""χ² of a vote in units of what noise makes of it: beyond, the others do not agree, whatever it is."""

_OUTLIER = 3.0
_GROUPS = 4
_ITERATIONS = 4
_FEWEST_OF_BAND = 80
_SAME = 1.5
"""Variance of the difference of two takes, in units of that of their noise, up to which they are the same."""


@dataclass(frozen=True)
class Shown:
    """What a good sequence has shown at the sampled pixels.

    Parameters
    ----------
    axis, frequency
        Of its fringes; 1/px.
    z
        (P,) phasors, DN.
    sigma_z
        Their noise, DN.
    usable
        (P,) pixels with fringes.
    round
        From 1.
    former
        (P,) the frame that was taken before its first one, DN; None where there was none.
    sure
        Whether its steps were enough to tell every harmful error of a frame by themselves.
    """

    axis: Axis
    frequency: float
    z: NDArray[np.complex64]
    sigma_z: float
    usable: NDArray[np.bool_]
    round: int
    former: NDArray[np.float32] | None = None
    sure: bool = False


Rounding = Mapping[tuple[Axis, float], NDArray[np.complex128]]
"""By axis and frequency, (extent,) what grey levels add to the phasor of each projector pixel, as a share of B."""


def standing_out(
    shown: Sequence[Shown], extent: Mapping[Axis, int], cells: Grid, rounding: Rounding | None = None
) -> NDArray[np.float64]:
    """(S,) how surely each of the sequences of a round is at odds with the others; 0 where it is not, or does no harm.

    Parameters
    ----------
    shown
        The S sequences of the round.
    extent
        Projector pixels along each axis.
    cells
        Where the pixels lie.
    rounding
        Of the pictures (`scanner.patterns.Plan.rounding`); None where light has no steps.

    Notes
    -----
    With three frequencies two of them may be at odds alike, and either be the wrong one.
    """
    sure = np.zeros(len(shown))
    axes = {axis: [i for i, s in enumerate(shown) if s.axis == axis] for axis in extent}

    def judged(smooth: bool) -> dict[Axis, _Judged]:
        return {
            a: _judged([shown[i] for i in members], extent[a], cells, rounding or {}, smooth)
            for a, members in axes.items()
        }

    found = judged(smooth=False)
    suspected = _odd(found, 1)
    if any(there.any() for there in suspected.values()):
        again = judged(smooth=True)
        confirmed = _odd(again, _CONFIRMED)
        for axis, there in suspected.items():
            # A wrong frame is as wrong either way; of a bounce most is gone.
            there &= confirmed[axis] & (again[axis].moved > _STAYS * found[axis].moved)
            sure[axes[axis][: len(there)]] = np.where(there, found[axis].certain, 0).max(axis=1)
    return sure


def _odd(found: Mapping[Axis, _Judged], least: float) -> dict[Axis, NDArray[np.bool_]]:
    """(T, R) by axis, where the sequences stand out, are surely wrong, and do harm."""
    every = np.concatenate([judged.energy for judged in found.values()])
    typical = np.maximum(np.quantile(every, _TYPICAL, axis=0, method="lower"), 0) if len(every) else np.inf
    return {
        axis: (one.certain > least) & (one.moved > HARMFUL) & (one.energy > _STANDS_OUT * typical)
        for axis, one in found.items()
    }


def same(former: Shown, now: Shown) -> bool:
    """Whether two takes of one sequence have the same phases: then its pictures were what the projector makes of it."""
    both = former.usable & now.usable
    if np.count_nonzero(both) < FEWEST:
        return True
    across = (now.z[both] * former.z[both].conj()).imag / np.abs(former.z[both])
    return bool(np.square(across).mean() < _SAME * (former.sigma_z**2 + now.sigma_z**2))


@dataclass(frozen=True)
class _Judged:
    """Of T sequences of one axis in R regions of the picture; of none where they are too few to tell.

    ``energy`` (T, R) is what an error of one frame explains of the residual of the phase, a mean square in units of the
    noise; ``certain`` (T, R) how surely it does, above 1; ``left`` (T,) how much of the energy of an error is in it.
    """

    energy: NDArray[np.float64]
    certain: NDArray[np.float64]
    left: NDArray[np.float64]

    @property
    def moved(self) -> NDArray[np.float64]:
        """(T, R) the mean square of the error that would explain it, in units of the noise."""
        return np.asarray(self.energy / self.left[:, None])


def _judged(shown: Sequence[Shown], extent: int, cells: Grid, rounding: Rounding, smooth: bool) -> _Judged:
    nothing = _Judged(np.empty((0, cells.bands + 1)), np.empty((0, cells.bands + 1)), np.empty(0))
    if len(shown) < _FEWEST_FREQUENCIES:
        return nothing
    pixels = np.flatnonzero(np.logical_and.reduce([s.usable for s in shown]))
    if pixels.size < FEWEST:
        return nothing
    residuals = _residuals(shown, pixels, extent, cells, rounding, smooth)
    regions = _regions(cells, pixels)
    found = np.array([[_of_a_frame(one, there) for there in regions] for one in residuals])
    return _Judged(found[..., 0], found[..., 1], np.array([one.left for one in residuals]))


@dataclass(frozen=True)
class _Residual:
    """Of one sequence against the others of its axis.

    ``across`` (P,) is the error of the phase, times the modulation, in units of its noise; ``left`` how much of the
    energy of such an error is in it; ``shapes`` (P, 9) what errors of one frame make of it; ``votes`` (P,) the pixels
    at which the others agree; ``column`` (P,) where they lie.
    """

    across: NDArray[np.float64]
    left: float
    shapes: NDArray[np.float64]
    votes: NDArray[np.bool_]
    column: NDArray[np.intp]


def _residuals(
    shown: Sequence[Shown], pixels: NDArray[np.intp], extent: int, cells: Grid, rounding: Rounding, smooth: bool
) -> list[_Residual]:
    """What each phase is off by from where the others have it (leave-one-out residuals of a linear fit).

    ``smooth`` takes away whatever changes slowly with the frequency as well, as a weak bounce from nearby does.
    """
    # Heavy, and not needed before a round ends.
    from scipy.stats import chi2

    from scanner.phasors import AxisPhasors
    from scanner.unwrapping import modulation_trend, unwrap

    z = np.stack([s.z[pixels] for s in shown])
    frequency = np.array([s.frequency for s in shown])
    # An error that passes for noise must not hide itself.
    sigma = float(np.median([s.sigma_z for s in shown]))
    noise = np.full((1, pixels.size), sigma, np.float32)
    phasors = AxisPhasors(shown[0].axis, frequency, np.ascontiguousarray(z[:, None]), 0.0)
    gain = modulation_trend(phasors, noise)
    place = unwrap(phasors, noise, extent, gain).u[0].astype(np.float64)
    phases = 2 * np.pi * frequency[:, None] * place
    turned = z * np.exp(-1j * phases) / sigma
    along, across = turned.real, turned.imag
    b = np.maximum(gain @ along / (gain @ gain), 0)
    # Position, and where there are frequencies enough an offset and a curvature of the phase.
    free = 1 + min(2, (len(shown) - 3) // 2) if smooth else 1
    basis = np.linalg.qr((gain * np.power.outer(frequency / frequency.mean(), [1, 0, 2][:free]).T).T)[0]
    across = across - basis @ (basis.T @ across)
    rounded = np.stack([_at(place, rounding.get((s.axis, s.frequency))) for s in shown]) * np.exp(-1j * phases)
    rounded = rounded.imag * gain[:, None] * b / sigma
    rounded = rounded - basis @ (basis.T @ rounded)
    along = along - gain[:, None] * b
    left = 1 - np.square(basis).sum(axis=1)
    weight = np.square(gain * frequency) / np.square(gain * frequency).sum()
    asked = (left > _LEAST_LEFT) & (weight > _LEAST_WEIGHT) & ~np.array([s.sure for s in shown])
    left = np.maximum(left, _LEAST_LEFT)
    degrees = 2 * len(shown) - 2 - free
    # χ² of everything but the phase in question. Bounces may be everywhere and raise it, but not to the same height.
    rest = np.square(across).sum(axis=0) + np.square(along).sum(axis=0) - across**2 / left[:, None]
    highest = float(chi2.isf(_REFUSED, degrees))
    agreeing = highest / float(chi2.ppf(_CLEAN, degrees))
    clean = rest < np.minimum(agreeing * np.quantile(rest, _CLEAN, axis=1, keepdims=True), _MOST * highest)
    across = across - _seen(across, rounded, clean) * rounded
    column = cells.columns_px[pixels]
    found = []
    for t, one in enumerate(shown):
        former = np.zeros(pixels.size) if one.former is None else one.former[pixels].astype(np.float64)
        found.append(
            _Residual(
                across[t] / np.sqrt(left[t]),
                float(left[t]),
                _shapes(phases[t], b, former),
                asked[t] & clean[t],
                column,
            )
        )
    return found


def _shapes(phase: NDArray[np.float64], b: NDArray[np.float64], former: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 9) what an error e of one frame makes of a phase times B: sin(φ + δ) e, e as faults make it.

    Of light that flickers e is the same everywhere, of a shutter that was late it goes with A, mostly as B does, of the
    picture before with the fringe, and of the picture before a sequence with that.
    """
    sine, cosine, double = np.sin(phase), np.cos(phase), np.exp(2j * phase)
    with_b = [b * sine, b * cosine, b, b * double.real, b * double.imag]
    shapes = np.stack([sine, cosine, *with_b, former * sine, former * cosine], axis=1)
    return np.asarray(shapes / np.maximum(np.linalg.norm(shapes, axis=0), 1e-9))


def _regions(cells: Grid, pixels: NDArray[np.intp]) -> list[NDArray[np.bool_]]:
    """Bands of rows, and everything: a torn frame is right in most of its rows."""
    band = cells.band[pixels]
    return [band == n for n in range(cells.bands)] + [np.ones(pixels.size, bool)]


def _seen(across: NDArray[np.float64], rounded: NDArray[np.float64], agreeing: NDArray[np.bool_]) -> float:
    """Share of what grey levels make of (T, P) ``across``, were they seen without any blur, that is in it.

    It is the same for all sequences, of which a wrong one is one among many.
    """
    theirs = rounded[agreeing]
    return float(np.clip(across[agreeing] @ theirs / np.maximum(theirs @ theirs, 1e-12), 0, 1))


def _at(place: NDArray[np.float64], line: NDArray[np.complex128] | None) -> NDArray[np.complex128]:
    """(P,) values of a (extent,) line between its pixels; 0 without a line."""
    if line is None:
        return np.zeros(place.size, np.complex128)
    return np.asarray(np.interp(place, np.arange(line.size), line))


def _of_a_frame(one: _Residual, there: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean square of what a frame's error explains of a residual in a region, and how surely it is one: above 1.

    Pixels that the fit of the majority leaves far out are given up: there is a bounce that the others do not show. And
    a frame is wrong in some rows or in all, but in all columns: what one part of them shows the rest must show.
    """
    from scipy.stats import chi2

    chosen = np.flatnonzero(there & one.votes)
    if chosen.size < _FEWEST_OF_BAND:
        return 0.0, 0.0
    shapes, off = one.shapes[chosen], one.across[chosen]
    kept = np.ones(off.size, bool)
    for _ in range(_ITERATIONS):
        shares, energy, degrees = _fit(shapes[kept], off[kept])
        rest = off - shapes @ shares
        freedom = kept.size / max(kept.size - degrees, 1)
        spread = max(1.4826 * float(np.median(np.abs(rest))) * float(np.sqrt(freedom)), 1.0)
        kept = np.abs(rest) < _OUTLIER * spread
    certain = energy / (spread**2 * float(chi2.isf(_BY_CHANCE, degrees)))
    if certain > 1:
        shapes, off, column = shapes[kept], off[kept], one.column[chosen][kept]
        group = np.argsort(np.argsort(column, kind="stable"), kind="stable") * _GROUPS // column.size
        told = [_foretold(shapes, off, group == g) for g in range(_GROUPS)]
        if sum(gain > 0 for gain in told) < _GROUPS - 1:
            return 0.0, 0.0
    return (energy - degrees * spread**2) / max(int(kept.sum()), 1), certain


def _fit(shapes: NDArray[np.float64], off: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, int]:
    """Least squares: the shares of the shapes, the energy that they explain, and how many of them can be told apart."""
    values, vectors = np.linalg.eigh(shapes.T @ shapes)
    # Where the phases are few, the shapes are alike.
    clear = values > 1e-3 * values[-1]
    parts = vectors[:, clear].T @ (shapes.T @ off)
    return vectors[:, clear] @ (parts / values[clear]), float((parts**2 / values[clear]).sum()), int(clear.sum())


def _foretold(shapes: NDArray[np.float64], off: NDArray[np.float64], group: NDArray[np.bool_]) -> float:
    """Energy of a group of pixels that the fit of all others explains; negative where it makes things worse."""
    expected = shapes[group] @ _fit(shapes[~group], off[~group])[0]
    return float(np.square(off[group]).sum() - np.square(off[group] - expected).sum())
