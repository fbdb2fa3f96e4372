"""Scale: no set of pictures knows it, only the board does, and a ruler."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.observations import Finding
from calibration.solver.result import Calibration


@dataclass(frozen=True)
class Expectation:
    """What the operator measured with a ruler.

    Parameters
    ----------
    baseline_mm
        From the camera's lens to the projector's.
    distance_mm
        From the camera's lens to the middle of the board in the first pose.
    tolerance
        Relative error of the ruler; entrance pupils lie centimetres inside lenses.
    """

    baseline_mm: float | None = None
    distance_mm: float | None = None
    tolerance: float = 0.1


def wrong_scale(calibration: Calibration, expected: Expectation | None) -> list[Finding]:
    """Compare baseline and first distance with what a ruler says."""
    baseline, _ = calibration.baseline
    first = next(pose for pose in calibration.poses if pose.used)
    distance = float(np.linalg.norm(first.translation))
    pairs = [
        (found, told, name)
        for found, told, name in (
            (baseline, expected.baseline_mm if expected else None, "baseline"),
            (distance, expected.distance_mm if expected else None, f"distance of the board in {first.name}"),
        )
        if told is not None
    ]
    if expected is None or not pairs:
        return [
            Finding(
                "scale_not_checked",
                False,
                f"the scale rests on the board's stated size alone: baseline {baseline:.1f} mm, distance of the board "
                f"in {first.name} {distance:.0f} mm",
                "Compare one of them with a ruler; ten squares of the print measured with a caliper are better still.",
            )
        ]
    wrong = [(found, told, name) for found, told, name in pairs if abs(found / told - 1) > expected.tolerance]
    if not wrong:
        return []
    told_as = "; ".join(f"{name} {found:.1f} mm, measured {told:.1f} mm" for found, told, name in wrong)
    ratio = float(np.median([told / found for found, told, _ in wrong]))
    return [
        Finding(
            "wrong_scale",
            True,
            f"lengths are wrong by a factor {ratio:.3g}: {told_as}",
            f"Measure the board: its squares are probably {ratio:.3g} times as large as its definition says (print "
            "without “fit to page”, or correct the definition).",
        )
    ]
