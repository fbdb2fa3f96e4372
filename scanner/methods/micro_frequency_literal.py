"""Micro-frequency shifting as its paper writes it (Optics Express 27(20) 28293, 2019), to compare with.

Round one detects by the standard deviation B_v of the modulation over the frequencies (Eqs. 18, 19). Round two lights
everything but what the undetected camera pixels map to (Eq. 21), and its coordinates are taken inside the region as
they come. Two things the paper leaves open are filled in with this project's: T_b, which it never gives, follows from
the noise and the false-alarm rate, raised to what the clean pixels show, as a hand on the threshold would; and
unwrapping is by maximum likelihood, because the subtraction it borrows is lost in noise (method.md §3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from drivers import FrameFormat
from scanner.config import ScanSection
from scanner.interreflection import excess_misfit, modulation_variation, variation_statistic
from scanner.methods.base import FirstRound, RoundFrames, Setup, refuse_off_epipolar, stepped_plan
from scanner.methods.micro_frequency import frequencies
from scanner.methods.multi_frequency import decode_axes, one_path_maps
from scanner.patterns import Plan
from scanner.phasors import RoundPhasors
from scanner.regions import literal_mask
from scanner.result import Flag, Maps


@dataclass(frozen=True)
class LiteralMicroFrequencyShifting:
    """The paper's MFS, two rounds."""

    name: str = "mfs_paper"
    title: str = "Micro-frequency shifting as the paper writes it (Opt. Express 27, 28293)"
    rounds: int = 2

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """Nine frequencies an axis, (80 + t)/1280 for a projector of 1280 px."""
        own = frequencies(max(size))
        return stepped_plan(scan, size, {"x": own, "y": own})

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundPhasors:
        """Phasors of the frames."""
        return RoundPhasors(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """One-path coordinates outside the region B_v ≥ T_b, nothing inside."""
        assert isinstance(frames, RoundPhasors)
        decoded = decode_axes(frames, setup)
        maps, usable = one_path_maps(frames, decoded, setup)
        variations, counts = [], []
        for axis in decoded:
            phasors = frames.axis(axis)
            assert phasors is not None
            variations.append(modulation_variation(phasors, np.ones(len(phasors.frequency))))
            counts.append(len(phasors.frequency))
        statistic, dof = variation_statistic(variations, [d.sigma_z for d in decoded.values()], counts)
        excess = max(1.0, excess_misfit(statistic, dof, usable))
        detected = usable & (statistic >= chi2_distribution.isf(setup.scan.false_alarm_rate, dof) * excess)
        flags = maps.flags.copy()
        flags[detected] |= np.uint16(Flag.INTERREFLECTION | Flag.MISFIT)

        def outside(u: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            return None if u is None else np.where(detected, np.float32(np.nan), u)

        first = replace(
            maps,
            x_p=outside(maps.x_p),
            y_p=outside(maps.y_p),
            sigma_x=outside(maps.sigma_x),
            sigma_y=outside(maps.sigma_y),
            variation=np.sqrt(np.mean(np.square(variations), axis=0, dtype=np.float32)),
            interreflection=detected,
            flags=flags,
            x_p_round1=maps.x_p,
            y_p_round1=maps.y_p,
            score=statistic / np.float32(dof),
        )
        return FirstRound(refuse_off_epipolar(first, setup.rig), frames.plan)

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """Black where an undetected pixel's coordinate lies, the same fringes everywhere else (Eq. 21)."""
        undetected = ~first.maps.interreflection
        if undetected.all() or setup.scan.rounds == 1:
            return None
        nothing = np.full(int(undetected.sum()), np.nan, np.float32)
        x, y = first.maps.x_p_round1, first.maps.y_p_round1
        mask = literal_mask(
            nothing if x is None else x[undetected], nothing if y is None else y[undetected], first.plan.size
        )
        return replace(first.plan, mask=mask) if mask.any() else None

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Round one outside the region, round two inside."""
        assert isinstance(second, RoundPhasors)
        decoded = decode_axes(second, setup)
        maps2, usable = one_path_maps(second, decoded, setup)
        one = first.maps
        taken = one.interreflection & usable & maps2.valid
        flags = one.flags.copy()
        flags[taken] &= ~np.uint16(Flag.MISFIT | Flag.OFF_EPIPOLAR | Flag.OUT_OF_VOLUME)
        flags[taken] |= np.uint16(Flag.SECOND_ROUND)

        def merged(old: NDArray[np.float32] | None, new: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            return None if old is None or new is None else np.where(taken, new, old)

        fused = replace(
            one,
            flags=flags,
            misfit_round2=np.where(one.interreflection & usable, maps2.misfit, np.float32(np.nan)),
            lit=second.plan.mask,
            regional_pattern=second.example,
            x_p=merged(one.x_p, maps2.x_p),
            y_p=merged(one.y_p, maps2.y_p),
            sigma_x=merged(one.sigma_x, maps2.sigma_x),
            sigma_y=merged(one.sigma_y, maps2.sigma_y),
        )
        return refuse_off_epipolar(fused, setup.rig)
