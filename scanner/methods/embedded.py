"""Embedded phase shifting (Moreno, Son & Taubin, CVPR 2015): low frequencies hidden in the differences of high ones.

For numbers T₁..T_M above 1 the embedded frequencies are F_m = 1/(T₁ ⋯ T_m); the patterns have f₁ = F₁ and
f_m = F₁ + F_m, all high, so that diffuse bounces average out. Three steps of f₁ and two of each other suffice, because
all share one mean: 2M + 1 frames an axis. The phase of f_m minus that of f₁ belongs to F_m; from the lowest, which
spans the picture, each unwraps the next higher, down to f₁ and to all f_m, whose coordinates are averaged.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers import NoiseModel, Pixels
from scanner.config import ScanSection
from scanner.methods.base import (
    FirstRound,
    KeptFrames,
    MeasuredAxis,
    OneRound,
    PlanError,
    RoundFrames,
    Setup,
    undetected_maps,
)
from scanner.patterns import Fringe, FringeSequence, Plan
from scanner.unwrapping import Coordinates

_STEPS = 3
_FINE_PX, _LEVELS = 16, 4


def embedded_frequencies(extent: int) -> tuple[float, ...]:
    """f₁..f_M (1/px) with T₁ = 16 px and equal T₂..T_M whose product spans ``extent`` px: M = 4, nine frames."""
    ratio = (extent / _FINE_PX) ** (1 / (_LEVELS - 1))
    first = 1 / _FINE_PX
    return (first, *(first + first / ratio**m for m in range(1, _LEVELS)))


@dataclass(frozen=True)
class EmbeddedPhaseShifting(OneRound):
    """EPS in 2M + 1 patterns an axis, one round."""

    name: str = "embedded"
    title: str = "Embedded phase shifting (Moreno, Son & Taubin, CVPR 2015)"

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """One sequence an axis."""
        sequences = []
        for axis in scan.axes:
            extent = size[0] if axis == "x" else size[1]
            frequencies = scan.frequencies(axis) or embedded_frequencies(extent)
            embedded = [f - frequencies[0] for f in frequencies[1:]]
            falling = all(a > b for a, b in itertools.pairwise((*embedded, 0.0)))
            if not embedded or not falling or embedded[-1] * extent > 1 + 1e-9 or max(frequencies) >= 0.5:
                raise PlanError(
                    f"scan, axis {axis}: embedded with frequencies {frequencies} 1/px",
                    f"Give f₁ and f₁ + F₂, f₁ + F₃ …, the F falling to 1/{extent} 1/px, all below 1/2; null takes "
                    "the method's own.",
                )
            first = [Fringe(frequencies[0], 2 * math.pi * n / _STEPS) for n in range(_STEPS)]
            others = [Fringe(f, step) for f in frequencies[1:] for step in (0.0, math.pi / 2)]
            sequences.append(FringeSequence(axis, (*first, *others)))
        return Plan(size, tuple(sequences), scan.mean, scan.amplitude)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Embedded phases, unwrapped from the lowest to the pattern's own."""
        assert isinstance(frames, KeptFrames)
        axes = []
        for number, pixels in sorted(frames.frames.items()):
            fringes = frames.plan.sequences[number]
            assert isinstance(fringes, FringeSequence)
            axes.append(_unembed(pixels, fringes, frames.plan.extent(fringes.axis), setup.noise))
        return FirstRound(undetected_maps(axes, frames.saturated, setup), frames.plan)


def _unembed(frames: Pixels, fringes: FringeSequence, extent: int, noise: NoiseModel) -> MeasuredAxis:
    turns = np.exp(-1j * fringes.steps_rad[:_STEPS])
    first = frames[:_STEPS].astype(np.float32)
    mean = first.mean(axis=0)
    z = [np.asarray(np.tensordot(turns, first, 1) * (2 / _STEPS), np.complex64)]
    for k in range(_STEPS, len(frames), 2):
        z.append((frames[k] - mean) - 1j * (frames[k + 1] - mean))
    frequency = np.array([f.frequency for f in (fringes.fringes[0], *fringes.fringes[_STEPS::2])])
    amplitude = np.abs(z[0])
    sigma_i = np.sqrt(np.asarray(noise.variance(mean), np.float32))
    # Of one phasor component: 2/3 of a frame's variance, and a frame against the mean of three.
    sigma_z = [sigma_i * np.float32(math.sqrt(v)) for v in (2 / _STEPS, *[1 + 1 / _STEPS] * (len(z) - 1))]
    safe = np.maximum(amplitude, np.float32(1e-6))

    lowest = z[-1] * z[0].conj()
    # Within -1/2 .. extent - 1/2: column 0 under noise stays column 0.
    u = _within(np.angle(lowest) / (2 * np.pi * (frequency[-1] - frequency[0])), frequency[-1] - frequency[0])
    sigma_u = np.asarray(
        np.hypot(sigma_z[0], sigma_z[-1]) / safe / np.float32(2 * np.pi * (frequency[-1] - frequency[0])), np.float32
    )
    lead = np.full(u.shape, np.inf, np.float32)
    steps = [
        (z[m] * z[0].conj(), frequency[m] - frequency[0], np.hypot(sigma_z[0], sigma_z[m]))
        for m in range(len(z) - 2, 0, -1)
    ]
    for phasor, f, sigma in (*steps, (z[0], frequency[0], sigma_z[0])):
        u, sigma_u, margin = _refined(u, sigma_u, phasor, f, np.asarray(sigma / safe, np.float32))
        lead = np.minimum(lead, margin)
    found, weights = [u], [1 / np.square(sigma_u)]
    for phasor, f, sigma in zip(z[1:], frequency[1:], sigma_z[1:], strict=True):
        fine, sigma_fine, margin = _refined(u, sigma_u, phasor, f, np.asarray(sigma / safe, np.float32))
        lead = np.minimum(lead, margin)
        found.append(fine)
        weights.append(1 / np.square(sigma_fine))
    total = np.sum(weights, axis=0)
    average = np.asarray(np.sum([w * v for w, v in zip(weights, found, strict=True)], axis=0) / total, np.float32)
    inside = (average >= -0.5) & (average <= extent - 0.5)
    coordinates = Coordinates(
        axis=fringes.axis,
        u=average,
        sigma=np.asarray(1 / np.sqrt(total), np.float32),
        amplitude=np.asarray(amplitude, np.float32),
        chi2=np.sum([w * (v - average) ** 2 for w, v in zip(weights, found, strict=True)], axis=0, dtype=np.float32),
        dof=len(z) - 1,
        lead=np.where(inside, lead, np.float32(0)),
    )
    return MeasuredAxis(coordinates, mean, sigma_z[0])


def _within(u: NDArray[np.floating], frequency: float) -> NDArray[np.float32]:
    """Shift by whole periods into -1/2 .. period - 1/2."""
    return np.asarray((u + 0.5) % (1 / frequency) - 0.5, np.float32)


def _refined(
    u: NDArray[np.float32],
    sigma_u: NDArray[np.float32],
    phasor: NDArray[np.complex64],
    frequency: float,
    sigma_phase: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Coordinate from a higher frequency, of the order nearest to ``u``; its σ, and how clear that order is."""
    fine = np.angle(phasor) / np.float32(2 * np.pi * frequency)
    order = (u - fine) * np.float32(frequency)
    whole = np.rint(order)
    sigma_fine = np.asarray(sigma_phase / np.float32(2 * np.pi * frequency), np.float32)
    variance = (np.square(sigma_u) + np.square(sigma_fine)) * np.float32(frequency**2)
    # Log-likelihood ratio of the nearest order against the next: ((1 - r)² - r²)/(2σ²).
    lead = (1 - 2 * np.abs(order - whole)) / (2 * variance)
    return np.asarray(fine + whole / frequency, np.float32), sigma_fine, np.asarray(lead, np.float32)
