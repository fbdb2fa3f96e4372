"""A `Method` is a first-round plan, its decoding, perhaps a second-round plan, and their fusion.

`METHODS` finds them by name: the scanner's own, one file each, and whatever an installed package registers in the
entry-point group ``scanner.methods`` or ``scan --method FILE.py`` names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from scanner.config import METHOD_NAMES, load_stranger, method_names
from scanner.methods.base import (
    FirstRound,
    KeptFrames,
    MeasuredAxis,
    Method,
    OneRound,
    PlanError,
    RepeatedlyRegional,
    RoundFrames,
    Setup,
    undetected_maps,
)
from scanner.methods.embedded import EmbeddedPhaseShifting
from scanner.methods.epipolar import EpipolarCheck
from scanner.methods.gupta_nayar import MicroPhaseShifting
from scanner.methods.micro_frequency import MicroFrequencyShifting
from scanner.methods.micro_frequency_literal import LiteralMicroFrequencyShifting
from scanner.methods.micro_frequency_once import OneRoundMicroFrequencyShifting
from scanner.methods.modulated import ModulatedPhaseShifting
from scanner.methods.multi_frequency import micro_phase_shifting, temporal_phase_shifting
from scanner.methods.xor_code import XorCode


class _Methods(Mapping[str, Method]):
    """All methods by name; a stranger's is imported when it is asked for."""

    def __init__(self, *own: Method) -> None:
        self._own = {method.name: method for method in own}
        assert set(self._own) == set(METHOD_NAMES)

    def __getitem__(self, name: str) -> Method:
        """Find a method.

        Raises
        ------
        ConfigError
            None has that name, or it cannot be loaded; the error lists those that there are.
        """
        if name in self._own:
            return self._own[name]
        found: Method = load_stranger(name)
        return found

    def __contains__(self, name: object) -> bool:
        return name in method_names()

    def __iter__(self) -> Iterator[str]:
        return iter(method_names())

    def __len__(self) -> int:
        return len(method_names())


METHODS: Mapping[str, Method] = _Methods(
    MicroFrequencyShifting(),
    OneRoundMicroFrequencyShifting(),
    LiteralMicroFrequencyShifting(),
    temporal_phase_shifting,
    micro_phase_shifting,
    MicroPhaseShifting(),
    ModulatedPhaseShifting(),
    EmbeddedPhaseShifting(),
    XorCode(),
    EpipolarCheck(),
)

__all__ = [
    "METHODS",
    "FirstRound",
    "KeptFrames",
    "MeasuredAxis",
    "Method",
    "OneRound",
    "PlanError",
    "RepeatedlyRegional",
    "RoundFrames",
    "Setup",
    "undetected_maps",
]
