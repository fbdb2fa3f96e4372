"""What is wrong with a calibration, why, and what the operator does about it."""

from __future__ import annotations

from calibration.diagnosis.board import wrong_board
from calibration.diagnosis.certainty import uncertain
from calibration.diagnosis.expectation import Expectation, wrong_scale
from calibration.diagnosis.fringes import Fringes, follow_fringes
from calibration.diagnosis.poses import ill_posed
from calibration.diagnosis.residuals import disagreeing
from calibration.observations import Finding
from calibration.solver.result import Calibration

__all__ = ["Expectation", "Fringes", "diagnosed"]


def diagnosed(calibration: Calibration, expected: Expectation | None, fringes: Fringes | None) -> list[Finding]:
    """All findings, those that refuse first.

    Parameters
    ----------
    calibration
        Of `calibration.bundle.calibrate_rig`.
    expected
        What a ruler says; None leaves a note that the scale was not checked.
    fringes
        What was projected; None leaves residuals unexamined for fringes.
    """
    findings = [
        *ill_posed(calibration),
        *uncertain(calibration),
        *wrong_board(calibration),
        *wrong_scale(calibration, expected),
        *disagreeing(calibration),
        *(follow_fringes(calibration, fringes) if fringes is not None else ()),
    ]
    return sorted(findings, key=lambda finding: not finding.refuses)
