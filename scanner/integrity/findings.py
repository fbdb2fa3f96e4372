"""What a check says: findings, and the verdict on one sequence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.patterns import Axis

SEQUENCE = -1
"""The frame of a finding that concerns a sequence as a whole."""


@dataclass(frozen=True)
class Finding:
    """Something wrong with one sequence: ``frame`` counts from 0 within it, -1 for the sequence as a whole."""

    frame: int
    message: str


@dataclass(frozen=True)
class AtOdds:
    """A sequence of ``axis`` and ``frequency`` (1/px) that contradicts the rest of its round, and how, in words.

    ``frequency`` is None where the frames of the sequence have several.
    """

    axis: Axis
    frequency: float | None
    message: str


@dataclass(frozen=True)
class SequenceCheck:
    """The verdict on one sequence.

    Parameters
    ----------
    findings
        What is wrong; empty for a good sequence.
    steps_rad
        (N,) steps that the frames had, rad; NaN where they cannot be told.
    usable
        Share of the sampled pixels with fringes on them; NaN where that was not looked at.
    blind_to
        What would not have been seen, in words for the recording; empty where every fault shows that changes a
        coordinate by more than the noise.
    """

    findings: tuple[Finding, ...]
    steps_rad: NDArray[np.float64]
    usable: float
    blind_to: str = ""

    @property
    def good(self) -> bool:
        """True where nothing is wrong."""
        return not self.findings
