"""Micro-frequency shifting in one round: inside the region the separated direct path stands, where it is clear.

The same frames, detection and two-path separation as `MicroFrequencyShifting` (method.md §6), without the second round:
half the time, and holes where the separation is in doubt.
"""

from __future__ import annotations

from dataclasses import dataclass

from scanner.methods.base import FirstRound, Setup
from scanner.methods.micro_frequency import MicroFrequencyShifting
from scanner.patterns import Plan


@dataclass(frozen=True)
class OneRoundMicroFrequencyShifting(MicroFrequencyShifting):
    """MFS, one round."""

    name: str = "mfs1"
    title: str = "Micro-frequency shifting, one round, two paths separated"
    rounds: int = 1

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """Nothing follows."""
        return None
