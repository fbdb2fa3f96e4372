"""XOR code and phase (Gupta, Agrawal, Veeraraghavan & Narasimhan, CVPR 2011): a binary code without wide stripes.

Gray code has wide stripes, on which a bounce may outshine the direct light of a dark place. XOR code shows every plane
of the Gray code XORed with its finest one, so that all stripes are narrow and bounces of wide-spread light raise a
pattern and its inverse alike. The code is the coarse reference: it says which fringe of the phase-stepped pattern a
pixel sees, and the phase says where in the fringe. Each plane is followed by its inverse, so that no threshold is
needed; the planes are compared softly with those of the places that the phase allows, because at the edges of the
finest plane all of them are grey.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from drivers import NoiseModel, Pixels
from scanner import kernels
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
from scanner.patterns import FringeSequence, PatternSequence, Plan, ProfileSequence, phase_steps
from scanner.unwrapping import Coordinates

CELL_PX = 8
"""Width of a cell of the code: no stripe is wider than two, and no fringe may be narrower than two."""

PERIOD_PX = 16
"""Period of the fringe that refines the code."""


def xor_planes(extent: int) -> NDArray[np.int8]:
    """(B, extent) planes, -1 or 1: those of the Gray code of the cells XORed with the finest one, which comes last."""
    cell = np.arange(extent) // CELL_PX
    gray = cell ^ (cell >> 1)
    bits = max(1, int(cell[-1]).bit_length())
    planes = [(gray >> k & 1) ^ (gray & 1) for k in range(bits - 1, 0, -1)] + [gray & 1]
    return (2 * np.stack(planes) - 1).astype(np.int8)


@dataclass(frozen=True)
class XorCode(OneRound):
    """XOR code and N phase steps of one fringe, one round."""

    name: str = "xor"
    title: str = "XOR code for the fringe order, phase within (Gupta et al., CVPR 2011)"

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """A sequence of planes and inverses and one of phase steps an axis."""
        sequences: list[PatternSequence] = []
        for axis in scan.axes:
            period = 1 / (scan.frequencies(axis) or (1 / PERIOD_PX,))[0]
            if period < 2 * CELL_PX:
                raise PlanError(
                    f"scan, axis {axis}: xor with a period of {period:g} px",
                    f"Give a period of {2 * CELL_PX} px or more: the code tells fringes of that width apart.",
                )
            planes = xor_planes(size[0] if axis == "x" else size[1])
            profiles = tuple(tuple(float(v) for v in p * sense) for p in planes for sense in (1, -1))
            sequences += [
                ProfileSequence(axis, "XOR code", profiles),
                phase_steps(axis, 1 / period, scan.steps),
            ]
        return Plan(size, tuple(sequences), scan.mean, scan.amplitude)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Order of the fringe by the code, place in it by the phase."""
        assert isinstance(frames, KeptFrames)
        axes = []
        for number in range(0, len(frames.plan.sequences), 2):
            if {number, number + 1} <= frames.added:
                axes.append(_located(frames, number, setup.noise))
        return FirstRound(undetected_maps(axes, frames.saturated, setup), frames.plan)


def _located(frames: KeptFrames, number: int, noise: NoiseModel) -> MeasuredAxis:
    code, fringes = frames.plan.sequences[number : number + 2]
    assert isinstance(code, ProfileSequence)
    assert isinstance(fringes, FringeSequence)
    frequency = fringes.fringes[0].frequency
    stepped: Pixels = frames.frames[number + 1]
    shape, pixels, extent = stepped.shape[1:], stepped[0].size, frames.plan.extent(code.axis)
    z = np.empty(pixels, np.complex64)
    mean, rest, full = np.zeros(pixels, np.float32), np.zeros(pixels, np.float32), np.zeros(pixels, bool)
    kernels.demodulate(stepped.reshape(len(stepped), -1), fringes.steps_rad, 2**16, z, mean, rest, full)
    sigma_i = np.sqrt(np.asarray(noise.variance(mean), np.float32))
    sigma_z = np.float32(math.sqrt(2 / len(stepped))) * sigma_i
    amplitude = np.abs(z)
    u0 = np.asarray(np.angle(z) % (2 * np.pi) / (2 * np.pi * frequency), np.float32)
    shown = frames.frames[number].reshape(len(code), -1)
    planes = _as_seen(code, np.abs(np.diff(u0.reshape(shape), axis=1 if code.axis == "x" else 0)))
    u, best, second = u0.copy(), np.full(pixels, -np.inf, np.float32), np.full(pixels, -np.inf, np.float32)
    energy = np.zeros(pixels, np.float32)

    def search(start: int, stop: int) -> None:
        here = slice(start, stop)
        seen = shown[::2, here].astype(np.float32) - shown[1::2, here]
        energy[here] = np.square(seen).sum(axis=0)
        for order in range(-1, math.ceil(extent * frequency) + 1):
            place = u0[here] + np.float32(order / frequency)
            left = np.clip(np.floor(place), 0, extent - 2).astype(np.intp)
            share = np.clip(place - left, 0, 1)
            expected = planes[:, left] * (1 - share) + planes[:, left + 1] * share
            # Best amplitude for these planes, which cannot be negative.
            match = (seen * expected).sum(axis=0) / np.maximum(np.sqrt(np.square(expected).sum(axis=0)), 1e-3)
            match = np.where((place < -0.5) | (place >= extent - 0.5), -np.inf, np.maximum(match, 0))
            better = match > best[here]
            second[here] = np.where(better, best[here], np.maximum(second[here], match))
            best[here] = np.where(better, match, best[here])
            u[here] = np.where(better, place, u[here])

    kernels.over_pixels(search, pixels)
    variance = 2 * sigma_i**2  # of a plane less its inverse
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma_u = sigma_z / (np.float32(2 * np.pi * frequency) * amplitude)
    coordinates = Coordinates(
        axis=code.axis,
        u=u.reshape(shape),
        sigma=np.asarray(sigma_u, np.float32).reshape(shape),
        amplitude=np.asarray(amplitude, np.float32).reshape(shape),
        chi2=np.asarray((energy - best**2) / variance, np.float32).reshape(shape),
        dof=len(planes) - 1,
        lead=np.asarray((best**2 - np.maximum(second, 0) ** 2) / (2 * variance), np.float32).reshape(shape),
    )
    return MeasuredAxis(coordinates, mean.reshape(shape), sigma_z.reshape(shape))


def _as_seen(code: ProfileSequence, steps: NDArray[np.float32]) -> NDArray[np.float32]:
    """(B, extent) planes with the edges that a camera sees whose neighbouring pixels lie ``steps`` (px) apart.

    A pixel takes the mean over its own width, and the optics of both ends blur by about as much again.
    """
    pitch = float(np.median(steps))
    return np.asarray(gaussian_filter1d(np.array(code.profiles[::2], np.float32), 0.5 + 0.5 * pitch, axis=1))
