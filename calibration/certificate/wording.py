"""How the certificate writes figures: as many digits as their uncertainty bears, and the marks of verdicts."""

from __future__ import annotations

import math

from calibration.acceptance.figures import Verdict
from scanner.report.wording import number

MARKS = {
    Verdict.PASS: "✓",
    Verdict.FAIL: "✗",
    Verdict.UNCERTAIN: "≈",
    Verdict.REPORTED: "○",
    Verdict.MISSING: "∅",
}
KINDS = {
    Verdict.PASS: "passed",
    Verdict.FAIL: "failed",
    Verdict.UNCERTAIN: "uncertain",
    Verdict.REPORTED: "none",
    Verdict.MISSING: "missing",
}
"""Classes of the style sheet."""

_MOST_DECIMALS = 7


def _decimals(u: float) -> int:
    """Decimals that give two figures of an uncertainty (GUM, 7.2.6)."""
    return min(max(1 - math.floor(math.log10(u)), 0), _MOST_DECIMALS)


def amount(value: float | None, u: float | None) -> str:
    """Write a value to the last digit that its uncertainty ``u`` bears; to four figures where that is 0 or unknown."""
    if value is None or not math.isfinite(value):
        return "–"
    if not u or not math.isfinite(u):
        return number(float(value))
    return f"{value:.{_decimals(u)}f}".replace("-", "−")


def expanded(u: float) -> str:
    """Write an uncertainty with two figures; a dash where nothing is known of it."""
    return f"{u:.{_decimals(u)}f}" if u > 0 and math.isfinite(u) else "–"


def deviation(mm: float | None) -> str:
    """Write a deviation for a tile, in the unit that suits it."""
    if mm is None or not math.isfinite(mm):
        return "–"
    text = f"{1000 * mm:.3g} µm" if abs(mm) < 0.9995 else f"{mm:.3g} mm"
    return text.replace("-", "−")
