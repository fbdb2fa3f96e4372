"""Did these frames show these patterns? Checks that need no extra pattern, from the redundancy of the phase steps.

N > 3 steps of one frequency determine more than mean, modulation and phase. The steps that the frames really had are
estimated from the frames alone (principal components give a start, alternating least squares the answer; Wang & Han,
Opt. Lett. 29, 1671 (2004)) and compared with the plan: a frame that is stale, repeated, missing or swapped stands out
by at least a whole step, whatever the camera's noise and the projector's gamma are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xxhash
from numpy.typing import NDArray

from drivers import Pixels
from scanner.patterns import FringeSequence

_SAMPLES = 6_000
_ITERATIONS = 8

_CONVINCING = 1.5
"""The found step must explain a frame by so much better than the planned one (ratio of mean squares): where the phases
of all pixels lie close together, the steps can hardly be told, and many explain the frames equally well."""


@dataclass(frozen=True)
class Finding:
    """Something wrong with one sequence: ``frame`` counts from 0 within it, -1 for the sequence as a whole."""

    frame: int
    message: str


@dataclass(frozen=True)
class SequenceCheck:
    """The verdict on one sequence.

    Parameters
    ----------
    findings
        What is wrong; empty for a good sequence.
    steps_rad
        (N,) steps that the frames had, rad, turned to agree with the plan best; NaN where they cannot be told.
    usable
        Share of the sampled pixels with fringes on them.
    """

    findings: tuple[Finding, ...]
    steps_rad: NDArray[np.float64]
    usable: float

    @property
    def good(self) -> bool:
        """True where nothing is wrong."""
        return not self.findings


def repeated_frames(frames: Sequence[Pixels] | Pixels) -> list[tuple[int, int]]:
    """Pairs (earlier, later) of frames that are equal to the last bit, which noise does not allow for two exposures.

    Frames without any variation (all black, all saturated) are no evidence and are left out.
    """
    seen: dict[int, int] = {}
    pairs = []
    for i, frame in enumerate(frames):
        if frame.min() == frame.max():
            continue
        digest = xxhash.xxh3_64_intdigest(np.ascontiguousarray(frame).data)
        if digest in seen:
            pairs.append((seen[digest], i))
        else:
            seen[digest] = i
    return pairs


def check_sequence(frames: Pixels, fringes: FringeSequence, saturated_dn: int) -> SequenceCheck:
    """Compare the steps that (N, H, W) ``frames`` had with the steps that ``fringes`` asks for.

    Three steps have no redundancy: there only repeated frames are found. A sequence of several frequencies likewise.

    Parameters
    ----------
    frames
        (N, H, W) grey values.
    fringes
        The plan of the sequence.
    saturated_dn
        Grey value from which a pixel is left out.
    """
    count = len(fringes.fringes)
    findings = [
        Finding(j, f"frame {j + 1} is frame {i + 1} over again, to the last bit") for i, j in repeated_frames(frames)
    ]
    unknown = np.full(count, np.nan)
    if count <= 3 or fringes.frequency is None:
        return SequenceCheck(tuple(findings), unknown, float("nan"))
    sample = _sample(frames, saturated_dn)
    if sample.shape[1] < 50:
        return SequenceCheck(tuple(findings), unknown, 0.0)
    found = _estimate_steps(sample, fringes.steps_rad)
    if found is None:
        return SequenceCheck(tuple(findings), unknown, 0.0)
    steps, gain, better, usable = found
    off = np.angle(np.exp(1j * (steps - fringes.steps_rad)))
    # A wrong frame is wrong by a whole step; half of one leaves the widest margin to noise and to miscalibrated steps.
    tolerance = 0.5 * np.min(np.abs(np.angle(np.exp(1j * np.diff(fringes.steps_rad)))))
    already = {f.frame for f in findings}
    for n in np.flatnonzero((np.abs(off) > tolerance) & (gain > 0.2) & (better > _CONVINCING)):
        if int(n) not in already:
            nearest = int(np.argmin(np.abs(np.angle(np.exp(1j * (fringes.steps_rad - steps[n]))))))
            findings.append(
                Finding(
                    int(n),
                    f"frame {n + 1} shows step {nearest + 1} of {count} (off by {np.degrees(off[n]):+.0f}°): "
                    "a stale, repeated, missing or swapped frame",
                )
            )
    for n in np.flatnonzero((np.abs(gain - 1) > 0.3) & (better > _CONVINCING)):
        if not any(f.frame == n for f in findings):
            findings.append(
                Finding(
                    int(n),
                    f"frame {n + 1} has {100 * gain[n]:.0f} % of the contrast of the others: torn, mixed or blank",
                )
            )
    return SequenceCheck(tuple(sorted(findings, key=lambda f: f.frame)), steps, usable)


def _sample(frames: Pixels, saturated_dn: int) -> NDArray[np.float64]:
    """(N, P) grey values of up to `_SAMPLES` evenly spread pixels without a saturated frame."""
    flat = frames.reshape(frames.shape[0], -1)
    thinned = flat[:, :: max(1, flat.shape[1] // (4 * _SAMPLES))]
    values = thinned[:, (thinned < saturated_dn).all(axis=0)].astype(np.float64)
    # Those with the most variation carry the fringes.
    order = np.argsort(values.std(axis=0))[::-1][:_SAMPLES]
    return np.asarray(values[:, np.sort(order)])


def _estimate_steps(
    sample: NDArray[np.float64], planned: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float] | None:
    """Find the steps (rad) and the relative contrast of each frame, and how much better these explain it than the plan.

    The last value is the share of the sampled pixels that was used. None: there are no fringes.
    """
    centred = sample - sample.mean(axis=0)
    values, vectors = np.linalg.eigh(centred @ centred.T)
    # Two components carry the fringes, a few more their harmonics; without them there is nothing to check (lens cap).
    if values[-2] < 4 * max(float(np.median(values[1:-2])), 1e-12):
        return None
    steps = np.arctan2(vectors[:, -2] * np.sqrt(values[-2]), vectors[:, -1] * np.sqrt(values[-1]))
    gain = np.ones_like(steps)
    for _ in range(_ITERATIONS):
        model = np.stack([np.ones_like(steps), gain * np.cos(steps), -gain * np.sin(steps)], axis=1)
        mean, re, im = np.linalg.lstsq(model, sample, rcond=None)[0]
        strong = np.hypot(re, im) > 0.3 * np.median(np.hypot(re, im))
        parts = np.stack([np.ones(strong.sum()), re[strong], -im[strong]], axis=1)
        found = np.linalg.lstsq(parts, (sample - mean)[:, strong].T, rcond=None)[0]
        steps = np.arctan2(found[2], found[1])
        gain = np.hypot(found[1], found[2])
        gain /= np.median(gain)
    # The start and the sense of the steps are free: take those that agree with the plan for the most frames.
    best, agree = steps, -1
    for sense in (1, -1):
        for n in range(len(planned)):
            turned = np.angle(np.exp(1j * (sense * (steps - steps[n]) + planned[n])))
            off = np.abs(np.angle(np.exp(1j * (turned - planned))))
            hits = int((off < np.pi / len(planned)).sum())
            if hits > agree:
                best, agree = turned, hits
    close = np.abs(np.angle(np.exp(1j * (best - planned)))) < np.pi / len(planned)
    best = best - np.angle(np.mean(np.exp(1j * (best - planned))[close]))
    left = _unexplained(sample[:, strong], gain, steps)
    left_by_plan = _unexplained(sample[:, strong], np.ones_like(planned), planned)
    # A frame of another brightness is explained by neither: it stands out from the others instead.
    better = np.maximum(left_by_plan / np.maximum(left, 1e-12), left_by_plan / (3 * np.median(left_by_plan) + 1e-12))
    return best, gain, better, float(strong.mean())


def _unexplained(
    sample: NDArray[np.float64], gain: NDArray[np.float64], steps: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) mean square of each frame that a fringe with these contrasts and steps does not explain."""
    model = np.stack([np.ones_like(steps), gain * np.cos(steps), -gain * np.sin(steps)], axis=1)
    off = sample - model @ np.linalg.lstsq(model, sample, rcond=None)[0]
    return np.asarray((off**2).mean(axis=1))
