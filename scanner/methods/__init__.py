"""A `Method` is a first-round plan, its decoding, perhaps a second-round plan, and their fusion.

A new method is one class with the members of `Method`; put it into `METHODS` under its name and `scan --method` and
`scan compare` know it.
"""

from __future__ import annotations

from scanner.methods.base import FirstRound, Method, RoundFrames, Setup
from scanner.methods.gupta_nayar import MicroPhaseShifting
from scanner.methods.micro_frequency import MicroFrequencyShifting
from scanner.methods.multi_frequency import micro_phase_shifting, temporal_phase_shifting

METHODS: dict[str, Method] = {
    m.name: m
    for m in (
        MicroFrequencyShifting(),
        temporal_phase_shifting,
        micro_phase_shifting,
        MicroPhaseShifting(),
    )
}

__all__ = ["METHODS", "FirstRound", "Method", "RoundFrames", "Setup"]
