"""What is kept of one exposure's pass through a round until all exposures are there; the frames wait on the disk."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, Pixels
from scanner.methods import Method, RoundFrames
from scanner.patterns import Plan

NEAR_SATURATION = 0.98
"""Share of full scale from which a pixel is taken from a shorter exposure: sensors bend before they clip."""

_SAMPLED = 250_000
"""Pixels that noise and ratios are estimated from."""


@dataclass
class ExposurePass:
    """One exposure of one round, as a `RoundFrames`: where it saturates, its mean, and a sample for its noise.

    Parameters
    ----------
    plan, frame_format
        Of the round.
    method
        Says by its own redundancy how noisy the frames are.

    Attributes
    ----------
    saturated, bright
        (H, W) bool, pixels of which a frame is saturated, or at least so near that the sensor may not be linear.
    """

    plan: Plan
    frame_format: FrameFormat
    method: Method
    added: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        shape = self.frame_format.shape
        self.saturated: NDArray[np.bool_] = np.zeros(shape, bool)
        self.bright: NDArray[np.bool_] = np.zeros(shape, bool)
        self._sum = np.zeros(shape, np.float32)
        self._frames = 0
        stride = max(1, math.ceil(math.sqrt(math.prod(shape) / _SAMPLED)))
        self.sampled = np.s_[::stride, ::stride]
        height, width = self.saturated[self.sampled].shape
        self._sample: RoundFrames = self.method.collect(self.plan, FrameFormat(width, height, self.frame_format.bits))

    @property
    def mean(self) -> NDArray[np.float32]:
        """(H, W) mean grey value of all frames so far, DN."""
        return self._sum / np.float32(max(self._frames, 1))

    @property
    def complete(self) -> bool:
        """Whether every sequence was added."""
        return len(self.added) == len(self.plan.sequences)

    def add(self, sequence: int, frames: Pixels) -> None:
        """Look at the (N, H, W) frames of a sequence; they may be overwritten afterwards."""
        top, full = frames.max(axis=0), self.frame_format.saturated_dn
        self.saturated |= top >= full
        self.bright |= top >= NEAR_SATURATION * full
        self._sum += frames.sum(axis=0, dtype=np.float32)
        self._frames += len(frames)
        self._sample.add(sequence, frames[:, *self.sampled])
        self.added.add(sequence)

    def estimate_noise(self) -> NoiseModel | None:
        """Noise model that a sample of the pixels shows; None where the method's frames have no redundancy."""
        return self._sample.estimate_noise()
