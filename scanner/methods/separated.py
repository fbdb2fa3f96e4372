"""The bounce region from round one alone: both paths of its pixels, and which is direct (method.md §6).

With both axes and a rig the axes are separated together and the epipolar line decides; else each axis by itself, and
amplitudes and chance decide. Neighbours are asked only where that leaves doubt.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from scanner.interreflection import Detection
from scanner.methods.base import Setup
from scanner.methods.multi_frequency import DecodedAxis
from scanner.paths import (
    AxisPhasorsOf,
    Coupling,
    ask_neighbours,
    choose_direct,
    corroborated,
    measure_coupling,
    separate_jointly,
    separate_two_paths,
)
from scanner.patterns import Axis
from scanner.phasors import AxisPhasors, RoundPhasors
from scanner.rig import Rig

_REFUSED_ONE_IN = 1e4
"""Of good fits one in so many is refused by its own χ²."""

_CLEAR_ORDERS = 10.0
"""χ² by which the next best pair of fringe orders must fit worse."""

_CLEAR_CHOICE = 2.0
"""Without a rig the direct path must be e² times as likely as the bounce to stand for the pixel."""

_CLEAR_PLACE = float(np.log(100))
"""With a rig its place must be a hundred times as likely as the next."""


@dataclass(frozen=True)
class Separated:
    """Direct path of the region's pixels from round one alone, arrays (P,) in the order of ``pixels``.

    Parameters
    ----------
    shape
        Of the picture, (H, W).
    pixels
        Flat pixel numbers.
    u, sigma, bounce
        By axis: direct coordinate and its σ, and the coordinate of the other path, px; NaN where not known.
    plausible
        Whether the separation fits: good enough to say where to light, where many pixels vote.
    trusted
        Whether the fringe orders and the choice of the direct path are clear as well, and with a rig that there are two
        paths is corroborated: good enough to be a coordinate.
    third
        Whether neither one nor two paths fit.
    off_line
        Whether two paths fit and neither lies on the epipolar line: a mirror shows the pixel something else.
    located
        Whether the fringe orders and the choice are clear, corroborated or not.
    strength
        α, the modulation of the bounce in units of the direct light's; of the weaker axis where there are two.
    blur
        Predicted σ in units of what the same amplitude reaches alone, on the axis that carries the depth.
    """

    shape: tuple[int, ...]
    pixels: NDArray[np.intp]
    u: dict[Axis, NDArray[np.float32]]
    sigma: dict[Axis, NDArray[np.float32]]
    bounce: dict[Axis, NDArray[np.float32]]
    plausible: NDArray[np.bool_]
    trusted: NDArray[np.bool_]
    third: NDArray[np.bool_]
    off_line: NDArray[np.bool_]
    located: NDArray[np.bool_]
    strength: NDArray[np.float32]
    blur: NDArray[np.float32]


def separate_region(
    frames: RoundPhasors,
    decoded: dict[Axis, DecodedAxis],
    detection: Detection,
    clean: NDArray[np.bool_],
    setup: Setup,
) -> Separated:
    """Two paths of every region pixel on every axis, and which of them is direct.

    Parameters
    ----------
    frames, decoded, detection
        Round one.
    clean
        (H, W) bool, pixels that see one path, beyond doubt: they show how firmly the axes hang together.
    setup
        Rig, if there is one.
    """
    pixels = np.flatnonzero(detection.region)
    axes: tuple[Axis, ...] = tuple(decoded)
    if not pixels.size or any(not _separable(phasors_of(frames, a).frequency, frames.plan.extent(a)) for a in axes):
        nan = np.full(pixels.size, np.nan, np.float32)
        no = np.zeros(pixels.size, bool)
        unknown = dict.fromkeys(axes, nan)
        return Separated(detection.region.shape, pixels, unknown, unknown, unknown, no, no, no, no, no, nan, nan)
    said = {a: _said(frames, a, decoded[a], pixels, detection.excess_noise) for a in axes}
    if setup.rig is not None and len(axes) == 2:
        coupling = _coupling(setup.rig, decoded, clean)
        return _together(setup.rig, coupling, decoded, detection, pixels, said, clean)
    return _apart(detection, pixels, said)


def _together(
    rig: Rig,
    coupling: Coupling,
    decoded: dict[Axis, DecodedAxis],
    detection: Detection,
    pixels: NDArray[np.intp],
    said: dict[Axis, AxisPhasorsOf],
    clean: NDArray[np.bool_],
) -> Separated:
    found = separate_jointly(rig, pixels, said, coupling)
    limit = chi2_distribution.isf(1 / _REFUSED_ONE_IN, found.dof)
    # Neighbours: the surface around the region, and the region's own pixels that their data decide.
    sure = (found.best.chi2 < limit) & (found.confidence > _CLEAR_PLACE)
    known = clean.copy()
    known.reshape(-1)[pixels[sure]] = True
    planes = []
    for k, axis in enumerate(("x", "y")):
        plane = decoded[axis].coordinates.u.copy()  # type: ignore[index]
        plane.reshape(-1)[pixels] = found.best.direct[k]
        planes.append(plane)
    found = ask_neighbours(found, pixels, known, planes[0], planes[1], _CLEAR_PLACE)
    best = found.best
    plausible = best.chi2 < limit
    clear = plausible & (found.confidence > _CLEAR_PLACE)
    fringe_px = 1 / float(np.mean(said["y" if found.along == 0 else "x"].frequency))
    trusted = clear & corroborated(found, pixels, detection.region.shape, clear, fringe_px)
    blur = [
        best.sigma[k] / _alone(said[a], best.amplitude[0, k])  # type: ignore[index]
        for k, a in enumerate(("x", "y"))
    ]
    return Separated(
        detection.region.shape,
        pixels,
        {"x": best.direct[0], "y": best.direct[1]},
        {"x": best.sigma[0], "y": best.sigma[1]},
        {"x": best.bounce[0], "y": best.bounce[1]},
        plausible,
        trusted,
        found.third,
        ~plausible & ~found.third,
        # Who lights whom is said by many pixels together: there a doubted separation still counts.
        clear,
        np.asarray((best.amplitude[1] / best.amplitude[0]).min(axis=0), np.float32),
        np.asarray(blur[found.along], np.float32),
    )


def _apart(detection: Detection, pixels: NDArray[np.intp], said: dict[Axis, AxisPhasorsOf]) -> Separated:
    found = {a: separate_two_paths(s.z, s.frequency, s.sigma_z, s.extent, s.gain) for a, s in said.items()}
    choice = choose_direct(*found.values())
    column = np.arange(pixels.size)
    picks = dict(zip(found, (choice.ix, choice.iy), strict=False))
    plausible = choice.confidence > 0
    clear = choice.confidence > _CLEAR_CHOICE
    third = np.zeros(pixels.size, bool)
    strength = np.full(pixels.size, np.inf, np.float32)
    blur = np.zeros(pixels.size, np.float32)
    u, spread, bounce = {}, {}, {}
    for axis, two in found.items():
        pick = picks[axis]
        u[axis], spread[axis] = two.u[pick, column], two.sigma_u[pick, column]
        bounce[axis] = two.u[1 - pick, column]
        fits = two.chi2 < chi2_distribution.isf(1 / _REFUSED_ONE_IN, two.dof)
        third |= two.converged & ~fits
        plausible &= two.converged & fits
        clear &= two.margin > _CLEAR_ORDERS
        strength = np.fmin(strength, two.amplitude[1 - pick, column] / two.amplitude[pick, column])
        blur = np.fmax(blur, spread[axis] / _alone(said[axis], two.amplitude[pick, column]))
    no, trusted = np.zeros(pixels.size, bool), plausible & clear
    return Separated(
        detection.region.shape,
        pixels,
        u,
        spread,
        bounce,
        plausible,
        trusted,
        third,
        no,
        trusted,
        strength,
        blur,
    )


def _coupling(rig: Rig, decoded: dict[Axis, DecodedAxis], clean: NDArray[np.bool_]) -> Coupling:
    pixels = np.flatnonzero(clean)
    x, y = decoded["x"].coordinates, decoded["y"].coordinates
    taken = (m.reshape(-1)[pixels] for m in (x.u, y.u, np.hypot(x.sigma, y.sigma), x.amplitude, y.amplitude))
    return measure_coupling(rig, pixels, *taken)


def _said(
    frames: RoundPhasors, axis: Axis, decoded: DecodedAxis, pixels: NDArray[np.intp], excess_noise: float
) -> AxisPhasorsOf:
    phasors = phasors_of(frames, axis)
    z = phasors.z.reshape(len(phasors.frequency), -1)[:, pixels]
    sigma_z = decoded.sigma_z.reshape(-1)[pixels] * np.float32(np.sqrt(excess_noise))
    return AxisPhasorsOf(z, phasors.frequency, sigma_z, frames.plan.extent(axis), decoded.gain)


def _alone(said: AxisPhasorsOf, amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    """σ of a coordinate whose path of that amplitude is the only one, px."""
    information = 2 * np.pi * np.sqrt(np.square(said.gain * said.frequency).sum())
    return np.asarray(said.sigma_z / (information * amplitude), np.float32)


def phasors_of(frames: RoundPhasors, axis: Axis) -> AxisPhasors:
    """Phasors of an axis that is there."""
    phasors = frames.axis(axis)
    assert phasors is not None
    return phasors


def _separable(frequency: NDArray[np.float64], extent: int) -> bool:
    """Whether two paths can be separated with these frequencies: what `separate_two_paths` asks for."""
    gaps = np.diff(np.sort(frequency))
    return frequency.size >= 5 and bool(np.allclose(gaps, gaps[0], rtol=1e-6)) and gaps[0] * extent <= 1 + 1e-9
