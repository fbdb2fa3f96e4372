"""The exposure to measure with: the longest at which the projector's white does not saturate what it lights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calibration.observations import Finding
from drivers import Pixels
from scanner.preview.measures import BRIGHTEST, TARGET, dark_below_dn

MAX_SHOTS = 12

_UP, _DOWN = 16.0, 8.0
_TELLING = 0.05
_DARK = 0.5
_LEAST = 0.1
_ROUNDING = 1e-6
_AIM = 0.98  # of the target, so that noise does not take the last shot over it
_NEAR = 1.03


@dataclass(frozen=True)
class Shot:
    """One frame of the search.

    Parameters
    ----------
    exposure_us
        How long, µs.
    brightest
        Grey value that 99.5 % of the lit pixels do not exceed, as a share of full scale.
    saturated_share
        Share of the lit pixels that are saturated.
    lit_share
        Share of all pixels that are lit.
    """

    exposure_us: float
    brightest: float
    saturated_share: float
    lit_share: float


@dataclass(frozen=True)
class ExposureChoice:
    """The result of a search.

    Parameters
    ----------
    exposure_us
        The exposure to use, µs; where a finding refuses, the one that comes nearest.
    periods
        The same in periods of the projector; None where none was given.
    brightest, saturated_share
        Of the frame that verified it, as `Shot`.
    reason
        Why this one, in words.
    shots
        All that was photographed, in order.
    findings
        What is wrong, if anything, and what to do.
    """

    exposure_us: float
    periods: int | None
    brightest: float
    saturated_share: float
    reason: str
    shots: tuple[Shot, ...]
    findings: tuple[Finding, ...]

    @property
    def good(self) -> bool:
        """Whether the exposure may be used."""
        return not any(f.refuses for f in self.findings)


def search_exposure(
    photograph: Callable[[float], Pixels],
    *,
    saturated_dn: int,
    minimum_us: float,
    maximum_us: float,
    period_s: float | None = None,
    start_us: float | None = None,
    max_saturated_share: float = 0.001,
    target: float = TARGET,
) -> ExposureChoice:
    """Find the longest exposure that the saturation rule allows, in few shots.

    Grey values are taken to rise in proportion to the exposure above that of the dark; what is chosen was photographed
    and found to keep the rule. An exposure that is a whole multiple of the projector's period sees every part of its
    picture equally long.

    Parameters
    ----------
    photograph
        Takes a frame (H, W) under full white with the exposure in µs that it is given.
    saturated_dn
        Grey value of a saturated pixel.
    minimum_us, maximum_us
        What the camera allows and the operator has patience for, µs.
    period_s
        Of the projector, s; None where any exposure will do.
    start_us
        Where to begin, such as the present exposure; None begins with the shortest that is allowed.
    max_saturated_share
        Share of the lit pixels that may be saturated.
    target
        Share of full scale that the brightest pixels (99.5 % quantile of the lit ones) must not exceed.

    Raises
    ------
    ValueError
        Limits that allow nothing: no whole period between them, or a maximum below the minimum.

    Notes
    -----
    Fewer than five shots as a rule: each tells the next one's factor. One that saturates, or shows next to nothing,
    tells only the direction; it is followed by an eighth, or by sixteen times as much.
    """
    if not 0 < minimum_us <= maximum_us:
        raise ValueError(f"exposures from {minimum_us:g} to {maximum_us:g} µs: the maximum must not be the smaller")
    search = _Search(photograph, saturated_dn, minimum_us, maximum_us, period_s, max_saturated_share, target)
    shortest, longest = search.allowed(minimum_us, up=True), search.allowed(maximum_us)
    if shortest > longest * (1 + _ROUNDING):
        raise ValueError(
            f"no multiple of the projector's {1e3 * (period_s or 0):.4g} ms lies between {minimum_us:g} and"
            f" {maximum_us:g} µs"
        )
    wanted = shortest if start_us is None else min(max(search.allowed(start_us), shortest), longest)
    while len(search.shots) < MAX_SHOTS:
        shot = search.shoot(wanted)
        upper = min((s.exposure_us for s in search.shots if not search.keeps(s)), default=math.inf)
        lower = max((s.exposure_us for s in search.shots if search.keeps(s)), default=0.0)
        if lower >= longest * (1 - _ROUNDING) or upper <= shortest * (1 + _ROUNDING):
            break
        factor = search.factor(shot)
        if search.keeps(shot) and 1 <= factor < _NEAR:
            break
        wanted = min(max(search.allowed(wanted * factor), shortest), longest)
        if wanted >= upper * (1 - _ROUNDING):
            # The frames contradict the prediction.
            wanted = max(search.between(lower, upper), shortest)
        if wanted <= lower * (1 + _ROUNDING):
            break
    return search.result(shortest, longest)


@dataclass
class _Search:
    """The shots so far, and what they say."""

    photograph: Callable[[float], Pixels]
    saturated_dn: int
    minimum_us: float
    maximum_us: float
    period_s: float | None
    max_saturated_share: float
    target: float

    def __post_init__(self) -> None:
        self.shots: list[Shot] = []
        self.frames: dict[float, Pixels] = {}

    def allowed(self, exposure_us: float, *, up: bool = False) -> float:
        """The nearest exposure not longer (``up``: not shorter) that is a multiple of the period, µs."""
        if self.period_s is None:
            return exposure_us
        periods = exposure_us * 1e-6 / self.period_s
        whole = math.ceil(periods * (1 - _ROUNDING)) if up else math.floor(periods * (1 + _ROUNDING))
        return max(whole, int(up)) * self.period_s * 1e6

    def between(self, lower: float, upper: float) -> float:
        """An exposure half way, in stops, from one that keeps the rule (0: none does) to one that is too long, µs."""
        return self.allowed(math.sqrt(lower * upper) if lower else upper / _DOWN)

    def shoot(self, exposure_us: float) -> Shot:
        frame = self.photograph(exposure_us).copy()
        self.frames[exposure_us] = frame
        lit = frame > dark_below_dn(self.saturated_dn)
        values = frame[lit] if lit.any() else frame.reshape(-1)
        shot = Shot(
            exposure_us,
            float(np.quantile(values, BRIGHTEST)) / self.saturated_dn,
            float((values >= self.saturated_dn).mean()),
            float(lit.mean()),
        )
        self.shots.append(shot)
        return shot

    def keeps(self, shot: Shot) -> bool:
        return shot.saturated_share <= self.max_saturated_share and shot.brightest <= self.target

    def factor(self, shot: Shot) -> float:
        """By how much the exposure may change, from the shots that are not clipped and see light."""
        telling = [s for s in self.shots if _TELLING < s.brightest < 0.98 and s.lit_share > 0]
        if shot not in telling:
            return _UP if shot.brightest <= _TELLING else 1 / _DOWN
        return self._longest(telling) / shot.exposure_us

    def _longest(self, telling: list[Shot]) -> float:
        """Exposure (µs) at which the brightest pixels come near the target, by a line through two shots, or one."""
        a = max(telling, key=lambda s: s.exposure_us)
        others = [s for s in telling if s.exposure_us < 0.7 * a.exposure_us]
        black = 0.0
        if others:
            b = min(others, key=lambda s: s.exposure_us)
            # Of the same pixels: those that are lit in the longer one.
            lit = self.frames[a.exposure_us] > dark_below_dn(self.saturated_dn)
            before = float(np.quantile(self.frames[b.exposure_us][lit], BRIGHTEST)) / self.saturated_dn
            slope = (a.brightest - before) / (a.exposure_us - b.exposure_us)
            black = min(max(a.brightest - slope * a.exposure_us, 0.0), 0.9 * before)
        return a.exposure_us * (_AIM * self.target - black) / (a.brightest - black)

    def result(self, shortest: float, longest: float) -> ExposureChoice:
        keeping = [s for s in self.shots if self.keeps(s)]
        findings: list[Finding] = []
        if keeping:
            best = max(keeping, key=lambda s: s.exposure_us)
            at_the_end = best.exposure_us >= longest * (1 - _ROUNDING)
            reason = (
                f"{self._said(best)}: " + ("the longest allowed" if at_the_end else "the longest that keeps the rule")
            ) + f", brightest lit pixels at {100 * best.brightest:.0f} % of full scale"
            if at_the_end and best.brightest < _DARK:
                findings.append(self._too_dark(best))
        else:
            best = min(self.shots, key=lambda s: s.exposure_us)
            reason = f"{self._said(best)}: the shortest allowed, and still too bright"
            findings.append(self._too_bright(best, shortest))
        return ExposureChoice(
            best.exposure_us,
            None if self.period_s is None else round(best.exposure_us * 1e-6 / self.period_s),
            best.brightest,
            best.saturated_share,
            reason,
            tuple(self.shots),
            tuple(findings),
        )

    def _said(self, shot: Shot) -> str:
        if self.period_s is None:
            return f"{shot.exposure_us:.0f} µs"
        periods = round(shot.exposure_us * 1e-6 / self.period_s)
        return f"{shot.exposure_us:.0f} µs = {periods} period{'s' if periods > 1 else ''} of the projector"

    def _too_dark(self, best: Shot) -> Finding:
        stops = math.log2(self.target / max(best.brightest, 1 / self.saturated_dn))
        return Finding(
            "too_dark",
            best.brightest < _LEAST or best.lit_share == 0,
            f"at the longest exposure allowed, {best.exposure_us:.0f} µs, white reaches {100 * best.brightest:.0f} % of"
            " full scale",
            f"Open the aperture by {stops:.1f} stops, or raise the camera's gain by {6.02 * stops:.0f} dB; a longer"
            " exposure or a brighter projector mode helps as well.",
        )

    def _too_bright(self, best: Shot, shortest: float) -> Finding:
        unsaturated = self._below(shortest)
        if unsaturated is not None:
            factor = shortest / self._longest([unsaturated])
            stops = f"{math.log2(factor):.1f} stops"
        elif best.brightest < 1:
            stops = f"{math.log2(best.brightest / self.target):.1f} stops"
        else:
            stops = "2 stops, then search again (how far the light goes beyond full scale cannot be seen)"
        at = "one period of the projector" if self.period_s and shortest <= 1.5e6 * self.period_s else "the shortest"
        return Finding(
            "too_bright",
            True,
            f"at {at}, {shortest:.0f} µs, {100 * best.saturated_share:.1f} % of the lit pixels are saturated, at most"
            f" {100 * self.max_saturated_share:g} % may be",
            f"Close the aperture by {stops}, or use a neutral density filter, less gain or a darker projector mode.",
        )

    def _below(self, shortest: float) -> Shot | None:
        """A shot below the shortest allowed one, whose only use is to see how far the light goes beyond full scale."""
        exposure = shortest
        while exposure / _DOWN >= self.minimum_us and len(self.shots) < MAX_SHOTS:
            exposure /= _DOWN
            shot = self.shoot(exposure)
            if shot.brightest < 0.98:
                self.shots.remove(shot)
                return shot if shot.brightest > _TELLING else None
        return None
