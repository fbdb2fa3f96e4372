"""What is wrong with a sequence of several frequencies of which no single code frame is to blame.

Of all its frames together two things are known. Harmonics of the projector go with the phases in the same way in every
frame, errors do not. And an error of one of the three steps, which moves the phase and with it the coordinate, moves
all codes in a way that is known as well: over many pixels it is seen where no pixel shows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.findings import SEQUENCE, Finding
from scanner.integrity.waveform import HARMFUL
from scanner.patterns import FringeSequence
from scanner.unwrapping import Coordinates

STEPS = 3
"""Frames of the first frequency; one of each other follows."""

_EXPLAINED = 0.5
_REFUSED = 0.2
_MISFITTING = 0.65
"""Bounces spoil the codes of some pixels and leave the others alone; wrong frames spoil those of nearly all."""

_LARGE = 0.03
"""Mean square of the error of a frame, in units of B², of which several hide each other by making all codes wrong."""

_ONE_IN = 0.01
_BY_CHANCE = 1e-9


@dataclass(frozen=True)
class Codes:
    """What a code of K single frames says of P pixels.

    Parameters
    ----------
    first
        (P,) phase of the first frequency, rad.
    steps
        (3,) of its frames.
    phases
        (K, P) phases that the single frames must have there, their steps included.
    ratio
        (K,) frequencies in units of the first.
    off
        (K, P) grey values beyond those of the code, DN.
    amplitude
        (P,) modulation, DN.
    misfit
        (P,) χ² of K degrees of freedom.
    sigma_dn
        Noise of a grey value.
    """

    first: NDArray[np.float64]
    steps: NDArray[np.float64]
    phases: NDArray[np.float64]
    ratio: NDArray[np.float64]
    off: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    misfit: NDArray[np.float64]
    sigma_dn: float

    @classmethod
    def of(cls, values: NDArray[np.float32], fringes: FringeSequence, found: Coordinates, sigma_dn: float) -> Codes:
        """Of (N, P) grey values and the coordinates that were ``found`` in them."""
        u, amplitude = found.u[0].astype(np.float64), np.maximum(found.amplitude[0].astype(np.float64), 1e-6)
        frequency = np.array([f.frequency for f in fringes.fringes[STEPS:]])
        start = float(fringes.fringes[0].frequency)
        phases = 2 * np.pi * frequency[:, None] * u + fringes.steps_rad[STEPS:, None]
        off = values[STEPS:] - values[:STEPS].mean(axis=0) - amplitude * np.cos(phases)
        first = 2 * np.pi * start * u
        misfit = found.chi2[0].astype(np.float64)
        return cls(first, fringes.steps_rad[:STEPS], phases, frequency / start, off, amplitude, misfit, sigma_dn)

    def harmonics(self) -> NDArray[np.float64]:
        """(5, K, P) what the second and third harmonic make of the codes, DN for a share of 1.

        cos 2φ and cos 3φ of the frame itself; and cos 3φ and sin 3φ of the first frequency, which three steps take for
        modulation, phase and mean.
        """
        thrice = 3 * (self.first + self.steps[0])
        shares = [
            np.cos(2 * self.phases),
            np.cos(3 * self.phases),
            np.cos(self.phases) * np.cos(thrice),
            np.sin(self.phases) * np.sin(thrice),
            np.broadcast_to(np.cos(thrice), self.phases.shape),
        ]
        return np.asarray(self.amplitude * np.stack(shares))

    def optics(self) -> NDArray[np.float64]:
        """(K, K, P) what a modulation that falls with the frequency makes of them."""
        return np.asarray(np.eye(len(self.ratio))[:, :, None] * (self.amplitude * np.cos(self.phases)))

    def of_step(self, step: int) -> NDArray[np.float64]:
        """(K, P) what one grey value too many in frame ``step`` of the first three makes of them."""
        angle = self.first + self.steps[step]
        modulation = 2 * np.cos(angle) * np.cos(self.phases)
        phase = 2 * np.sin(angle) * self.ratio[:, None] * np.sin(self.phases)
        return np.asarray(-(1 + modulation + phase) / 3)

    def whitening(self) -> NDArray[np.float64]:
        """(P, K, K) matrices that make the noise of the codes, most of which they share, independent and 1."""
        apart = self.phases.T[:, :, None] - self.phases.T[:, None, :]
        shared = (1 + 2 * np.cos(apart)) / 3
        return np.asarray(np.linalg.inv(np.linalg.cholesky(np.eye(len(self.ratio)) + shared)) / self.sigma_dn)


def code_errors(codes: Codes) -> list[Finding]:
    """Several wrong frames, or one of the first three."""
    if _several(codes):
        return [Finding(SEQUENCE, "the frames fit no code together: several are stale, torn or mixed")]
    return _wrong_step(codes)


def _several(codes: Codes) -> bool:
    """Whether the misfit of the codes is of several wrong frames, rather than of the harmonics of the waveform."""
    from scipy.stats import chi2

    degrees = len(codes.ratio)
    if np.median(codes.misfit) < degrees:
        return False
    energy = np.square(codes.off / codes.amplitude).sum(axis=0)
    kept = energy <= np.quantile(energy, 1 - _REFUSED)
    shapes = codes.harmonics() / codes.amplitude
    shares = np.linalg.lstsq(
        shapes[:, :, kept].reshape(len(shapes), -1).T, (codes.off / codes.amplitude)[:, kept].ravel(), rcond=None
    )[0]
    left = codes.off / codes.amplitude - np.tensordot(shares, shapes, 1)
    # χ² of a pixel falls by as much as the sum of its squares does.
    without = codes.misfit * np.square(left).sum(axis=0) / np.maximum(energy, 1e-12)
    misfitting = float((without > chi2.isf(_ONE_IN, degrees)).mean())
    before, after = float(np.median(codes.misfit)), float(np.median(without))
    large = float(np.median(np.square(left).mean(axis=0))) > _LARGE
    return large and misfitting > _MISFITTING and before - after < _EXPLAINED * (before - degrees)


def _wrong_step(codes: Codes) -> list[Finding]:
    """One of the first three frames, by an error that moves the phase by more than half its noise."""
    from scipy.stats import chi2

    degrees = len(codes.ratio)
    # Bounces fit no code; all may be off by a little.
    agreeing = chi2.isf(_REFUSED / 2, degrees) / chi2.median(degrees) * np.median(codes.misfit)
    votes = codes.misfit < agreeing
    white = codes.whitening()[votes]

    def whitened(shapes: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K · votes, S) of (S, K, P)."""
        return np.asarray(np.einsum("pij,sjp->pis", white, shapes[:, :, votes]).reshape(-1, len(shapes)))

    known = np.concatenate([codes.harmonics(), codes.optics()])
    basis = _orthonormal(whitened(known))
    errors = whitened(codes.off[None])[:, 0]
    errors = errors - basis @ (basis.T @ errors)
    total, count = float(errors @ errors), errors.size - basis.shape[1]
    found = []
    for step in range(STEPS):
        # Light that flickers is the same everywhere, a late shutter goes with A, a former picture with the fringe.
        b = codes.amplitude
        kinds = np.stack([np.ones_like(b), b, b * np.cos(codes.first), b * np.sin(codes.first)])
        parts = whitened(codes.of_step(step) * kinds[:, None])
        free = parts - basis @ (basis.T @ parts)
        scale = np.maximum(np.linalg.norm(parts, axis=0), 1e-12)
        values, vectors = np.linalg.eigh((free / scale).T @ (free / scale))
        sure = values > 1e-3
        along = vectors[:, sure].T @ ((free / scale).T @ errors)
        energy = float((along**2 / values[sure]).sum())
        size = (vectors[:, sure] @ (along / values[sure])) / scale
        moved = (size @ kinds)[votes] * np.sin(codes.first[votes] + codes.steps[step])
        harm = 2 / 3 * float(np.square(moved).mean()) / codes.sigma_dn**2
        noise = float(chi2.isf(_BY_CHANCE, max(int(sure.sum()), 1))) * max(1.0, (total - energy) / count)
        if harm > HARMFUL and energy > noise and energy > _EXPLAINED * (total - count):
            found.append((energy, step))
    if not found:
        return []
    step = max(found)[1]
    return [
        Finding(
            step, f"frame {step + 1} has moved the phase from where the codes have it: stale, torn, mixed or flickering"
        )
    ]


def _orthonormal(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Basis of the space of the columns."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    sure = values > 1e-6
    return np.asarray(scaled @ (vectors[:, sure] / np.sqrt(values[sure])))
