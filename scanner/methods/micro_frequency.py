"""Micro-frequency shifting (MFS) in two rounds (Optics Express 27(20) 28293; method.md §§2-7).

Round one projects nine slightly different frequencies on each axis. Where the fringes of a pixel do not fit one path, a
bounce arrives; there the two paths are separated. Round two lights only where the direct light of those pixels comes
from, so that the bounce has no source. Inside the region round two is kept where it passes its own test, else the
separation where it is clear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from drivers import FrameFormat
from scanner.config import ScanSection
from scanner.interreflection import (
    FEWEST,
    Detection,
    detect,
    detect_pooled,
    excess_noise,
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
from scanner.methods.fold import Fold, doubted_beside, find_folds
from scanner.methods.multi_frequency import DecodedAxis, decode_axes, one_path_maps
from scanner.methods.regional import (
    MOST_SEQUENCES,
    WORTH,
    Regional,
    again,
    begin,
    concluded,
    lit_here,
    plane,
)
from scanner.methods.scene import faces_seen
from scanner.methods.separated import Separated, phasors_of, separate_region
from scanner.methods.sufficiency import Evidence, weigh
from scanner.methods.weak_bounces import without_ripples
from scanner.patterns import AXES, Axis, Plan
from scanner.phasors import RoundPhasors
from scanner.pooling import one_path_residuals
from scanner.regions import literal_mask
from scanner.result import Flag, Maps
from scanner.strays import strays

FREQUENCIES = 9
"""T: frequencies an axis; t = 0..8."""

_REFUSED_ONE_IN = 1e4
"""Of good coordinates one in so many is refused by its own χ²."""

_HALO_PX = 2
"""Round two also serves the pixels this near to the region, whose bounce is below detection."""

_SAME_PLACE_PX = 4.0
"""A coordinate as near as this to another is of the same place: a quarter of a fringe."""

_DIRECT_SHARE = 0.5
"""Least modulation of a place that round one did not expect, in units of round one's: less is a bounce."""


def frequencies(extent: int) -> tuple[float, ...]:
    """f_t = (n + t)/L, t = 0..8, with n the fringes of about 16 px in L px: (80 + t)/1280 for L = 1280."""
    fringes = round(extent / 16)
    return tuple((fringes + t) / extent for t in range(FREQUENCIES))


@dataclass(frozen=True)
class _Private:
    decoded: dict[Axis, DecodedAxis]
    detection: Detection
    separated: Separated
    regional: Regional


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
        seen = usable & ~detection.region & ~detection.depth_edge
        decoded, rippled, told = without_ripples(frames, decoded, seen, clean, setup)
        separated = separate_region(frames, decoded, detection, clean, setup)
        fold = find_folds(separated, detection, maps.x_p, maps.y_p, frames.plan.size)
        separated = doubted_beside(fold, separated)
        flags = first_flags(usable, frames.saturated, [u for u in (maps.x_p, maps.y_p) if u is not None])
        flags[detection.region] |= np.uint16(Flag.INTERREFLECTION)
        flags[detection.depth_edge] |= np.uint16(Flag.DEPTH_EDGE)
        flags[detection.suspicious] |= np.uint16(Flag.MISFIT)
        flags[told] |= np.uint16(Flag.RIPPLE)
        flags[fold.blind] |= np.uint16(Flag.BLIND)
        planes: tuple[tuple[Axis, NDArray[np.float32] | None, NDArray[np.float32] | None], ...] = (
            ("x", maps.x_p, maps.sigma_x),
            ("y", maps.y_p, maps.sigma_y),
        )
        known: dict[Axis, tuple[NDArray[np.float32], NDArray[np.float32]]] = {
            a: (np.where(rippled, decoded[a].coordinates.u, u), np.where(rippled, decoded[a].coordinates.sigma, s))
            for a, u, s in planes
            if u is not None and s is not None
        }
        results: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        for axis, (u, sigma) in known.items():
            u[refused | fold.blind] = sigma[refused | fold.blind] = np.nan
            _put(u, separated, separated.u[axis])
            _put(sigma, separated, separated.sigma[axis])
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
        regional = self._begun(first, separated, detection, fold, evidence, frames.plan, setup)
        return FirstRound(
            _finished(first, setup),
            frames.plan,
            _Private(decoded, detection, separated, regional),
            regional=max(regional.planned, 1),
            decision=evidence.decision(setup.scan.rounds, frames.plan.frame_count) if separated.pixels.size else "",
        )

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """The same fringes, lit only where the next regional sequence lights; None where there is none."""
        assert isinstance(first.private, _Private)
        if not first.private.regional.queue:
            return None
        return replace(first.plan, mask=first.private.regional.queue[0])

    def _begun(
        self,
        maps: Maps,
        separated: Separated,
        detection: Detection,
        fold: Fold,
        evidence: Evidence,
        plan: Plan,
        setup: Setup,
    ) -> Regional:
        """What the regional sequences are to light."""
        region, scan = detection.region, setup.scan
        if self.rounds == 1 or scan.rounds == 1 or not region.any():
            return Regional.nothing(region.shape, plan.size)
        most = scan.max_regional_sequences if scan.regional_rule == "sound" else 1
        faces = faces_seen(setup.rig, maps, separated, fold) if most > 1 else None
        begun = begin(separated, detection, fold, faces, maps, plan.size, scan.lit_margin_px, most)
        if evidence.one_round(scan.rounds):
            return replace(begun, queue=())
        if scan.regional_rule == "literal":
            undetected = ~region
            nothing = np.full(int(undetected.sum()), np.nan, np.float32)
            x, y = (nothing if u is None else u[undetected] for u in (maps.x_p_round1, maps.y_p_round1))
            mask = literal_mask(x, y, plan.size)
            return replace(begun, queue=(mask,) if mask.any() else ())
        return begun

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Join a regional sequence; see `join`."""
        return self.join(first, second, setup).maps

    def join(self, first: FirstRound, regional: RoundFrames, setup: Setup) -> FirstRound:
        """Inside the region a regional sequence where it passes, else the separated paths where clear.

        A regional sequence goes first even where the separation predicts the smaller σ: it removed the bounce, the
        separation has to assume how many there are, and where both paths nearly coincide its σ says little.

        Of several sequences that show the same place that counts which was meant for it, or fits best; of several
        places the brighter, since a pixel that is dark itself may still see its bounce.
        """
        assert isinstance(first.private, _Private)
        assert isinstance(regional, RoundPhasors)
        private, lit = first.private, regional.plan.mask
        assert lit is not None
        state = private.regional
        state = replace(
            state,
            queue=state.queue[1:],
            taken=state.taken + 1,
            lit=state.lit | np.where(lit, np.uint8(1 << min(state.taken, 7)), np.uint8(0)),
        )
        decoded = decode_axes(regional, setup, {a: d.gain for a, d in private.decoded.items()})
        if set(decoded) != set(private.decoded):
            return replace(first, maps=replace(first.maps, lit=state.lit > 0), private=replace(private, regional=state))
        found, usable = one_path_maps(regional, decoded, setup)
        whole = usable & lit_here(lit, found.x_p, found.y_p)
        decoded, rippled, told = without_ripples(regional, decoded, whole, whole, setup)
        if rippled.any():
            found, _ = one_path_maps(regional, decoded, setup)
        total, dof = misfit_statistic([d.coordinates for d in decoded.values()])
        only = state.planned == 1
        if not only:
            found = refuse_off_epipolar(found, setup.rig)
        region = private.detection.region
        own = state.own == state.taken
        blind = (first.maps.flags & np.uint16(Flag.BLIND)) > 0
        target = ((_dilated(region, _HALO_PX) & ~private.detection.depth_edge) | (state.served & own)) & ~blind
        here = lit_here(lit, found.x_p, found.y_p)
        # Where bounces cover the picture, round one overrates the noise; a sequence without them does not.
        counted = target & usable & here
        excess = private.detection.excess_noise
        if np.count_nonzero(counted) >= FEWEST:
            excess = min(excess, excess_noise(total, dof, counted))
        limit = chi2_distribution.isf(1 / _REFUSED_ONE_IN, dof) * excess
        fits = total < np.float32(limit)
        misfit = total / np.float32(dof)
        passed = target & usable & fits & here & found.valid
        if not only:
            passed &= _near(found, state.x, state.y) | (found.modulation >= _DIRECT_SHARE * first.maps.modulation)
        before = state.sequence > 0
        same = _near(found, first.maps.x_p, first.maps.y_p)
        rather = own | state.doubted | ((state.sequence != state.own) & (misfit < state.misfit))
        better = np.where(same, rather, found.modulation > state.modulation)
        passed &= ~before | better
        state = replace(
            state,
            sequence=np.where(passed, np.uint8(state.taken), state.sequence),
            doubted=state.doubted & ~passed,
            modulation=np.where(passed, found.modulation, state.modulation),
            misfit=np.where(passed, misfit, state.misfit),
        )
        flags = first.maps.flags.copy()
        flags[region & usable & ~here & found.valid & (state.sequence == 0)] |= np.uint16(Flag.NOT_LIT)
        flags[region & regional.saturated] |= np.uint16(Flag.SATURATED)
        flags[passed] |= np.uint16(Flag.SECOND_ROUND)
        flags[passed] &= ~np.uint16(
            Flag.SEPARATED
            | Flag.MISFIT
            | Flag.NOT_LIT
            | Flag.OFF_EPIPOLAR
            | Flag.OUT_OF_VOLUME
            | Flag.RIPPLE
            | Flag.STRAY
        )
        flags[passed & told] |= np.uint16(Flag.RIPPLE)
        # With fewer bounces than round one, the sequence still sees one: round one's coordinate cannot stand either.
        there = lit_here(lit, first.maps.x_p, first.maps.y_p)
        refuted = target & ~region & usable & there & ~fits & (state.sequence == 0)
        flags[refuted] |= np.uint16(Flag.MISFIT)
        one = first.maps

        def merged(old: NDArray[np.float32] | None, new: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
            if old is None or new is None:
                return None
            return np.where(passed, new, np.where(refuted, np.float32(np.nan), old))

        tested = target & usable & (passed | (state.sequence == 0))
        old = np.float32(np.nan) if one.misfit_round2 is None else one.misfit_round2
        fused = replace(
            one,
            flags=flags,
            misfit_round2=np.where(tested, misfit, old),
            lit=state.lit > 0,
            lit_by=state.lit,
            sequence=state.sequence,
            regional_pattern=regional.example if one.regional_pattern is None else one.regional_pattern,
            x_p=merged(one.x_p, found.x_p),
            y_p=merged(one.y_p, found.y_p),
            sigma_x=merged(one.sigma_x, found.sigma_x),
            sigma_y=merged(one.sigma_y, found.sigma_y),
        )
        if state.taken + len(state.queue) < state.most and len(decoded) == 2:
            state = self._learned(regional, decoded, passed, target & usable & here, private.detection, state, setup)
            if not state.queue:
                state = again(state, region, private.separated, first.plan.size, setup.scan.lit_margin_px)
        joined = replace(
            first,
            maps=_finished(fused, setup),
            private=replace(private, regional=state),
            regional=max(state.planned, 1),
            notes=[],
        )
        more = setup.scan.regional_rule == "sound" and len(decoded) == 2 and state.most < MOST_SEQUENCES
        return concluded(joined, first.decision, region, state, more)

    def skip(self, first: FirstRound) -> FirstRound:
        """Go on without the sequence that `second_round` has planned."""
        assert isinstance(first.private, _Private)
        state = first.private.regional
        state = replace(state, queue=state.queue[1:], taken=state.taken + 1)
        return replace(first, private=replace(first.private, regional=state), notes=[])

    @staticmethod
    def _learned(
        regional: RoundPhasors,
        decoded: dict[Axis, DecodedAxis],
        passed: NDArray[np.bool_],
        asked: NDArray[np.bool_],
        detection: Detection,
        state: Regional,
        setup: Setup,
    ) -> Regional:
        """Detect again what a regional sequence shows, and keep where direct light and bounce come from there."""
        coordinates = [d.coordinates for d in decoded.values()]
        total, dof = misfit_statistic(coordinates)
        still = detect(total, dof, coordinates, asked, setup.scan.false_alarm_rate)
        if still.region.sum() <= WORTH * detection.region.sum():
            return state
        found = separate_region(regional, decoded, still, passed & ~still.region, setup)
        paths = np.stack([plane(found, values[a]) for values in (found.u, found.bounce) for a in AXES])
        return replace(
            state,
            failed=np.where(np.isfinite(paths[:1]), paths, state.failed),
            doubted=state.doubted | (still.region & (passed | (state.sequence == 0))),
        )


def _near(maps: Maps, x: NDArray[np.float32] | None, y: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Whether the coordinates lie where others are, (H, W); False where either is unknown."""
    near = np.ones(maps.flags.shape, bool)
    for u, v in ((maps.x_p, x), (maps.y_p, y)):
        if u is not None and v is not None:
            near &= np.abs(u - v) <= _SAME_PLACE_PX
    return near


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


def _finished(maps: Maps, setup: Setup) -> Maps:
    """Points, without strays and without coordinates off their epipolar line."""
    lost = strays(maps.x_p, maps.y_p)
    nan = np.float32(np.nan)
    x, y, sigma_x, sigma_y = (
        None if u is None else np.where(lost, nan, u) for u in (maps.x_p, maps.y_p, maps.sigma_x, maps.sigma_y)
    )
    flags = np.where(lost, maps.flags | np.uint16(Flag.STRAY), maps.flags)
    return refuse_off_epipolar(replace(maps, x_p=x, y_p=y, sigma_x=sigma_x, sigma_y=sigma_y, flags=flags), setup.rig)


def _put(plane: NDArray[np.float32], separated: Separated, values: NDArray[np.float32]) -> None:
    plane.reshape(-1)[separated.pixels[separated.trusted]] = values[separated.trusted]


def _dilated(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0)
