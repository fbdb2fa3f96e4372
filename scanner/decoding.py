"""From collected frames to maps: the part of a scan that is the same for a live bench and for recorded frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drivers import NoiseModel
from scanner.config import ScanSection
from scanner.methods import FirstRound, Method, RepeatedlyRegional, RoundFrames, Setup
from scanner.patterns import Plan
from scanner.result import Flag, Maps
from scanner.rig import Rig
from scanner.rig_uncertainty import covariance_fault

_ASSUMED_NOISE = NoiseModel(1.5)
"""Where neither the camera nor the frames tell: an ordinary 8-bit camera."""


@dataclass
class Decoder:
    """Decodes the rounds of one scan as they become complete.

    Parameters
    ----------
    method, scan
        What was projected and how it is judged.
    noise
        The camera's noise model; None takes it from the frames.
    rig
        Calibrated rig, or None: then there are coordinates and no points.
    """

    method: Method
    scan: ScanSection
    noise: NoiseModel | None
    rig: Rig | None
    warnings: list[str] = field(default_factory=list, init=False)
    decision: str = field(default="", init=False)
    used_noise: NoiseModel | None = field(default=None, init=False)
    _setup: Setup | None = field(default=None, init=False)
    _first: FirstRound | None = field(default=None, init=False)
    _maps: Maps | None = field(default=None, init=False)
    _lacks: Plan | None = field(default=None, init=False)
    _noises: dict[int, NoiseModel] = field(default_factory=dict, init=False)
    _told: set[str] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        fault = None if self.rig is None else covariance_fault(self.rig)
        if fault is not None:
            self.warnings.append(fault)

    def first(self, frames: RoundFrames, noise: NoiseModel | None = None) -> Plan | None:
        """Decode round one; returns the plan of round two, or None where there is nothing more to do.

        Parameters
        ----------
        frames
            Of the round.
        noise
            Of these frames where it is known, as of fused ones; None asks the frames.
        """
        self.used_noise = self.noise_of(frames) if noise is None else noise
        self._setup = Setup(self.scan, self.used_noise, self.rig)
        self._first = self.method.decode(frames, self._setup)
        self._maps = self._first.maps
        self.warnings += self._first.notes
        self.decision = self._first.decision
        return self.method.second_round(self._first, self._setup)

    def regional(self, frames: RoundFrames, noise: NoiseModel | None = None) -> Plan | None:
        """Join a regional round; returns the plan of the next, or None where there is nothing more to do.

        With sequences missing, only what the rounds before could tell is kept.

        Parameters
        ----------
        frames
            Of the round.
        noise
            Of these frames where it is another than in round one, as of fused ones.
        """
        if self._first is None or self._setup is None:
            raise AssertionError("round two is decoded after round one")
        if len(frames.added) < len(frames.plan.sequences):
            self.give_up_regional(frames.plan)
            if not isinstance(self.method, RepeatedlyRegional):
                return None
            self._first = self.method.skip(self._first)
            return self.method.second_round(self._first, self._setup)
        setup = self._setup if noise is None else replace(self._setup, noise=noise)
        if not isinstance(self.method, RepeatedlyRegional):
            self._maps = self.method.fuse(self._first, frames, setup)
            return None
        self._first = self.method.join(self._first, frames, setup)
        self._maps = self._first.maps
        self.warnings += self._first.notes
        self.decision = self._first.decision
        return self.method.second_round(self._first, self._setup)

    @property
    def rounds(self) -> int:
        """Rounds in all, as far as is known after the last that was decoded."""
        return 1 if self._first is None else 1 + self._first.regional

    def give_up_regional(self, plan: Plan) -> None:
        """Say of the pixels that only this regional round could have told that the recording lacks it."""
        if self._lacks is None:
            self.warnings.append(
                "the regional rounds are not complete: the rest of the bounce region holds what round one could "
                "separate, and nothing else"
                if self.rounds > 2
                else "round two is not complete: the bounce region holds what round one could separate, and nothing "
                "else"
            )
        self._lacks = plan

    @property
    def maps(self) -> Maps:
        """The result so far."""
        if self._maps is None:
            raise AssertionError("nothing was decoded yet")
        if self._lacks is None:
            return self._maps
        maps = self._maps
        flags = maps.flags.copy()
        flags[maps.interreflection & ~maps.valid] |= np.uint16(Flag.INCOMPLETE)
        return replace(maps, flags=flags, lit=self._lacks.mask if maps.lit is None else maps.lit)

    def noise_of(self, frames: RoundFrames) -> NoiseModel:
        """What the frames show goes before what the camera promises: it holds vibration and flicker too."""
        observed = frames.estimate_noise()
        if observed is None:
            if self.noise is None:
                self._warn(
                    "unknown",
                    f"neither camera nor frames tell the noise: {_ASSUMED_NOISE.read_dn:g} DN is assumed, and σ with "
                    "it",
                )
            return self.noise or _ASSUMED_NOISE
        if self.noise is not None:
            ratio = _middle_sigma(observed) / _middle_sigma(self.noise)
            if ratio > 1.3:
                self._warn(
                    "noisy",
                    f"the frames are {ratio:.1f} × as noisy as the camera's model says: vibration, flicker, or a "
                    "projector response that is not linear",
                )
        return observed

    def noise_at(self, exposure: int, frames: RoundFrames) -> NoiseModel:
        """Noise of the frames of one exposure as round one has it: what later rounds show is mostly dark.

        An exposure that round one lacks has the noise of the one nearest to the bench's own.

        Parameters
        ----------
        exposure
            Its number in the series.
        frames
            Of it, in this round.
        """
        if exposure not in self._noises:
            if self._setup is not None:
                return NoiseModel(self._setup.noise.read_dn, self._setup.noise.dn_per_electron)
            self._noises[exposure] = self.noise_of(frames)
        return self._noises[exposure]

    def _warn(self, kind: str, text: str) -> None:
        """Say something once, however many exposures show it."""
        if kind not in self._told:
            self._told.add(kind)
            self.warnings.append(text)


def _middle_sigma(noise: NoiseModel) -> float:
    """σ at the grey value 100, DN: one number to compare two models by."""
    return float(np.sqrt(noise.variance(100.0)))
