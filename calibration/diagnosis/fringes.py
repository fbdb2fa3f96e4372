"""Residuals that follow the fringes: not geometry, but light."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.observations import Finding
from calibration.solver.result import Calibration

_FALSE_ALARM = 1e-5  # per axis, all harmonics together
_LEAST_OF_SIGMA = 0.2  # smaller ripples are real perhaps, but harm nothing


@dataclass(frozen=True)
class Fringes:
    """Frequencies of the finest fringes, 1/px, and the number of phase steps; None for an axis without fringes."""

    x: float | None = None
    y: float | None = None
    steps: int | None = None

    def harmonics(self) -> tuple[int, ...]:
        """Multiples of the fringe frequency at which errors of phase appear.

        Gamma makes harmonics of the picture; harmonic N ± 1 of N steps ripples the phase N times per fringe (Zhang &
        Yau, Appl. Opt. 46, 36 (2007)); a stale or dim frame ripples it once or twice.
        """
        steps = self.steps
        extra = set() if steps is None else {steps - 1, steps, steps + 1}
        return tuple(sorted({1, 2, 3, 4} | {k for k in extra if k >= 1}))


def follow_fringes(calibration: Calibration, fringes: Fringes) -> list[Finding]:
    """Fit sin and cos of k·2πf·u to the projector's residuals and test them against the rest (χ² test)."""
    found = []
    for axis, frequency in enumerate((fringes.x, fringes.y)):
        used = [pose for pose in calibration.poses if pose.used]
        residual = np.concatenate([pose.projector[:, axis] for pose in used])
        place = np.concatenate([pose.projector_px[:, axis] for pose in used])
        known = np.isfinite(residual) & np.isfinite(place)
        harmonics = fringes.harmonics()
        if frequency is None or np.count_nonzero(known) < 10 * len(harmonics):
            continue
        residual, place = residual[known], place[known]
        spread = 1.4826 * float(np.median(np.abs(residual - np.median(residual))))
        inside = np.abs(residual - np.median(residual)) < 4 * spread
        angle = 2 * math.pi * frequency * place[inside, None] * np.array(harmonics)
        design = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])
        fitted, *_ = np.linalg.lstsq(design, residual[inside], rcond=None)
        rest = residual[inside] - design @ fitted
        variance = float(rest @ rest) / max(len(rest) - design.shape[1], 1)
        explained = float(np.sum((residual[inside] - residual[inside].mean()) ** 2) - rest @ rest)
        amplitude = np.hypot(fitted[: len(harmonics)], fitted[len(harmonics) : -1])
        significant = chi2.sf(explained / variance, 2 * len(harmonics)) < _FALSE_ALARM
        if significant and amplitude.max() > _LEAST_OF_SIGMA * math.sqrt(variance):
            k = int(np.argmax(amplitude))
            found.append(("xy"[axis], harmonics[k], float(amplitude[k]), math.sqrt(variance)))
    if not found:
        return []
    told = "; ".join(
        f"along {axis} {harmonic}× per fringe with {amplitude:.3f} px (other residuals {rest:.3f} px)"
        for axis, harmonic, amplitude, rest in found
    )
    return [
        Finding(
            "fringe_residuals",
            False,
            f"the projector's residuals follow the fringes: {told}",
            "Measure and correct the projector's response (a gamma of its own, or a saturated camera, does this); if "
            "it is corrected, look for stale frames: calibrate the display latency.",
        )
    ]
