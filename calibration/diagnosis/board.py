"""A board whose squares are not square: the print was stretched, or the definition is another board's."""

from __future__ import annotations

import math

from calibration.observations import Finding
from calibration.solver.adjustment import adjusted
from calibration.solver.parameters import ASPECT
from calibration.solver.result import Calibration

_LEAST_ASPECT = 2e-3
_SIGNIFICANT = 6.0


def wrong_board(calibration: Calibration) -> list[Finding]:
    """Estimate the board's height per width along with everything else, and judge it by its uncertainty.

    Boards that are only turned little about their own normal leave a stretched board to the focal lengths: fx/fy far
    from 1 tells it then.
    """
    names = ("board.aspect",)
    free = calibration.model.freedom(calibration.terms, *names)
    fit = adjusted(calibration.adjusted.state, calibration.data, free)
    aspect = float(fit.state.values[ASPECT])
    sigma = math.sqrt(fit.covariance[-1, -1])
    fx, fy = calibration.rig.camera.matrix[0, 0], calibration.rig.camera.matrix[1, 1]
    told = []
    if abs(aspect) > max(_LEAST_ASPECT, _SIGNIFICANT * sigma):
        percent = f"{100 * (1 + aspect):.2f} ± {196 * sigma:.2f} %"
        told.append(f"heights on the board are {percent} of what its widths let expect")
    if abs(fx / fy - 1) > 0.02:
        told.append(f"the camera's focal lengths are {fx:.0f} and {fy:.0f} px, where pixels are square")
    if not told:
        return []
    return [
        Finding(
            "wrong_board",
            True,
            "the board is not the one that was named: " + "; ".join(told),
            "Measure ten squares of the print along both sides; correct the definition, or print again to true scale.",
        )
    ]
