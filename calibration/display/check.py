"""Which picture was seen in which exposure: the check that goes beyond a latency between black and white."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.display.coded import CodedSequence, CodeReader, Picture, number_of
from calibration.observations import Finding
from drivers import Bench, HardwareError, Pixels

REPEATS = 3
"""Exposures of each reference picture in a row; the last two must agree, so that a lag of one picture does no harm."""

_MIXED = 0.015
_SIGMAS = 6.0
_NOISY = 0.05


class DisplayError(HardwareError):
    """The display does not show what it is asked for, when it is asked for it."""


@dataclass(frozen=True, eq=False)
class DisplayCheck:
    """What a coded sequence has shown.

    Parameters
    ----------
    shown
        (n,) number of the picture that was asked for in each exposure.
    seen
        (n,) number of the picture that was seen, the one asked for where several were.
    mixed
        (n,) by how much the light of the bits is neither on nor off, where it changed during the exposure; 0 else.
    torn
        (n,) whether the bands of rows show different pictures.
    delay
        Pictures by which what is seen lags behind what is asked for, the median.
    findings
        What is wrong, if anything.
    """

    shown: NDArray[np.int64]
    seen: NDArray[np.int64]
    mixed: NDArray[np.float64]
    torn: NDArray[np.bool_]
    delay: int
    findings: tuple[Finding, ...]

    @property
    def good(self) -> bool:
        """Whether every exposure saw its own picture, whole and alone."""
        return not any(f.refuses for f in self.findings)

    def require_good(self) -> None:
        """Refuse a display that failed.

        Raises
        ------
        DisplayError
            With the first finding that refuses, and what to do.
        """
        for finding in self.findings:
            if finding.refuses:
                raise DisplayError(finding.what, finding.remedy)


def check_display(
    bench: Bench,
    *,
    bits: int = 5,
    rounds: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DisplayCheck:
    """Show a coded sequence the way a scan shows its patterns, and read off every frame which picture it saw.

    Parameters
    ----------
    bench
        Open, its latency known; the caller darkens and closes it.
    bits
        2^bits pictures, all different, make the sequence.
    rounds
        How often it is shown.
    progress
        Called with (exposures done, exposures in all).

    Raises
    ------
    PhotometryError
        The camera cannot tell the pictures apart: too dark, saturated, out of focus, or the display stands still.
    HardwareError
        A device failed, or the bench itself found that a picture was late.
    """
    coded = CodedSequence(bench.projector_size, bits)
    references = [picture for picture in coded.references() for _ in range(REPEATS)]
    pictures = [coded.picture(number) for number in range(coded.count)]
    total = len(references) + rounds * len(pictures)
    done = 0

    def photographed(shown: list[Picture]) -> Iterator[Pixels]:
        nonlocal done
        bench.prepare(shown)
        for index in range(len(shown)):
            frame = np.empty(bench.frame_format.shape, bench.frame_format.dtype)
            bench.expose(index, frame)
            done += 1
            progress(done, total)
            yield frame

    frames = list(photographed(references))
    last, before = frames[REPEATS - 1 :: REPEATS], frames[REPEATS - 2 :: REPEATS]
    reader = CodeReader.of_references(
        last, _noise(last, before, bench.frame_format.saturated_dn), bench.frame_format.saturated_dn
    )
    read = [reader.shares(frame) for _ in range(rounds) for frame in photographed(pictures)]
    share, sigma = (np.array(values) for values in zip(*read, strict=True))
    return judge(np.tile(np.arange(coded.count), rounds), share, sigma, coded.count)


def _noise(last: list[Pixels], before: list[Pixels], saturated_dn: int) -> float:
    """Noise of a grey value (DN), from pairs of frames of the same picture, which must not differ by more."""
    off = np.array([np.sqrt(np.mean((a.astype(np.float32) - b) ** 2) / 2) for a, b in zip(last, before, strict=True)])
    noise = max(float(np.median(off)), 0.3)
    unsettled = np.count_nonzero(off > min(3 * noise, _NOISY * saturated_dn))
    if unsettled:
        raise DisplayError(
            f"{unsettled} of {off.size} pictures that were shown {REPEATS} times in a row differ between the last two"
            " times",
            "The display is more than one picture late, or drops some: measure its latency again with `scan latency`,"
            " and keep other light and motion away.",
        )
    return noise


def judge(shown: NDArray[np.int64], share: NDArray[np.float64], sigma: NDArray[np.float64], count: int) -> DisplayCheck:
    """Find out what the display has done.

    Two pictures that share an exposure mix in all bands of rows alike; those of a torn picture are whole in most.

    Parameters
    ----------
    shown
        (n,) numbers of the pictures that were asked for, in the order of time, each round from 0.
    share, sigma
        (n, bands, bits) how far each bit was on, and its standard deviation.
    count
        Pictures that carry a number of their own.
    """
    off = np.minimum(np.abs(share), np.abs(1 - share))
    whole: NDArray[np.bool_] = np.all(off <= np.maximum(_MIXED, _SIGMAS * sigma), axis=2)
    number = number_of(share > 0.5)
    uniform = np.all(number == number[:, :1], axis=1)
    torn = whole.any(axis=1) & ~(whole.all(axis=1) & uniform)
    mixed = np.where(whole.any(axis=1), 0.0, off.max(axis=2).mean(axis=1))
    # Of a torn picture and of a mixed one the picture asked for counts as seen where it was there at all.
    own = np.any((number == shown[:, None]) & whole, axis=1)
    seen = np.where(torn & own, shown, number_of(np.median(share, axis=1) > 0.5))
    findings = [
        *_out_of_time(shown, seen, torn | (mixed > 0), count),
        *_torn(shown, torn),
        *_mixed(shown, mixed),
    ]
    return DisplayCheck(shown, seen, mixed, torn, int(np.median(shown - seen)), tuple(findings))


def _out_of_time(
    shown: NDArray[np.int64], seen: NDArray[np.int64], partly: NDArray[np.bool_], count: int
) -> list[Finding]:
    """Late, standing still, dropped: what whole pictures at the wrong time mean."""
    wrong = (seen != shown) & ~partly
    if not wrong.any():
        return []
    delays = (shown - seen)[wrong]
    usual = int(np.median(delays))
    # The first pictures of a round are late by whatever was shown before it.
    settled = shown >= max(usual, 1)
    if usual > 0 and (wrong & (shown - seen == usual))[settled].mean() > 0.8:
        return [
            Finding(
                "display_late",
                True,
                f"every picture comes on {_times(usual, 'picture')} too late: exposures see what was asked for before",
                "Measure the display's latency again with `scan latency`; it is longer than the bench waits.",
            )
        ]
    first = int(np.argmax(wrong))
    same, exposed_wrong = _longest_run(seen), int(wrong.sum())
    exposures = _times(exposed_wrong, "exposure")
    where = f"first at picture {shown[first]} (exposure {first})"
    if same > 2:
        return [
            Finding(
                "display_stands_still",
                True,
                f"the display stood still for {_times(same, 'exposure')}; {exposures} saw an old picture, {where}",
                "Switch off screen savers, power saving and notifications on the projector's output, and close other"
                " programs that draw.",
            )
        ]
    missing = int(np.setdiff1d(np.arange(count), seen).size)
    # A picture that is dropped is missed by one exposure; more of them mean that pictures came later.
    if exposed_wrong <= 2 * missing:
        return [
            Finding(
                "display_drops",
                True,
                f"the display dropped {_times(missing, 'picture')}: {exposures} saw another one, {where}",
                "Close other programs that use the graphics card, switch compositing and frame interpolation off, or"
                " lengthen the time that each picture stays on.",
            )
        ]
    return [
        Finding(
            "display_late_at_times",
            True,
            f"{exposures} saw a picture too early or too late, {where}",
            "Measure the display's latency again with `scan latency`, and switch variable refresh rate off.",
        )
    ]


def _torn(shown: NDArray[np.int64], torn: NDArray[np.bool_]) -> list[Finding]:
    if not torn.any():
        return []
    return [
        Finding(
            "display_torn",
            True,
            f"{_times(int(torn.sum()), 'exposure')} saw the upper part of one picture and the lower part of another,"
            f" first at picture {shown[int(np.argmax(torn))]}",
            "Switch vertical synchronisation on, and make the exposure a whole multiple of the projector's period.",
        )
    ]


def _mixed(shown: NDArray[np.int64], mixed: NDArray[np.float64]) -> list[Finding]:
    if not (mixed > 0).any():
        return []
    return [
        Finding(
            "display_mixed",
            True,
            f"the light changed during {_times(int((mixed > 0).sum()), 'exposure')}, up to {100 * mixed.max():.0f} % of"
            f" it, first at picture {shown[int(np.argmax(mixed > 0))]}",
            "Wait one refresh longer before the exposure (measure the latency again), and keep other light away.",
        )
    ]


def _longest_run(seen: NDArray[np.int64]) -> int:
    """How many exposures in a row saw the same picture, at most."""
    changes = np.flatnonzero(np.diff(seen, prepend=seen[0] - 1, append=seen[-1] - 1))
    return int(np.diff(changes).max())


def _times(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
