"""The steps that a few frames had, estimated from the frames alone, for a sequence of which nothing else is known.

Principal components give a start, alternating least squares the answer (Wang & Han, Opt. Lett. 29, 1671 (2004)). A
stale, repeated or swapped frame stands out by a whole step, whatever noise and the projector's gamma are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.findings import Finding

_ITERATIONS = 8
_SAMPLES = 6_000
_CONVINCING = 1.5
"""The found step must explain a frame by so much better than the planned one (ratio of mean squares): where the phases
of all pixels lie close together, the steps can hardly be told, and many explain the frames equally well."""


def wrong_steps(values: NDArray[np.float32], steps_rad: NDArray[np.float64]) -> list[Finding]:
    """Frames of (N, P) grey values, N > 3, that had another step than the planned (N,) ``steps_rad``."""
    varied = np.argsort(values.std(axis=0))[::-1][:_SAMPLES]
    found = _estimate_steps(values[:, varied].astype(np.float64), steps_rad)
    if found is None:
        return []
    steps, gain, better, _ = found
    count = len(steps_rad)
    off = np.angle(np.exp(1j * (steps - steps_rad)))
    # A wrong frame is wrong by a whole step; half of one leaves the widest margin to noise and to miscalibrated steps.
    tolerance = 0.5 * np.min(np.abs(np.angle(np.exp(1j * np.diff(steps_rad)))))
    findings = []
    for n in np.flatnonzero((np.abs(off) > tolerance) & (gain > 0.2) & (better > _CONVINCING)):
        nearest = int(np.argmin(np.abs(np.angle(np.exp(1j * (steps_rad - steps[n]))))))
        what = f"frame {n + 1} shows step {nearest + 1} of {count} (off by {np.degrees(off[n]):+.0f}°)"
        findings.append(Finding(int(n), f"{what}: a stale, repeated, missing or swapped frame"))
    return findings


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
