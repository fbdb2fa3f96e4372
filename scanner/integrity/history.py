"""What the good sequences of a scan have shown, as far as it tells whether the next one is right.

A sequence may be flawless in itself and yet not be the one that was asked for: all its pictures may belong to another,
or come one step late and so begin anywhere. And three phase steps fit any three frames. Four things are the same in all
sequences of a round, whatever their axis and frequency: the last picture of one is not the first of the next; the mean
A of the steps, since their mean pattern is a uniform grey; the pixels that are lit; and the coordinate of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers import Pixels
from scanner.integrity.agreement import Rounding, Shown, same, standing_out
from scanner.integrity.findings import AtOdds
from scanner.integrity.sampling import Grid, Noise, gradients, grid
from scanner.integrity.waveform import FEWEST, Reference, Waveform, free_harmonics, other_mean, series
from scanner.patterns import Axis, FringeSequence

_LOST = 0.2
_STRONG = 0.4
_UNCLIPPED = 0.97
_SAME_PICTURE, _OTHER_PICTURE = 1.5, 4.0
_DIVERSE = 0.5
_SAME_PHASES = 1.5
_CONVINCED = 50.0
_AGREED, _DISAGREED = 0.6, 0.2
_ASKED = 128
_UNWRAP_FROM = 2
_NEARLY_AS_SURE = 0.5


@dataclass
class SequenceHistory:
    """The memory of one scan: make one for it, `begin_round` with each round, and give it to every `check_sequence`.

    Attributes
    ----------
    linear
        Whether the projector has been found to respond linearly, and never otherwise.
    noise_dn
        Of a grey value in the sequences so far, DN; infinite before the first.
    round_noise
        The same of those of this round, in which the same pixels are lit; None before the first.
    latest
        (P,) the last frame of the latest sequence, good or not, at the sampled pixels.

    Notes
    -----
    It is not safe to share among threads, and sequences must be checked in the order in which they were exposed.
    """

    _round: int = 0
    _noises: list[float] = field(default_factory=list)
    _shown: list[Shown] = field(default_factory=list)
    _doubted: dict[tuple[int, Axis, float], list[Shown]] = field(default_factory=dict)
    _accepted: tuple[Axis, float | None] = ("x", None)
    _wrong: list[tuple[Axis, float | None]] = field(default_factory=list)
    _settled: set[tuple[int, Axis, float]] = field(default_factory=set)
    _last: NDArray[np.float32] | None = None
    latest: NDArray[np.float32] | None = None
    _former: NDArray[np.float32] | None = None
    _mean: NDArray[np.float32] | None = None
    _means: int = 0
    _modulation: NDArray[np.float32] | None = None
    _lit: NDArray[np.bool_] | None = None
    linear: bool = False
    _distorts: bool = False
    noise_dn: float = float("inf")
    round_noise: Noise | None = None
    _extent: dict[Axis, int] = field(default_factory=dict)
    _known: dict[Axis, NDArray[np.float32]] = field(default_factory=dict)
    _levels: NDArray[np.float32] | None = None
    _contradicting: list[tuple[NDArray[np.float32], NDArray[np.bool_], tuple[Axis, float | None]]] = field(
        default_factory=list
    )
    _unclipped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    _frames: int = 0

    def begin_round(
        self,
        size: tuple[int, int],
        *,
        levels: tuple[Pixels, Pixels] | None = None,
        saturated_dn: int = 1 << 16,
        coordinates: tuple[NDArray[np.float32] | None, NDArray[np.float32] | None] = (None, None),
        lit: NDArray[np.bool_] | None = None,
    ) -> None:
        """Forget what does not hold any more; from here on the pictures are those of another plan.

        Parameters
        ----------
        size
            Projector (width, height), px.
        levels
            (H, W) frames under the brightest and the darkest uniform picture, where they were taken and all of the
            projector is lit: the mean of every sequence lies between them by the same share.
        saturated_dn
            Grey value from which a pixel of ``levels`` says nothing.
        coordinates
            (H, W) projector coordinates x and y that an earlier round has found, NaN where unknown.
        lit
            (height, width) projector pixels that the round lights; None for all.
        """
        self._round += 1
        self.round_noise = None
        self._extent = {"x": size[0], "y": size[1]}
        self._mean = self._modulation = self._lit = self._levels = None
        self._means, self._known, self._contradicting = 0, {}, []
        if levels is not None:
            cells = grid(levels[0].shape)
            self._levels = cells.take_all(np.stack(levels))
            # Not up to the last grey value: of pixels about there, the noise would choose the dark ones.
            self._unclipped = self._levels[0] < _UNCLIPPED * saturated_dn
        for axis, u in zip(("x", "y"), coordinates, strict=True):
            if u is not None:
                self._known[axis] = grid(u.shape).take(u)  # type: ignore[index]
        if lit is not None and len(self._known) == 2:
            x, y = self._known["x"], self._known["y"]
            there = np.isfinite(x) & np.isfinite(y)
            column = np.clip(np.rint(np.where(there, x, 0)), 0, size[0] - 1).astype(np.intp)
            row = np.clip(np.rint(np.where(there, y, 0)), 0, size[1] - 1).astype(np.intp)
            self._lit = there & lit[row, column]

    def extent(self, axis: Axis) -> int | None:
        """Projector pixels along ``axis``, where a round was begun."""
        return self._extent.get(axis)

    def ended(self, last: NDArray[np.float32], good: bool) -> None:
        """Take over the last frame of a sequence at the sampled pixels; of a bad one nobody knows what it shows."""
        self._last = last if good else None
        self._former, self.latest = self.latest, last

    def accept(self, fringes: FringeSequence, waveform: Waveform, valid: NDArray[np.bool_]) -> None:
        """Take over a sequence that was found good."""
        self._accepted = (fringes.axis, fringes.frequency)
        mean = np.where(valid, waveform.mean, np.float32(np.nan))
        if self._mean is None:
            self._mean, self._means, self._frames = mean, 1, len(fringes.fringes)
        else:
            # The last few weigh most: light drifts.
            self._means = min(self._means + 1, 8)
            self._mean = self._mean + (mean - self._mean) / np.float32(self._means)
        own = waveform.own_noise
        self.round_noise = own if self.round_noise is None else own.joined(self.round_noise)
        self._noises.append(own.sigma_dn)
        self.noise_dn = float(np.median(self._noises))
        found = waveform.linear()
        # Once found not to be linear, it never is: where bounces blur the fringes, they blur the harmonics out first.
        self.linear, self._distorts = (found or self.linear) and not self._distorts, found is False or self._distorts
        self._modulation = np.where(waveform.usable, np.abs(waveform.z), np.float32(0))
        if fringes.frequency is not None:
            sigma_z = waveform.sigma_dn * float(np.sqrt(2 / len(fringes.fringes)))
            shown = Shown(
                fringes.axis,
                fringes.frequency,
                waveform.z,
                sigma_z,
                waveform.usable,
                self._round,
                self._former,
                sure=free_harmonics(len(fringes.fringes)) > (1 if found else 2),
            )
            self._shown = [
                s for s in self._shown if (s.axis, s.frequency, s.round) != (shown.axis, shown.frequency, shown.round)
            ]
            self._shown.append(shown)

    def at_odds(self, shape: tuple[int, int], rounding: Rounding | None = None) -> list[AtOdds]:
        """Sequences of this round, one an axis at most, that contradict the others, once all were found good.

        To be asked again when they were taken again. One that comes out the same twice is believed: then another may be
        the wrong one, or none, and the scene or the bench makes the difference.

        Parameters
        ----------
        shape
            Of a frame, (H, W).
        rounding
            Of the round's pictures (`scanner.patterns.Plan.rounding`); None where light has no steps.
        """
        shown = [s for s in self._shown if s.round == self._round]
        if self._wrong:
            what = "the mean of its steps is not that of the sequences after it: a frame was stale, torn, mixed or dark"
            found = [AtOdds(axis, frequency, what) for axis, frequency in self._wrong]
            self._wrong = []
            return found
        sure = standing_out(shown, self._extent, grid(shape), rounding)
        found = []
        for axis in self._extent:
            against = [(float(value), s) for value, s in zip(sure, shown, strict=True) if s.axis == axis and value > 1]
            against.sort(key=lambda pair: -pair[0])
            likely = [s for value, s in against if value > _NEARLY_AS_SURE * against[0][0]]
            for s in sorted(likely, key=lambda s: len(self._doubted.get(_key(s), []))):
                takes = self._doubted.setdefault(_key(s), [])
                if takes and same(takes[-1], s):
                    self._settled.add(_key(s))
                if _key(s) not in self._settled:
                    takes.append(s)
                    what = (
                        f"the phases are at odds with what the other frequencies of axis {axis} say of the same pixels"
                    )
                    found.append(AtOdds(axis, s.frequency, f"{what}: a frame was wrong, by little in each pixel"))
                    break
        return found

    def doubt_former(
        self, fringes: FringeSequence, waveform: Waveform, valid: NDArray[np.bool_], cells: Grid, count: int
    ) -> bool:
        """Whether the levels, or the only sequence so far, are wrong, rather than one that has another mean.

        So it is where two that were refused agree with each other. A sequence that is found wrong so counts no more for
        the mean, and `at_odds` has it taken again.
        """
        if (self._mean is None and self._levels is None) or self._means > 1:
            return False
        place = (fringes.axis, fringes.frequency)
        agreed = any(
            other_mean(waveform, Reference(mean, known, 1 / count), count, cells).max() <= 1
            for mean, known, former in self._contradicting
            # A projector that lags for long may lag alike in two attempts at one sequence.
            if self._mean is None or former != place
        )
        self._contradicting.append((waveform.mean, valid & waveform.usable, place))
        if agreed and self._mean is not None:
            self._mean, self._means = None, 0
            self._wrong.append(self._accepted)
        return agreed

    # What the sequences before say of a new one; each returns what is wrong, in words, or "".

    def begins_with_the_former(
        self,
        values: NDArray[np.float32],
        steps_rad: NDArray[np.float64],
        waveform: Waveform,
        valid: NDArray[np.bool_],
    ) -> bool:
        """Whether the first of (N, P) frames is the last picture of the sequence before, and should not look like it.

        As far as the noise tells: on a small object, one picture may look like the other by chance.
        """
        lit = waveform.usable & (np.abs(waveform.z) > 4 * waveform.sigma_dn)
        if self._last is None or np.count_nonzero(lit) < FEWEST:
            return False
        if not _diverse(waveform.z[lit]):
            # All in the dark of one fringe, say: there, two pictures may look alike.
            return False
        off = float(np.sqrt(np.square(values[0, lit] - self._last[lit]).mean()))
        if off > _SAME_PICTURE * np.sqrt(2) * waveform.sigma_dn:
            return False
        # What the others, and the mean as it must be, say of the first.
        rows, others = series(steps_rad[1:], 1), values[1:, lit]
        reference = self.reference(values, valid)
        if reference is not None:
            rows, others = np.vstack([rows, [1, 0, 0]]), np.vstack([others, reference.mean[lit]])
        if len(rows) < 3:
            return True
        weights = series(steps_rad[:1], 1)[0] @ np.linalg.pinv(rows)
        noise = (1 + float(weights @ weights)) * waveform.sigma_dn**2
        apart = float(np.square(weights @ others - self._last[lit]).mean())
        return apart - noise > (_OTHER_PICTURE * waveform.sigma_dn) ** 2

    def reference(self, values: NDArray[np.float32], valid: NDArray[np.bool_]) -> Reference | None:
        """The mean A of the steps whose (N, P) ``values`` are given, as the sequences before them have it."""
        if self._mean is not None:
            known = np.isfinite(self._mean)
            return Reference(np.where(known, self._mean, np.float32(0)), known, 1 / (self._frames * self._means))
        if self._levels is None:
            return None
        bright, dark = self._levels
        contrast = bright - dark
        strong = valid & _lit_by(contrast)
        if np.count_nonzero(strong) < FEWEST:
            return None
        share = np.median((values.mean(axis=0)[strong] - dark[strong]) / contrast[strong])
        # No waveform has its mean at an end of its range: a projector that stays dark must not look like one.
        share = np.clip(share, 0.15, 0.85)
        return Reference(dark + share * contrast, valid & self._unclipped, float(share**2 + (1 - share) ** 2))

    def lost_light(self, values: NDArray[np.float32], waveform: Waveform, valid: NDArray[np.bool_]) -> str:
        """Whether the fringes are gone from where they must be, and the mean of the (N, P) frames is another as well.

        The modulation alone does not tell: where two paths of light meet, it may vanish at one frequency.
        """
        expected, reference = self._modulation, self.reference(values, valid)
        if expected is None and self._levels is not None:
            expected = (self._levels[0] - self._levels[1]) / 2
        if expected is not None and reference is not None:
            strong = reference.known & valid & (expected > _STRONG * float(np.quantile(expected, 0.995)))
            lost = ~waveform.usable | (np.abs(waveform.z) < _LOST * expected)
            off = np.square(waveform.mean - reference.mean)
        elif self._lit is not None:
            strong, lost, off = self._lit, ~waveform.usable, None
        else:
            return ""
        if np.count_nonzero(strong) < FEWEST or lost[strong].mean() < 1 - _LOST:
            return ""
        if expected is not None and off is not None and off[strong].mean() < np.square(_LOST * expected[strong]).mean():
            return ""
        return (
            f"{100 * lost[strong].mean():.0f} % of the pixels that must show fringes do not: the picture stood still, "
            "was dark, or belongs to another sequence"
        )

    def shown_before(self, fringes: FringeSequence, waveform: Waveform) -> str:
        """Whether all pictures are those of an earlier sequence, maybe turned round."""
        frequency = fringes.frequency
        assert frequency is not None
        for former in self._shown:
            if (former.axis, former.frequency) == (fringes.axis, frequency):
                continue
            both = waveform.usable & former.usable
            if np.count_nonzero(both) < FEWEST:
                continue
            z, earlier = waveform.z[both], former.z[both]
            b, before = np.abs(z), np.abs(earlier)
            sigma_z = waveform.sigma_dn * np.sqrt(2 / len(fringes.fringes))
            if not _diverse(earlier):
                continue
            turn = z * earlier.conj() / (b * before)
            off = np.angle(turn * np.conj(turn.sum()))
            expected = np.sqrt(np.square(sigma_z / b) + np.square(former.sigma_z / before) + 0.01**2)
            if np.median(np.abs(off) / expected) > _SAME_PHASES * 0.6745:
                continue
            if former.axis == fringes.axis and not self._steeper(
                former, fringes.axis, frequency, waveform, both, sigma_z
            ):
                continue
            return (
                f"the pictures are those of the sequence {former.axis} 1/{1 / former.frequency:.5g} px: the projector "
                "has not taken over the new ones"
            )
        return ""

    @staticmethod
    def _steeper(
        former: Shown, axis: Axis, frequency: float, waveform: Waveform, both: NDArray[np.bool_], sigma_z: float
    ) -> bool:
        """Whether the phases rise from pixel to pixel as the former sequence's do, and not as this one's should."""
        whole = np.repeat(both.reshape(-1, 9).all(axis=1), 9)
        now, before = gradients(waveform.z)[:, whole], gradients(former.z)[:, whole]
        moved = (now != 0) & (before != 0)
        slope, old = np.angle(now[moved]), np.angle(before[moved])
        level = np.abs(before[moved])
        variance = (sigma_z**2 + former.sigma_z**2) / np.maximum(level, 1e-6) * 2
        planned = np.angle(np.exp(1j * (slope - old * frequency / former.frequency)))
        same = np.angle(np.exp(1j * (slope - old)))

        def misfit(off: NDArray[np.float32]) -> float:
            return float(np.minimum(off**2 / variance, 9).sum())

        return misfit(planned) - misfit(same) > _CONVINCED

    def elsewhere(self, fringes: FringeSequence, waveform: Waveform) -> str:
        """Whether the phases contradict the coordinates that the sequences before, or an earlier round, have found."""
        frequency = fringes.frequency
        assert frequency is not None
        sigma_z = waveform.sigma_dn * float(np.sqrt(2 / len(fringes.fringes)))
        if fringes.axis in self._known:
            u = self._known[fringes.axis]
            there = waveform.usable & np.isfinite(u)
            if np.count_nonzero(there) >= FEWEST:
                off = waveform.z[there] * np.exp(np.complex64(-2j * np.pi * frequency) * u[there])
                return self._turned(off, len(fringes.fringes), "an earlier round")
        return self._disagrees(fringes, waveform, sigma_z)

    @staticmethod
    def _turned(off: NDArray[np.complex64], count: int, whom: str) -> str:
        near = np.pi / count
        agree = float((np.abs(np.angle(off)) < near).mean())
        if agree > _DISAGREED:
            return ""
        shares = [
            (float((np.abs(np.angle(off * np.exp(-2j * np.pi * k / count))) < near).mean()), k) for k in range(count)
        ]
        share, k = max(shares)
        if share < _AGREED:
            return ""
        return f"all phases are off by {360 * k / count:.0f}° from what {whom} found: the sequence began {k} steps off"

    def _disagrees(self, fringes: FringeSequence, waveform: Waveform, sigma_z: float) -> str:
        former = [
            s
            for s in self._shown
            if s.round == self._round and s.axis == fringes.axis and s.frequency != fringes.frequency
        ]
        if len(former) < _UNWRAP_FROM:
            return ""
        # Heavy, and not needed before the third frequency of an axis.
        from scipy.stats import chi2

        from scanner.phasors import AxisPhasors
        from scanner.unwrapping import modulation_trend, unwrap

        usable = np.flatnonzero(np.logical_and.reduce([s.usable for s in former]) & waveform.usable)
        if usable.size < FEWEST:
            return ""
        asked = usable[:: max(1, usable.size // _ASKED)]
        frequencies = np.array([s.frequency for s in former] + [float(fringes.frequency or 0)])
        z = np.stack([s.z[asked] for s in former] + [waveform.z[asked]])[:, None]
        noise = np.full((1, asked.size), max(sigma_z, *(s.sigma_z for s in former)), np.float32)
        extent = self._extent[fringes.axis]

        def agreeing(parts: int) -> float:
            phasors = AxisPhasors(fringes.axis, frequencies[:parts], np.ascontiguousarray(z[:parts]), 0.0)
            found = unwrap(phasors, noise, extent, modulation_trend(phasors, noise))
            return float((found.chi2 < chi2.isf(0.001, found.dof)).mean())

        if agreeing(len(frequencies)) > _DISAGREED or agreeing(len(former)) < _AGREED:
            return ""
        return (
            f"the phases fit no coordinate together with those of {len(former)} other sequences of axis "
            f"{fringes.axis}: pictures of another sequence, or in another order"
        )


def _key(shown: Shown) -> tuple[int, Axis, float]:
    return shown.round, shown.axis, shown.frequency


def _lit_by(contrast: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(P,) pixels that the projector surely lights, however few of all they are."""
    return np.asarray(contrast > max(0.25 * float(np.quantile(contrast, 0.995)), 8.0))


def _diverse(z: NDArray[np.complex64]) -> bool:
    """Whether phasors cover the whole circle of phases rather than a part of it."""
    return bool(abs((z / np.abs(z)).mean()) < _DIVERSE)
