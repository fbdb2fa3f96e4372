"""Two-path separation of both axes together, where a rig is known: the direct path is the one on the epipolar line.

An axis by itself cannot separate paths that lie within a fringe of each other on it, nor tell which of them is direct.
Both axes together can: the direct pair (x₁, y₁) lies on the pixel's epipolar line, and a path has the same modulation
on both axes, up to the optics' MTF. With the data of both axes these are three more terms of one sum of squares,

    χ² = Σ_axes Σ_t |z_t - m_t Σ_k a_k e^{i2πf_t u_k}|²/σ_z² + (d/σ_d)² + Σ_k (ln(a_k^y/a_k^x) - ln κ)²/σ_k²,

d the distance from the line. The fits of the axis *along* the line are the hypotheses, each with either of its paths as
the direct one; the line then says where the direct path lies *across* it, and the bounce is what it leaves there. Where
the axis along cannot separate, the fits of the axis across bring the amplitudes along instead. All eight parameters are
refined by Levenberg-Marquardt, and hypotheses are compared by their evidence in Laplace's approximation (MacKay,
Information Theory, Inference and Learning Algorithms, 2003, ch. 27-28).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from scanner.paths.comb import prepare
from scanner.paths.joint_kernels import FIELDS, ROWS, fit_workspace, joint_block
from scanner.paths.joint_nearby import Profiles, workspace
from scanner.paths.joint_seeds import PAIRS, seed_block, seed_workspace
from scanner.paths.kernels import Floats
from scanner.paths.separation import CORES, separate_candidates
from scanner.patterns import Axis
from scanner.rig import Lens, Rig
from scanner.triangulation import epipolar_crossings

LARGER_IS_DIRECT = 0.9
"""Of bounces, the share that is weaker than the direct light (method.md §6)."""
PRIORS = 3
"""Terms of χ² beside the data: the line and the two ratios."""

REFUSED_ONE_IN = 1e4
"""Of good fits one in so many is refused by its own χ²."""

_BLOCK = 256
"""Pixels that a thread works on at a time: their hypotheses stay in its cache."""
_SURE, _SURE_SIGMAS = 7.0, 4.0
"""A hypothesis of the axis along that is e⁷ times as likely as its rival and fits needs no other seed,"""
_CLOSE_PX = 48.0
"""unless its paths lie nearer to each other than this, where the axis along mistakes the fringe orders."""
_ANYHOW = -math.inf, math.inf, 0.0
"""Least lead over a rival, most χ², and least distance along of a pixel that is decided now: each is."""
_UNKNOWN_LINE_PX, _LEAST_LINE_PX = 0.1, 0.02
"""Error of a calibrated rig where the scan itself does not show it, and the least that is believed, px."""
_UNKNOWN_RATIO, _LEAST_RATIO = 0.05, 0.01
"""The same of the modulation's ratio between the axes, relative."""
_BOUNCE_RATIO = 0.15
"""Relative σ of the ratio of a bounce, whose mirror or lobe may blur one axis more than the other."""


@dataclass(frozen=True)
class AxisPhasorsOf:
    """What one axis says about P pixels.

    Parameters
    ----------
    z
        (T, P) complex64 phasors, DN.
    frequency
        (T,) f_t, 1/px, as `scanner.paths.separate_two_paths`.
    sigma_z
        (P,) standard deviation of Re z and of Im z, DN.
    extent
        Projector pixels along the axis.
    gain
        (T,) common modulation trend.
    """

    z: NDArray[np.complex64]
    frequency: NDArray[np.float64]
    sigma_z: NDArray[np.float32]
    extent: int
    gain: NDArray[np.float64]


@dataclass(frozen=True)
class Coupling:
    """How firmly the axes hang together, as the clean pixels of the same scan show it (`measure_coupling`).

    Parameters
    ----------
    line_px
        Standard deviation of a direct pair's distance from its epipolar line, without its noise, px.
    log_ratio
        ln κ, κ the modulation of a path along y over that along x.
    ratio
        Standard deviation of that over the pixels.
    """

    line_px: float = _UNKNOWN_LINE_PX
    log_ratio: float = 0.0
    ratio: float = _UNKNOWN_RATIO


@dataclass(frozen=True)
class PathPair:
    """Both paths of every pixel on both axes, arrays (P,) or more, NaN where there is none; axes in the order x, y.

    Parameters
    ----------
    direct, sigma
        (2, P) the direct coordinates by axis, and their predicted standard deviations, px.
    bounce, sigma_bounce
        (2, P) those of the other path.
    amplitude, sigma_amplitude
        (2, 2, P) modulation of the (direct, bounce) by axis, ``amplitude[path, axis]``, DN.
    chi2
        (P,) χ² of data and priors together.
    """

    direct: Floats
    sigma: Floats
    bounce: Floats
    sigma_bounce: Floats
    amplitude: Floats
    sigma_amplitude: Floats
    chi2: Floats


@dataclass(frozen=True)
class DirectPaths:
    """The likeliest paths of every pixel, and their rival.

    Parameters
    ----------
    best
        The likeliest.
    rival
        The likeliest with another direct place.
    confidence
        (P,) ln of the odds of the best against its rival; infinite where there is none, NaN where there is neither.
    third
        (P,) bool, one axis by itself does not fit two paths either: there are more.
    dof
        Degrees of freedom of χ²: data of both axes less eight, and the priors.
    along
        0 where the epipolar lines run along x, 1 where along y: the axis that carries the depth.
    """

    best: PathPair
    rival: PathPair
    confidence: Floats
    third: NDArray[np.bool_]
    dof: int
    along: int


def measure_coupling(
    rig: Rig,
    pixels: NDArray[np.intp],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    sigma: NDArray[np.float32],
    amplitude_x: NDArray[np.float32],
    amplitude_y: NDArray[np.float32],
) -> Coupling:
    """Measure on clean pixels how firmly both axes hang together.

    Parameters
    ----------
    rig
        Calibrated rig.
    pixels
        (P,) flat numbers of camera pixels that see one path.
    x, y, sigma, amplitude_x, amplitude_y
        (P,) their coordinates, the noise of these, px, and their modulation on either axis, DN.
    """
    few = pixels[:: max(1, pixels.size // 20_000)]
    if few.size < 100:
        return Coupling()
    pick = slice(None, None, max(1, pixels.size // 20_000))
    other, slope = epipolar_crossings(rig, few, x[None, pick], "x")
    distance = (y[pick] - other[0]) / np.hypot(1, slope[0])
    line = math.sqrt(max(_robust(distance) ** 2 - float(np.median(sigma[pick])) ** 2, _LEAST_LINE_PX**2))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = np.log(amplitude_y[pick] / amplitude_x[pick])
    known = log_ratio[np.isfinite(log_ratio)]
    if known.size < 100:
        return Coupling(line_px=line)
    middle = float(np.median(known))
    return Coupling(line, middle, max(_robust(known - middle), _LEAST_RATIO))


def _robust(off: NDArray[np.float64] | NDArray[np.float32]) -> float:
    """σ about zero from the median, or from the 95 % point where that says more."""
    size = np.abs(off[np.isfinite(off)])
    return float(max(np.median(size) / 0.6745, np.quantile(size, 0.95) / 1.96)) if size.size else math.inf


def separate_jointly(
    rig: Rig, pixels: NDArray[np.intp], axes: Mapping[Axis, AxisPhasorsOf], coupling: Coupling
) -> DirectPaths:
    """Separate both paths of pixels on both axes, and say which is direct.

    Parameters
    ----------
    rig
        Calibrated rig.
    pixels
        (P,) flat numbers of the camera pixels.
    axes
        What x and y say about them.
    coupling
        How firmly the axes hang together.

    Raises
    ------
    SeparationPlanError
        As `scanner.paths.separate_two_paths`.

    Notes
    -----
    The search is not exhaustive: where σ is 10 DN and the paths are 20-60 px apart along the line it returns the direct
    path in 95.6-96.1 % of pixels, and in 98.3 % when the true paths are among its starts as well, which bounds maximum
    likelihood from above. With six fits kept per axis it gains 1 %, for a third more time. Two thirds of
    what it loses lie closer than 60 px on both axes.
    """
    along: Axis = _along(rig)
    across: Axis = "y" if along == "x" else "x"
    a, b = axes[along], axes[across]
    fits = separate_candidates(a.z, a.frequency, a.sigma_z, a.extent, a.gain)
    places = fits[:, :2].reshape(2 * len(fits), pixels.size)
    other, slope = (np.ascontiguousarray(v, np.float64) for v in epipolar_crossings(rig, pixels, places, along))
    log_ratio = coupling.log_ratio if along == "x" else -coupling.log_ratio
    prior = np.array([0, 0, 0, coupling.line_px, log_ratio, coupling.ratio, _BOUNCE_RATIO])
    out = np.full((ROWS, pixels.size), np.nan, np.float32)
    za, sigma_a, comb_a = prepare(a.z, a.frequency, a.sigma_z, a.extent, a.gain)
    zb, sigma_b, comb_b = prepare(b.z, b.frequency, b.sigma_z, b.extent, b.gain)
    comb = np.array([*comb_a.start_and_step, *comb_b.start_and_step])
    profiles_a, profiles_b = Profiles.of(comb_a), Profiles.of(comb_b)
    dof = 2 * (len(a.frequency) + len(b.frequency)) - 8 + PRIORS

    def decide(these: NDArray[np.intp], fits_across: Floats, undecided_if: tuple[float, float, float]) -> None:
        if not these.size:
            return
        most = 2 * len(fits) + 2 * PAIRS * len(fits_across)
        spare: SimpleQueue[Any] = SimpleQueue()
        for _ in range(CORES):
            near = workspace(profiles_a, profiles_b)
            hypotheses = np.empty((_BLOCK, most, 8)), np.empty((_BLOCK, most, 3)), np.empty((_BLOCK, most))
            for_seeds, for_fits = seed_workspace(len(za), len(zb), comb), fit_workspace(len(za), len(zb), most, near)
            spare.put((for_seeds, *hypotheses, near, for_fits))

        def joint(start: int) -> None:
            for_seeds, seeds, lines, bounds, near, for_fits = arrays = spare.get()
            try:
                data = (
                    za, zb, sigma_a, sigma_b, comb_a.gain, comb_b.gain, comb, -0.5, a.extent - 0.5, -0.5,
                    b.extent - 0.5, these[start : start + _BLOCK],
                )  # fmt: skip
                seed_block(*data, fits, other, slope, fits_across, prior, start, for_seeds, seeds, lines, bounds)
                joint_block(
                    *data, seeds, lines, bounds, prior, LARGER_IS_DIRECT, profiles_a.arrays, profiles_b.arrays, near,
                    for_fits, undecided_if, out,
                )  # fmt: skip
            finally:
                spare.put(arrays)

        with ThreadPoolExecutor(CORES) as pool:
            list(pool.map(joint, range(0, these.size, _BLOCK)))

    def ask_across(these: NDArray[np.intp]) -> None:
        fits_across = separate_candidates(b.z[:, these], b.frequency, b.sigma_z[these], b.extent, b.gain)
        decide(these, fits_across, _ANYHOW)
        third[these] |= _too_many(fits_across, len(b.frequency))

    third = _too_many(fits, len(a.frequency))
    far = np.abs(fits[0, 0] - fits[0, 1]) > _CLOSE_PX
    limits = _SURE, dof + _SURE_SIGMAS * math.sqrt(2 * dof), _CLOSE_PX
    decide(np.flatnonzero(far), np.empty((0, *fits.shape[1:]), np.float32), limits)
    confidence, chi2 = out[2 * FIELDS], out[FIELDS - 1]
    sure = far & (confidence > limits[0]) & (chi2 < limits[1])
    ask_across(np.flatnonzero(~(sure & (np.abs(out[0] - out[1]) > _CLOSE_PX))))
    order = [0, 1] if along == "x" else [1, 0]
    best, rival = (_pair(out[k * FIELDS : (k + 1) * FIELDS], order) for k in range(2))
    fits_together = best.chi2 < chi2_distribution.isf(1 / REFUSED_ONE_IN, dof)
    return DirectPaths(best, rival, confidence, third & ~fits_together, dof, order[0])


def _pair(rows: Floats, order: list[int]) -> PathPair:
    """Rows of the kernel, axes in the order x, y."""
    along, across = np.stack([rows[:4], rows[8:12]]), np.stack([rows[4:8], rows[12:16]])
    value, sigma = np.stack([along, across])[order].transpose(1, 2, 0, 3)
    return PathPair(value[0], sigma[0], value[1], sigma[1], value[2:], sigma[2:], rows[16])


def _too_many(fits: Floats, count: int) -> NDArray[np.bool_]:
    """Whether the best fit of one axis leaves more than two paths of noise."""
    return np.asarray(fits[0, 7] > chi2_distribution.isf(1 / REFUSED_ONE_IN, 2 * count - 4))


def _along(rig: Rig) -> Axis:
    """The axis that the epipolar line of the picture's middle runs along."""
    width, height = rig.camera.size
    line = rig.epipolar_line([(width - 1) / 2, (height - 1) / 2])
    return "x" if abs(line[1]) >= abs(line[0]) else "y"


def compile_all() -> None:
    """Compile the joint kernels into Numba's cache, so that no scan waits for it."""
    lens = Lens(np.eye(3), np.empty(0), (2, 1))
    rig = Rig(lens, lens, np.eye(3), np.array([1.0, 0.0, 0.0]))
    frequency = np.arange(80, 89) / 1280
    one = AxisPhasorsOf(np.ones((9, 1), np.complex64), frequency, np.ones(1, np.float32), 1280, np.ones(9))
    separate_jointly(rig, np.zeros(1, np.intp), {"x": one, "y": one}, Coupling())
