"""Poses that do not fit the rig that the others make."""

from __future__ import annotations

import numpy as np

from calibration.observations import Finding
from calibration.solver.result import Calibration

_DISAGREES = 4.0  # χ²/dof against the median of the others


def disagreeing(calibration: Calibration) -> list[Finding]:
    """Poses that were dropped because of their residuals, and poses that pull."""
    used = [pose for pose in calibration.poses if pose.used]
    dropped = [pose for pose in calibration.poses if not pose.used and not pose.mislabelled]
    told = [f"{pose.name} (left out, residuals {np.sqrt(pose.chi2_per_dof):.1f} times the others')" for pose in dropped]
    chi2 = np.array([pose.chi2_per_dof for pose in used])
    for i, pose in enumerate(used):
        others = float(np.median(np.delete(chi2, i)))
        if chi2[i] > _DISAGREES * max(others, 1.0):
            told.append(
                f"{pose.name} (χ² per degree of freedom {chi2[i]:.1f}, others {others:.1f}; without it the rig moves "
                f"by {pose.influence:.1f} standard uncertainties)"
            )
    if not told:
        return []
    return [
        Finding(
            "poses_disagree",
            False,
            f"{len(told)} of {len(calibration.poses)} poses do not agree with the others: {'; '.join(told)}",
            "The board moved while it was taken, bent, or was misdetected: take these poses again, the board at rest.",
        )
    ]
