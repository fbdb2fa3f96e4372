"""Frames → phasors: z_t = B e^{i2πf_t u} for every sequence, with the mean, the noise and the saturated pixels.

method.md §1. The phasors of one axis are kept as one stack; sequences may arrive in any order and one at a time, so
that decoding runs beside the capture.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from drivers import FrameFormat, NoiseModel, Pixels
from scanner import kernels
from scanner.patterns import Axis, FringeSequence, Plan

_SECOND_DERIVATIVES = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
"""Second derivative across and along: blind to whatever is smooth (Immerkær, CVIU 64, 300 (1996))."""


@dataclass
class AxisPhasors:
    """The phasors of one axis of one round.

    Parameters
    ----------
    axis
        Which projector coordinate the fringes encode.
    frequency
        (T,) 1/px.
    z
        (T, H, W) complex64, DN.
    noise_gain
        var(Re z) / var(I): 2/N for N equal steps.
    """

    axis: Axis
    frequency: NDArray[np.float64]
    z: NDArray[np.complex64]
    noise_gain: float

    def sigma_z(self, noise: NoiseModel, mean: NDArray[np.float32]) -> NDArray[np.float32]:
        """(H, W) standard deviation (DN) of Re z and Im z for pixels of mean grey value ``mean`` (DN)."""
        variance: NDArray[np.float32] = np.asarray(noise.variance(mean), np.float32)
        return np.asarray(np.sqrt(np.float32(self.noise_gain) * variance), np.float32)


@dataclass
class RoundPhasors:
    """All that the frames of one round say, before any coordinate is computed.

    Made empty for a plan; `add` takes the sequences as they come in.

    Parameters
    ----------
    plan
        What was projected.
    frame_format
        What frames look like.

    Attributes
    ----------
    example
        (H, W) the first frame that was added, for people to look at.
    """

    plan: Plan
    frame_format: FrameFormat
    added: set[int] = field(default_factory=set)
    residual_dof: int = 0
    _stacks: dict[Axis, AxisPhasors] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.frame_format.shape
        self._mean_sum = np.zeros(shape, np.float32)
        self._last_mean: NDArray[np.float32] | None = None
        self._residual = np.zeros(shape, np.float32)
        self.saturated: NDArray[np.bool_] = np.zeros(shape, bool)
        self.example: Pixels | None = None

    @property
    def mean(self) -> NDArray[np.float32]:
        """(H, W) mean grey value A over the sequences so far, DN."""
        return self._mean_sum / np.float32(max(len(self.added), 1))

    @property
    def residual_variance(self) -> NDArray[np.float32]:
        """(H, W) variance (DN²) that the step residuals show, with `residual_dof` degrees of freedom a pixel."""
        return self._residual / np.float32(max(self.residual_dof, 1))

    def add(self, sequence: int, frames: Pixels) -> None:
        """Take over the (N, H, W) frames of sequence number ``sequence`` of the plan.

        Raises
        ------
        ValueError
            Wrong shape, a sequence that was added before, or patterns of several frequencies.
        """
        fringes = self.plan.sequences[sequence]
        if not isinstance(fringes, FringeSequence) or fringes.frequency is None:
            raise ValueError(f"sequence {fringes.label} is not one fringe: it has no phasor of its own")
        if frames.shape != (len(fringes), *self.frame_format.shape):
            raise ValueError(f"frames {frames.shape} for sequence {fringes.label} of {self.frame_format.shape} pixels")
        if sequence in self.added:
            raise ValueError(f"sequence {fringes.label} was added before")
        stack = self._stack(fringes.axis)
        slot = [i for i, s in enumerate(self.plan.sequences) if s.axis == fringes.axis].index(sequence)
        steps = fringes.steps_rad
        mean = np.zeros(frames[0].size, np.float32)
        kernels.demodulate(
            np.ascontiguousarray(frames).reshape(len(steps), -1),
            steps,
            self.frame_format.saturated_dn,
            stack.z[slot].reshape(-1),
            mean,
            self._residual.reshape(-1),
            self.saturated.reshape(-1),
        )
        mean = mean.reshape(self.frame_format.shape)
        self.residual_dof += len(steps) - 3
        if len(steps) == 3 and self._last_mean is not None:
            # Three steps leave no residual. But two sequences have the same mean, up to harmonics of the fringes: the
            # difference has no texture, and what is smooth in it goes with the second derivatives.
            rough = cv2.filter2D(mean - self._last_mean, -1, _SECOND_DERIVATIVES, borderType=cv2.BORDER_REFLECT)
            self._residual += np.float32(1.5 / np.square(_SECOND_DERIVATIVES).sum()) * rough**2
            self.residual_dof += 1
            # Each mean serves one pair, so that all pairs are independent.
            self._last_mean = None
        elif len(steps) == 3:
            self._last_mean = mean
        self._mean_sum += mean
        if self.example is None:
            self.example = frames[0].copy()
        self.added.add(sequence)

    def axis(self, axis: Axis) -> AxisPhasors | None:
        """Phasors of the sequences of ``axis`` that were added, in plan order; None where there are none."""
        numbers = [i for i, s in enumerate(self.plan.sequences) if s.axis == axis]
        present = [slot for slot, number in enumerate(numbers) if number in self.added]
        if not present:
            return None
        stack = self._stack(axis)
        if len(present) == len(numbers):
            return stack
        return AxisPhasors(axis, stack.frequency[present], stack.z[present], stack.noise_gain)

    def complete(self, axis: Axis) -> bool:
        """Whether every sequence of ``axis`` was added."""
        return all(i in self.added for i, s in enumerate(self.plan.sequences) if s.axis == axis)

    def release(self, axis: Axis) -> None:
        """Forget the phasors of ``axis``, the bulk of the memory."""
        self._stacks.pop(axis, None)

    def estimate_noise(self) -> NoiseModel | None:
        """Noise model from the step residuals of the frames themselves; None where they leave no degree of freedom.

        The median over pixels of similar grey value makes the estimate blind to the few pixels that moved or clipped;
        var(I) = read² + g·I is then fitted to the grey values.
        """
        dof = self.residual_dof
        usable = ~self.saturated & (self.mean > 2)
        if dof == 0 or np.count_nonzero(usable) < 1000:
            return None
        step = max(1, int(np.count_nonzero(usable) // 400_000))
        mean = self.mean[usable][::step].astype(np.float64)
        variance = self.residual_variance[usable][::step].astype(np.float64)
        edges = np.quantile(mean, np.linspace(0, 1, 17))
        bins = np.clip(np.searchsorted(edges, mean, side="right") - 1, 0, 15)
        centres, spreads = [], []
        for b in range(16):
            inside = bins == b
            if np.count_nonzero(inside) >= 30:
                centres.append(mean[inside].mean())
                spreads.append(np.median(variance[inside]) * dof / chi2_distribution.median(dof))
        grey, spread = np.array(centres), np.maximum(np.array(spreads), 1e-6)
        model = np.stack([np.ones_like(grey), grey], axis=1) / spread[:, None]
        offset, gain = np.linalg.lstsq(model, np.ones_like(spread), rcond=None)[0]
        if gain < 0:
            offset, gain = 1 / np.mean(1 / spread), 0.0
        elif offset < 0:
            offset, gain = 0.0, np.mean(spread / grey)
        # No frame has less noise than its own rounding.
        return NoiseModel(float(np.sqrt(max(offset, 1 / 12))), float(gain))

    def _stack(self, axis: Axis) -> AxisPhasors:
        if axis not in self._stacks:
            sequences = self.plan.fringes(axis)
            counts = {len(s.fringes) for s in sequences}
            if len(counts) > 1:
                raise ValueError(f"the {axis} sequences have different numbers of steps {sorted(counts)}")
            solve, _ = kernels.demodulation_matrices(sequences[0].steps_rad)
            self._stacks[axis] = AxisPhasors(
                axis,
                np.array([s.frequency for s in sequences], np.float64),
                np.empty((len(sequences), *self.frame_format.shape), np.complex64),
                float((solve[1:] ** 2).sum() / 2),
            )
        return self._stacks[axis]
