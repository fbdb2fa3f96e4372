"""Plain NumPy twin of the separation, one pixel at a time: slow, and without any shortcut."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from scanner.paths.kernels import Phasors, Reals
from scanner.paths.separation import TwoPaths, two_paths


def separate_two_paths_twin(
    z: ArrayLike, frequency: ArrayLike, sigma_z: float, extent: float, gain: ArrayLike | None = None, reach: int = 2
) -> TwoPaths:
    """Plain NumPy twin of `separate_two_paths` for one pixel.

    Complex matrix pencil by singular value decomposition, every pair of fringe orders up to ``reach`` to either side,
    bounded least squares from each.

    Parameters
    ----------
    z
        (T,) complex phasors, DN.
    frequency, sigma_z, extent, gain
        As in `separate_two_paths`; ``sigma_z`` of the one pixel.
    reach
        Fringe orders tried to either side.
    """
    f, z = np.asarray(frequency, np.float64), np.asarray(z, np.complex128)
    m = np.ones(f.size) if gain is None else np.asarray(gain, np.float64)
    centre = m**2 @ f / (m @ m)
    windows = np.lib.stride_tricks.sliding_window_view(z / m, f.size // 2 + 1)
    signal = np.linalg.svd(np.vstack([windows, windows[:, ::-1].conj()]))[2][:2].T
    poles = np.linalg.eigvals(np.linalg.lstsq(signal[:-1], signal[1:])[0])
    coarse = np.angle(poles) / (2 * np.pi * (f[1] - f[0])) % (1 / (f[1] - f[0]))

    def model(p: Reals) -> tuple[Phasors, Phasors]:
        """Phasors of (a₁, u₁, a₂, u₂) and their derivatives (T, 4)."""
        first, second = (m * np.exp(2j * np.pi * f * u) for u in (p[1], p[3]))
        turn = 2j * np.pi * f
        slopes = np.stack([first, p[0] * turn * first, second, p[2] * turn * second], axis=1)
        return p[0] * first + p[2] * second, slopes

    def misfit(p: Reals) -> Reals:
        off = model(p)[0] - z
        return np.concatenate([off.real, off.imag]) / sigma_z

    def jacobian_of(p: Reals) -> Reals:
        slopes = model(p)[1]
        return np.concatenate([slopes.real, slopes.imag]) / sigma_z

    solutions: list[tuple[float, float, Reals]] = []
    for orders in np.ndindex(2 * reach + 1, 2 * reach + 1):
        near = coarse + (np.array(orders) - reach) / centre
        residues = np.linalg.lstsq(m[:, None] * np.exp(2j * np.pi * np.outer(f - centre, near)), z)[0]
        cycles = np.angle(residues) / (2 * np.pi) - centre * near
        fine = near + (cycles - np.round(cycles)) / centre
        start = np.array([abs(residues[0]), fine[0], abs(residues[1]), fine[1]])
        fit = least_squares(
            misfit,
            start,
            jacobian_of,
            bounds=([0, -np.inf, 0, -np.inf], np.inf),
            x_scale=[1.0, 0.1, 1.0, 0.1],
            ftol=1e-10,
        )
        p = fit.x if fit.x[0] >= fit.x[2] else fit.x[[2, 3, 0, 1]]
        p[1::2] = (p[1::2] + 0.5) % (1 / (f[1] - f[0])) - 0.5
        if np.all(p[::2] > 0) and np.all(p[1::2] < extent - 0.5):
            chi2 = 2 * fit.cost
            solutions.append((chi2 + 2 * math.log(p[0] + p[2]), chi2, p))
    solutions.sort(key=lambda solution: solution[0])
    score, chi2, p = solutions[0]
    others = (s[0] - score for s in solutions if np.abs(s[2] - p)[1::2].max() > 0.1 / centre)
    jacobian = jacobian_of(p)
    sigma = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    column = [p[1], p[3], p[0], p[2], sigma[1], sigma[3], sigma[0], chi2, next(others, math.inf)]
    return two_paths(np.array(column, np.float32)[:, None], f.size)


def refine_jointly_twin(
    z: tuple[Phasors, Phasors],
    frequency: tuple[Reals, Reals],
    sigma_z: tuple[float, float],
    start: ArrayLike,
    line: tuple[float, float, float, float],
    log_ratio: tuple[float, float, float],
) -> tuple[Reals, Reals, float]:
    """Plain twin of the refinement in `scanner.paths.separate_jointly`, for one pixel and one hypothesis.

    Parameters
    ----------
    z, frequency, sigma_z
        Phasors (T,), f_t and noise of the axis along the epipolar line and of that across it.
    start
        (8,) u₁, u₂, a₁, a₂ along, the same across; path 1 is direct.
    line
        Place along, place across, slope, and σ across, of the epipolar line.
    log_ratio
        ln κ, and σ of the log ratio of the direct path and of the bounce.

    Returns
    -------
    parameters, sigma, chi2
        (8,), (8,) from the inverse Fisher matrix, and the sum of squares.
    """

    def misfit(p: Reals) -> Reals:
        off = [
            (z[k] - np.exp(2j * np.pi * np.outer(frequency[k], q[:2])) @ q[2:]) / sigma_z[k]
            for k, q in enumerate((p[:4], p[4:]))
        ]
        priors = [
            (p[4] - line[1] - line[2] * (p[0] - line[0])) / line[3],
            *((np.log(p[6 + k] / p[2 + k]) - log_ratio[0]) / log_ratio[1 + k] for k in range(2)),
        ]
        return np.concatenate([*(part for o in off for part in (o.real, o.imag)), priors])

    first = np.asarray(start, np.float64)
    scale = np.tile([0.1, 0.1, 1.0, 1.0], 2)
    fit = least_squares(misfit, first, x_scale=scale, ftol=1e-12, xtol=1e-12)
    jacobian = np.asarray(fit.jac, np.float64)
    return fit.x, np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))), float(2 * fit.cost)
