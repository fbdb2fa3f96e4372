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
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, Pixels
from scanner import kernels
from scanner.config import ScanSection, check_plan_covers
from scanner.methods.base import (
    FirstRound,
    PlanError,
    RoundFrames,
    Setup,
    first_flags,
    keep_clear,
    refuse_off_epipolar,
    usable_pixels,
)
from scanner.methods.multi_frequency import MPS_PERIODS_PX
from scanner.patterns import Axis, Fringe, FringeSequence, Plan
from scanner.result import Maps
from scanner.unwrapping import Coordinates

_STEPS = 3


@dataclass
class CodeFrames:
    """The F + 2 frames of each axis, as they are: few enough to be kept."""

    plan: Plan
    frame_format: FrameFormat
    added: set[int] = field(default_factory=set)
    frames: dict[int, Pixels] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.saturated: NDArray[np.bool_] = np.zeros(self.frame_format.shape, bool)

    def add(self, sequence: int, frames: Pixels) -> None:
        """Take over the (F + 2, H, W) frames of one axis."""
        self.frames[sequence] = frames.copy()
        self.saturated |= (frames >= self.frame_format.saturated_dn).any(axis=0)
        self.added.add(sequence)

    def estimate_noise(self) -> NoiseModel | None:
        """F + 2 frames for as many unknowns leave no redundancy."""
        return None


@dataclass(frozen=True)
class MicroPhaseShifting:
    """MPS in F + 2 patterns an axis, one round."""

    name: str = "mps_gn"
    rounds: int = 1

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

    def collect(self, plan: Plan, frame_format: FrameFormat) -> CodeFrames:
        """Keep the frames."""
        return CodeFrames(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Nearest code vector, refined by φ₁."""
        assert isinstance(frames, CodeFrames)
        kept: dict[Axis, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        modulations, means, misfits, noises = [], [], [], []
        degrees = 0
        for number, pixels in sorted(frames.frames.items()):
            fringes = frames.plan.sequences[number]
            c, mean, sigma_z = nearest_code(pixels, fringes, frames.plan.extent(fringes.axis), setup.noise)
            usable = usable_pixels(c.amplitude, sigma_z, frames.saturated, setup.scan)
            kept[fringes.axis] = keep_clear(c, usable)
            modulations.append(c.amplitude)
            means.append(mean)
            misfits.append(c.chi2 / np.float32(c.dof))
            degrees += c.dof
            noises.append(sigma_z)
        if not kept:
            raise PlanError("the frames hold no complete axis", "Record at least the frames of one axis.")
        modulation = np.asarray(np.mean(modulations, axis=0), np.float32)
        usable = usable_pixels(np.minimum.reduce(modulations), noises[0], frames.saturated, setup.scan)
        x, sigma_x = kept.get("x", (None, None))
        y, sigma_y = kept.get("y", (None, None))
        maps = Maps(
            x_p=x,
            y_p=y,
            sigma_x=sigma_x,
            sigma_y=sigma_y,
            modulation=modulation,
            brightness=np.mean(means, axis=0, dtype=np.float32),
            variation=None,
            misfit=np.mean(misfits, axis=0, dtype=np.float32),
            misfit_dof=degrees,
            interreflection=np.zeros(modulation.shape, bool),
            flags=first_flags(usable, frames.saturated, [u for u, _ in kept.values()]),
        )
        return FirstRound(refuse_off_epipolar(maps, setup.rig), frames.plan)

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """Nothing follows."""
        return None

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Nothing follows, so round one stands."""
        return first.maps


def nearest_code(
    frames: Pixels, fringes: FringeSequence, extent: int, noise: NoiseModel
) -> tuple[Coordinates, NDArray[np.float32], NDArray[np.float32]]:
    """Coordinates of one axis from its (F + 2, H, W) frames, the mean grey value and the noise of the first phasor."""
    shape = frames.shape[1:]
    pixels = frames[0].size
    flat = frames.reshape(len(frames), pixels)
    z = np.empty(pixels, np.complex64)
    mean, residual, saturated = np.zeros(pixels, np.float32), np.zeros(pixels, np.float32), np.zeros(pixels, bool)
    steps = fringes.steps_rad[:_STEPS]
    kernels.demodulate(np.ascontiguousarray(flat[:_STEPS]), steps, 2**16, z, mean, residual, saturated)
    frequency = np.array([fringes.fringes[0].frequency] + [f.frequency for f in fringes.fringes[_STEPS:]])
    sigma_i = np.sqrt(np.asarray(noise.variance(mean), np.float32))
    sigma_z = np.float32(math.sqrt(2 / _STEPS)) * sigma_i
    amplitude = np.abs(z)
    period = 1 / frequency[0]
    u0 = np.asarray(np.angle(z) % (2 * np.pi) / (2 * np.pi) * period, np.float32)
    u, best, second = u0.copy(), np.full(pixels, np.inf, np.float32), np.full(pixels, np.inf, np.float32)

    def search(start: int, stop: int) -> None:
        here = slice(start, stop)
        code = (flat[_STEPS:, here] - mean[here]) / np.maximum(amplitude[here], 1e-6)
        for order in range(-1, math.ceil(extent / period) + 1):
            place = u0[here] + np.float32(order * period)
            cost = np.zeros(stop - start, np.float32)
            for k, fringe in enumerate(fringes.fringes[_STEPS:]):
                angle = np.float32(2 * np.pi * fringe.frequency) * place + np.float32(fringe.step_rad)
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
        sigma_u = sigma_z / (np.float32(2 * np.pi * frequency[0]) * amplitude)
        lead = np.nan_to_num((second - best) * scale / 2)
    coordinates = Coordinates(
        axis=fringes.axis,
        u=u.reshape(shape),
        sigma=np.asarray(sigma_u, np.float32).reshape(shape),
        amplitude=np.asarray(amplitude, np.float32).reshape(shape),
        chi2=np.asarray(best * scale, np.float32).reshape(shape),
        dof=len(frequency) - 1,
        lead=np.asarray(lead, np.float32).reshape(shape),
    )
    return coordinates, mean.reshape(shape), sigma_z.reshape(shape)
