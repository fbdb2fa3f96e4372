"""No rig can be estimated from what was observed."""

from __future__ import annotations

from collections.abc import Sequence

from calibration.observations import Finding
from drivers.errors import OperatorError


class CalibrationError(OperatorError):
    """The observations do not make a calibration; ``findings`` say why, the message and remedy repeat the first."""

    exit_code = 4

    def __init__(self, findings: Sequence[Finding]) -> None:
        first = next((finding for finding in findings if finding.refuses), findings[0])
        super().__init__(f"no calibration: {first.what}", first.remedy)
        self.findings = tuple(findings)
