"""Micro-frequency shifting (MFS) in two rounds (Optics Express 27(20) 28293; method.md §§2-7).

Round one projects nine slightly different frequencies on each axis. Where the fringes of a pixel do not fit one path, a
bounce arrives; there the two paths are separated. Round two lights only where the direct light of those pixels comes
from, so that the bounce has no source. Inside the region round two is kept where it passes its own test, else the
separation where it is clear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from drivers import FrameFormat
from scanner.config import ScanSection
from scanner.interreflection import (
    Detection,
    detect,
    detect_pooled,
    misfit_statistic,
    modulation_variation,
    variation_statistic,
)
from scanner.methods.base import (
    FirstRound,
    RoundFrames,
    Setup,
    first_flags,
    refuse_off_epipolar,
    stepped_plan,
)
from scanner.methods.multi_frequency import DecodedAxis, decode_axes, one_path_maps
from scanner.methods.separated import Separated, phasors_of, separate_region
from scanner.methods.sufficiency import Evidence, weigh
from scanner.patterns import Axis, Plan
from scanner.phasors import RoundPhasors
from scanner.pooling import one_path_residuals
from scanner.regions import continued, inside, lit_together, literal_mask, pitch, sound_mask
from scanner.result import Flag, Maps

FREQUENCIES = 9
"""T: frequencies an axis; t = 0..8."""

_REFUSED_ONE_IN = 1e4
"""Of good coordinates one in so many is refused by its own χ²."""

_HALO_PX = 2
"""Round two also serves the pixels this near to the region, whose bounce is below detection."""

_CLEARANCE_PX = 2
"""Fringes this near to the end of the lit set are cut by the projector's blur."""

_CLEARANCE_PITCHES = 2.0
"""And those within so many camera pixels of it by the camera's."""


def frequencies(extent: int) -> tuple[float, ...]:
    """f_t = (n + t)/L, t = 0..8, with n the fringes of about 16 px in L px: (80 + t)/1280 for L = 1280."""
    fringes = round(extent / 16)
    return tuple((fringes + t) / extent for t in range(FREQUENCIES))


@dataclass(frozen=True)
class _Private:
    decoded: dict[Axis, DecodedAxis]
    detection: Detection
    separated: Separated
    evidence: Evidence


@dataclass(frozen=True)
class MicroFrequencyShifting:
    """MFS, two rounds, or one where the scan is content with it."""

    name: str = "mfs"
    title: str = "Micro-frequency shifting, two rounds (after Opt. Express 27, 28293)"
    rounds: int = 2

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """Nine frequencies an axis; both axes use those of the longer, as the paper does."""
        own = frequencies(max(size))
        return stepped_plan(scan, size, {"x": own, "y": own})

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundPhasors:
        """Phasors of the frames."""
        return RoundPhasors(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Coordinates, detected region, and the two paths inside it."""
        assert isinstance(frames, RoundPhasors)
        decoded = decode_axes(frames, setup)
        maps, usable = one_path_maps(frames, decoded, setup)
        variations = [modulation_variation(phasors_of(frames, a), d.gain) for a, d in decoded.items()]
        coordinates = [d.coordinates for d in decoded.values()]
        if setup.scan.detector == "variation":
            counts = [len(d.gain) for d in decoded.values()]
            statistic, dof = variation_statistic(variations, [d.sigma_z for d in decoded.values()], counts)
        else:
            statistic, dof = misfit_statistic(coordinates)
        if setup.scan.detector == "pooled":
            detection = _detect_pooled(frames, decoded, usable, setup)
        else:
            detection = detect(statistic, dof, coordinates, usable, setup.scan.false_alarm_rate)
        refused = detection.region | detection.depth_edge | detection.suspicious
        clean = usable & maps.valid & ~refused
        separated = separate_region(frames, decoded, detection, clean, setup)
        flags = first_flags(usable, frames.saturated, [u for u in (maps.x_p, maps.y_p) if u is not None])
        flags[detection.region] |= np.uint16(Flag.INTERREFLECTION)
        flags[detection.depth_edge] |= np.uint16(Flag.DEPTH_EDGE)
        flags[detection.suspicious] |= np.uint16(Flag.MISFIT)
        known = {
            a: (u, s) for a, u, s in (("x", maps.x_p, maps.sigma_x), ("y", maps.y_p, maps.sigma_y)) if u is not None
        }
        results: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        for axis, (u, sigma) in known.items():
            u, sigma = u.copy(), sigma.copy()  # type: ignore[union-attr]
            u[refused] = sigma[refused] = np.nan
            _put(u, separated, separated.u[axis])  # type: ignore[index]
            _put(sigma, separated, separated.sigma[axis])  # type: ignore[index]
            results[axis] = (u, sigma)
        flags.reshape(-1)[separated.pixels[separated.trusted]] |= np.uint16(Flag.SEPARATED)
        for flag, which in ((Flag.THIRD_PATH, separated.third), (Flag.OFF_EPIPOLAR, separated.off_line)):
            flags.reshape(-1)[separated.pixels[which]] |= np.uint16(flag)
        untold = detection.region & ((flags & Flag.SEPARATED) == 0)
        flags[untold] |= np.uint16(Flag.MISFIT)
        x, sigma_x = results.get("x", (None, None))
        y, sigma_y = results.get("y", (None, None))
        first = replace(
            maps,
            x_p=x,
            y_p=y,
            sigma_x=sigma_x,
            sigma_y=sigma_y,
            variation=np.sqrt(np.mean(np.square(variations), axis=0, dtype=np.float32)),
            interreflection=detection.region,
            flags=flags,
            x_p_round1=maps.x_p,
            y_p_round1=maps.y_p,
            score=detection.statistic,
        )
        evidence = weigh(separated, frames.plan.size)
        return FirstRound(
            refuse_off_epipolar(first, setup.rig),
            frames.plan,
            _Private(decoded, detection, separated, evidence),
            decision=evidence.decision(setup.scan.rounds, frames.plan.frame_count) if separated.pixels.size else "",
        )

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """The same fringes, lit only where the scan's rule says; None where there is no bounce or one round does."""
        assert isinstance(first.private, _Private)
        if not first.private.detection.region.any() or first.private.evidence.one_round(setup.scan.rounds):
            return None
        size = first.plan.size
        if setup.scan.regional_rule == "literal":
            undetected = ~first.private.detection.region
            x, y = first.maps.x_p_round1, first.maps.y_p_round1
            shape = undetected.sum()
            nothing = np.full(shape, np.nan, np.float32)
            mask = literal_mask(nothing if x is None else x[undetected], nothing if y is None else y[undetected], size)
        else:
            mask = self._sound(first.private, size, setup.scan.lit_margin_px)
        if not mask.any():
            return None
        return replace(first.plan, mask=mask)

    @staticmethod
    def _sound(private: _Private, size: tuple[int, int], margin_px: float) -> NDArray[np.bool_]:
        """Light the surfaces of the region that do not light each other, and what lies between their pixels."""
        s = private.separated
        nothing = np.full(s.shape, np.nan, np.float32)
        x, y, bounce_x, bounce_y = (
            _plane(s, values[a]) if a in values else nothing for values in (s.u, s.bounce) for a in ("x", "y")
        )
        chosen = _plane(s, np.ones(s.pixels.size, np.float32)) == 1
        if len(s.u) == 2:
            chosen &= lit_together(x, y, bounce_x, bounce_y)
        # Where the fringe orders of both paths could not be told, the surface around them can.
        between = private.detection.region & ~chosen
        direct = [
            np.append(u[chosen], continued(u, chosen, between) if a in s.u else nothing[between])
            for a, u in (("x", x), ("y", y))
        ]
        emitters = bounce_x[chosen], bounce_y[chosen]
        return sound_mask(direct[0], direct[1], size, margin_px, emitters, pitch(x, y))

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Inside the region round two where it passes, else the separated paths where clear; outside, round one.

        Round two goes first even where the separation predicts the smaller σ: it removed the bounce, the separation has
        to assume how many there are, and where both paths nearly coincide its σ says little.
        """
        assert isinstance(first.private, _Private)
        assert isinstance(second, RoundPhasors)
        private, lit = first.private, second.plan.mask
        assert lit is not None
        decoded = decode_axes(second, setup, {a: d.gain for a, d in private.decoded.items()})
        if set(decoded) != set(private.decoded):
            return replace(first.maps, lit=lit)
        coordinates = [d.coordinates for d in decoded.values()]
        total, dof = misfit_statistic(coordinates)
        maps2, usable = one_path_maps(second, decoded, setup)
        region = private.detection.region
        target = _dilated(region, _HALO_PX) & ~private.detection.depth_edge
        limit = chi2_distribution.isf(1 / _REFUSED_ONE_IN, dof) * private.detection.excess_noise
        x2, y2 = maps2.x_p, maps2.y_p
        lit_here = _lit_here(lit, x2, y2)
        fits = total < np.float32(limit)
        passed = target & usable & fits & lit_here & maps2.valid
        flags = first.maps.flags.copy()
        flags[region & usable & ~lit_here & maps2.valid] |= np.uint16(Flag.NOT_LIT)
        flags[region & second.saturated] |= np.uint16(Flag.SATURATED)
        one = first.maps

        def merged(old: NDArray[np.float32] | None, new: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            return None if old is None or new is None else np.where(passed, new, old)

        flags[passed] |= np.uint16(Flag.SECOND_ROUND)
        flags[passed] &= ~np.uint16(
            Flag.SEPARATED | Flag.MISFIT | Flag.NOT_LIT | Flag.OFF_EPIPOLAR | Flag.OUT_OF_VOLUME
        )
        fused = replace(
            one,
            flags=flags,
            misfit_round2=np.where(target & usable, total / np.float32(dof), np.float32(np.nan)),
            lit=lit,
            regional_pattern=second.example,
            x_p=merged(one.x_p, maps2.x_p),
            y_p=merged(one.y_p, maps2.y_p),
            sigma_x=merged(one.sigma_x, maps2.sigma_x),
            sigma_y=merged(one.sigma_y, maps2.sigma_y),
        )
        return refuse_off_epipolar(fused, setup.rig)


def _detect_pooled(
    frames: RoundPhasors, decoded: dict[Axis, DecodedAxis], usable: NDArray[np.bool_], setup: Setup
) -> Detection:
    """Pool the residuals of all axes and detect."""
    coordinates = [d.coordinates for d in decoded.values()]
    statistic, dof = misfit_statistic(coordinates)
    residuals = [
        one_path_residuals(phasors_of(frames, a), d.coordinates, d.sigma_z, d.gain, usable) for a, d in decoded.items()
    ]
    return detect_pooled(residuals, statistic, dof, coordinates, usable, setup.scan.false_alarm_rate)


def _put(plane: NDArray[np.float32], separated: Separated, values: NDArray[np.float32]) -> None:
    plane.reshape(-1)[separated.pixels[separated.trusted]] = values[separated.trusted]


def _plane(separated: Separated, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) values of the plausible pixels, NaN elsewhere."""
    plane = np.full(separated.shape, np.nan, np.float32)
    plane.reshape(-1)[separated.pixels[separated.plausible]] = values[separated.plausible]
    return plane


def _dilated(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)


def _lit_here(
    lit: NDArray[np.bool_], x: NDArray[np.float32] | None, y: NDArray[np.float32] | None
) -> NDArray[np.bool_]:
    """Whether a coordinate of round two lies where it was lit and its fringes were whole."""
    if x is not None and y is not None:
        return inside(lit, x, y, max(_CLEARANCE_PX, math.ceil(_CLEARANCE_PITCHES * pitch(x, y))))
    if x is not None:
        columns = np.asarray(lit.any(axis=0))
        return inside(np.repeat(columns[None], lit.shape[0], axis=0), x, np.zeros_like(x), _CLEARANCE_PX)
    assert y is not None
    rows = np.asarray(lit.any(axis=1))
    return inside(np.repeat(rows[:, None], lit.shape[1], axis=1), np.zeros_like(y), y, _CLEARANCE_PX)
