"""Micro phase shifting as Gupta & Nayar defined it (CVPR 2012): F + 2 patterns for F high frequencies.

Three steps of the first frequency, one pattern of each other: a linear system gives [O, A cos φ₁, A sin φ₁,
A cos φ₂ …]; divided by A it is compared with the code vectors of all projector columns, and φ₁ refines the nearest.

The frames have nothing to spare by which a wrong one could be told, and the frequencies are so near to each other that
over much of a picture each pattern is nearly the one before it: of a projector that lags, all pixels may fit codes of
other columns. Every second of the single patterns is therefore turned by half a period. That costs no frame and no
accuracy, and a frame that comes a pattern late is as wrong as can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drivers import NoiseModel, Pixels
from scanner import kernels
from scanner.config import ScanSection, check_plan_covers
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
from scanner.methods.multi_frequency import MPS_PERIODS_PX
from scanner.patterns import Fringe, FringeSequence, Plan
from scanner.unwrapping import Coordinates

_STEPS = 3


@dataclass(frozen=True)
class MicroPhaseShifting(OneRound):
    """MPS in F + 2 patterns an axis, one round."""

    name: str = "mps_gn"
    title: str = "Micro phase shifting in F + 2 patterns (Gupta & Nayar, CVPR 2012)"

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """One sequence an axis."""
        sequences = []
        for axis in scan.axes:
            frequencies = scan.frequencies(axis) or tuple(1 / p for p in MPS_PERIODS_PX)
            check_plan_covers(frequencies, size[0] if axis == "x" else size[1], axis)
            if len(frequencies) < 2 or max(frequencies) >= 0.5:
                raise PlanError(
                    f"scan, axis {axis}: mps_gn with frequencies {frequencies} 1/px",
                    "Give at least two frequencies below 1/2.",
                )
            first = [Fringe(frequencies[0], 2 * math.pi * n / _STEPS) for n in range(_STEPS)]
            single = [Fringe(f, math.pi * (n % 2)) for n, f in enumerate(frequencies[1:])]
            sequences.append(FringeSequence(axis, (*first, *single)))
        return Plan(size, tuple(sequences), scan.mean, scan.amplitude)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Nearest code vector, refined by φ₁."""
        assert isinstance(frames, KeptFrames)
        axes = []
        for number, pixels in sorted(frames.frames.items()):
            fringes = frames.plan.sequences[number]
            assert isinstance(fringes, FringeSequence)
            axes.append(nearest_code(pixels, fringes, frames.plan.extent(fringes.axis), setup.noise))
        return FirstRound(undetected_maps(axes, frames.saturated, setup), frames.plan)


def nearest_code(frames: Pixels, fringes: FringeSequence, extent: int, noise: NoiseModel) -> MeasuredAxis:
    """Coordinates of one axis from its (3 + M, H, W) frames: three steps of the first frequency, then any others."""
    shape = frames.shape[1:]
    pixels = frames[0].size
    flat = frames.reshape(len(frames), pixels)
    z = np.empty(pixels, np.complex64)
    mean, residual, saturated = np.zeros(pixels, np.float32), np.zeros(pixels, np.float32), np.zeros(pixels, bool)
    steps = fringes.steps_rad[:_STEPS]
    kernels.demodulate(np.ascontiguousarray(flat[:_STEPS]), steps, 2**16, z, mean, residual, saturated)
    codes = fringes.fringes[_STEPS:]
    frequency = fringes.fringes[0].frequency
    sigma_i = np.sqrt(np.asarray(noise.variance(mean), np.float32))
    sigma_z = np.float32(math.sqrt(2 / _STEPS)) * sigma_i
    amplitude = np.abs(z)
    period = 1 / frequency
    u0 = np.asarray(np.angle(z) % (2 * np.pi) / (2 * np.pi) * period, np.float32)
    u, best, second = u0.copy(), np.full(pixels, np.inf, np.float32), np.full(pixels, np.inf, np.float32)

    def search(start: int, stop: int) -> None:
        here = slice(start, stop)
        code = (flat[_STEPS:, here] - mean[here]) / np.maximum(amplitude[here], 1e-6)
        for order in range(-1, math.ceil(extent / period) + 1):
            place = u0[here] + np.float32(order * period)
            cost = np.zeros(stop - start, np.float32)
            for k, f in enumerate(codes):
                angle = np.float32(2 * np.pi * f.frequency) * place + np.float32(f.step_rad)
                cost += (code[k] - np.cos(angle)) ** 2
            cost[(place < -0.5) | (place >= extent - 0.5)] = np.inf
            better = cost < best[here]
            second[here] = np.where(better, best[here], np.minimum(second[here], cost))
            best[here] = np.where(better, cost, best[here])
            u[here] = np.where(better, place, u[here])

    kernels.over_pixels(search, pixels)
    # One code element has the frame's own noise, and that of the mean and of the phase it is predicted from.
    scale = (amplitude / sigma_i) ** 2 / np.float32(1 + 1 / 3 + 1 / 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma_u = sigma_z / (np.float32(2 * np.pi * frequency) * amplitude)
        lead = np.nan_to_num((second - best) * scale / 2)
    coordinates = Coordinates(
        axis=fringes.axis,
        u=u.reshape(shape),
        sigma=np.asarray(sigma_u, np.float32).reshape(shape),
        amplitude=np.asarray(amplitude, np.float32).reshape(shape),
        chi2=np.asarray(best * scale, np.float32).reshape(shape),
        dof=len(codes),
        lead=np.asarray(lead, np.float32).reshape(shape),
    )
    return MeasuredAxis(coordinates, mean.reshape(shape), sigma_z.reshape(shape))
