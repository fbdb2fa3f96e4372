"""Modulated phase shifting (Chen, Seidel & Lensch, CVPR 2008): low fringes under a high carrier across them.

Every phase step is shown under three steps of a fine fringe along the *other* axis. What varies with the carrier is the
direct light; diffuse bounces, which mix many places, lose it. The N amplitudes of the carrier are the phase-shifted
light without the global part, and are decoded as any other fringes. A mirror's bounce carries the carrier along.

The amplitudes are taken along the carrier's own phase, which the mean of the steps tells, rather than as magnitudes:
these are rectified noise where the fringe is dark.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, Pixels
from scanner.config import ScanSection, check_plan_covers
from scanner.methods.base import FirstRound, OneRound, PlanError, RoundFrames, Setup, refuse_off_epipolar
from scanner.methods.multi_frequency import decode_axes, one_path_maps, temporal_phase_shifting
from scanner.patterns import Axis, Fringe, FringeSequence, Plan, phase_steps
from scanner.phasors import AxisPhasors, RoundPhasors

CARRIER_STEPS = 3
CARRIER = 1 / 16
"""Frequency of the carrier, 1/px."""


@dataclass
class CarrierPhasors(RoundPhasors):
    """Phasors of the light that follows the carrier; the sequences of a frequency are its carrier's steps."""

    _carriers: dict[tuple[Axis, float], NDArray[np.complex64]] = field(default_factory=dict)

    def add(self, sequence: int, frames: Pixels) -> None:
        """Take over the (N, H, W) frames of one frequency under one step of the carrier."""
        super().add(sequence, frames)
        fringes = self.plan.sequences[sequence]
        assert isinstance(fringes, FringeSequence)
        assert fringes.carrier is not None
        key = fringes.axis, fringes.fringes[0].frequency
        turned = frames.mean(axis=0, dtype=np.float32) * np.complex64(np.exp(-1j * fringes.carrier.step_rad))
        self._carriers[key] = self._carriers.get(key, 0) + turned

    def axis(self, axis: Axis) -> AxisPhasors | None:
        """Phasors of the frequencies of ``axis`` of which all steps of the carrier are there; None without any."""
        numbers = [i for i, s in enumerate(self.plan.sequences) if s.axis == axis]
        all_steps = [numbers[k : k + CARRIER_STEPS] for k in range(0, len(numbers), CARRIER_STEPS)]
        whole = [steps for steps in all_steps if self.added.issuperset(steps)]
        if not whole:
            return None
        stack = self._stack(axis)
        frequency, z = [], []
        for steps in whole:
            planned = self.plan.fringes(axis)[numbers.index(steps[0])]
            along = self._carriers[axis, planned.fringes[0].frequency]
            along = np.asarray(along / np.maximum(np.abs(along), np.float32(1e-6)), np.complex64)
            total = np.zeros(self.frame_format.shape, np.complex64)
            for number in steps:
                carrier = self.plan.fringes(axis)[numbers.index(number)].carrier
                assert carrier is not None
                share = (along * np.complex64(np.exp(1j * carrier.step_rad))).real
                total = np.asarray(total + stack.z[numbers.index(number)] * share, np.complex64)
            frequency.append(planned.fringes[0].frequency)
            z.append(np.asarray(total * np.float32(2 / CARRIER_STEPS), np.complex64))
        return AxisPhasors(axis, np.array(frequency), np.stack(z), stack.noise_gain * 2 / CARRIER_STEPS)

    def estimate_noise(self) -> NoiseModel | None:
        """From the residuals of four and more steps; with three, sequences do not share a mean as plain fringes do."""
        few = min(len(s) for s in self.plan.sequences) < 4
        return None if few else super().estimate_noise()


@dataclass(frozen=True)
class ModulatedPhaseShifting(OneRound):
    """N steps of every frequency, each under three steps of a carrier; one round."""

    name: str = "modulated"
    title: str = "Modulated phase shifting (Chen, Seidel & Lensch, CVPR 2008)"

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """The frequencies of TPS; a sequence for each of them and each step of the carrier."""
        sequences = []
        for axis in scan.axes:
            extent = size[0] if axis == "x" else size[1]
            frequencies = scan.frequencies(axis) or tuple(temporal_phase_shifting.own_frequencies(extent))
            check_plan_covers(frequencies, extent, axis)
            for frequency in frequencies:
                try:
                    steps = phase_steps(axis, frequency, scan.steps).fringes
                except ValueError as error:
                    raise PlanError(f"scan, axis {axis}: {error}", "Choose periods above 2 px.") from None
                for m in range(CARRIER_STEPS):
                    carrier = Fringe(CARRIER, 2 * math.pi * m / CARRIER_STEPS)
                    sequences.append(FringeSequence(axis, steps, carrier))
        return Plan(size, tuple(sequences), scan.mean, scan.amplitude)

    def collect(self, plan: Plan, frame_format: FrameFormat) -> CarrierPhasors:
        """Phasors under each step of the carrier."""
        return CarrierPhasors(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """As TPS, from the light that follows the carrier."""
        assert isinstance(frames, CarrierPhasors)
        maps, _ = one_path_maps(frames, decode_axes(frames, setup), setup)
        return FirstRound(refuse_off_epipolar(maps, setup.rig), frames.plan)
