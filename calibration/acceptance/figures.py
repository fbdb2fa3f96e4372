"""Quality figures, their limits, and the decision between pass and fail in the presence of uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

COVERAGE_FACTOR = 2.0
"""k of the stated expanded uncertainty U = k·u, which is also the guard band of the decision."""

_Limit = Annotated[float | None, Field(gt=0)]


class Quantity(StrEnum):
    """What a figure tells; the value is its name in files."""

    PROBING_FORM = "probing_form"
    PROBING_SIZE = "probing_size"
    SPHERE_SPACING = "sphere_spacing"
    FLATNESS = "flatness"
    REPEATABILITY = "repeatability"
    REPEATABILITY_LENGTH = "repeatability_length"
    BOUNCE_STD_ROUND_ONE = "interreflection_std_round_one"
    BOUNCE_RANGE_ROUND_ONE = "interreflection_range_round_one"
    BOUNCE_STD = "interreflection_std"
    BOUNCE_RANGE = "interreflection_range"
    BOUNCE_STD_REMOVED = "interreflection_std_without_mirror"
    BOUNCE_RANGE_REMOVED = "interreflection_range_without_mirror"

    @property
    def label(self) -> str:
        """Name for people, with the symbol of the guideline where it has one."""
        return _TITLES[self]


_TITLES = {
    Quantity.PROBING_FORM: "Probing error, form PF",
    Quantity.PROBING_SIZE: "Probing error, size PS",
    Quantity.SPHERE_SPACING: "Sphere spacing error SD",
    Quantity.FLATNESS: "Flatness error F",
    Quantity.REPEATABILITY: "Repeatability of a point",
    Quantity.REPEATABILITY_LENGTH: "Repeatability of the measured length",
    Quantity.BOUNCE_STD_ROUND_ONE: "Inter-reflection, std, round one alone",
    Quantity.BOUNCE_RANGE_ROUND_ONE: "Inter-reflection, range, round one alone",
    Quantity.BOUNCE_STD: "Inter-reflection, std, both rounds",
    Quantity.BOUNCE_RANGE: "Inter-reflection, range, both rounds",
    Quantity.BOUNCE_STD_REMOVED: "Same place, std, mirror removed",
    Quantity.BOUNCE_RANGE_REMOVED: "Same place, range, mirror removed",
}


class Limits(BaseModel):
    """Largest permitted magnitude of each figure, mm; null only reports it."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    probing_form_mm: _Limit = Field(None, description="Probing error form PF on a sphere, mm.")
    probing_size_mm: _Limit = Field(None, description="Probing error size PS on a sphere, either sign, mm.")
    sphere_spacing_mm: _Limit = Field(None, description="Sphere spacing error SD on a ball bar, either sign, mm.")
    flatness_mm: _Limit = Field(None, description="Flatness error F on a plane, mm.")
    repeatability_mm: _Limit = Field(None, description="Standard deviation of a point over repeated scans, mm.")
    repeatability_length_mm: _Limit = Field(
        None, description="Standard deviation of a diameter or a spacing over repeated scans, mm."
    )
    interreflection_std_mm: _Limit = Field(
        None, description="Standard deviation of the points in the bounce region beside a mirror, after round two, mm."
    )
    interreflection_range_mm: _Limit = Field(None, description="Range of the same points, mm.")

    def of(self, quantity: Quantity) -> float | None:
        """Limit of a quantity, mm; None where it is only reported."""
        limit: float | None = getattr(self, f"{quantity}_mm", None)
        return limit

    def limited(self) -> list[Quantity]:
        """Quantities that have a limit."""
        return [q for q in Quantity if self.of(q) is not None]


class Verdict(StrEnum):
    """Outcome of one figure, or of a whole certificate."""

    PASS = "pass"
    FAIL = "fail"
    UNCERTAIN = "within the uncertainty zone"
    """The figure is so close to its limit that its uncertainty reaches over it: neither can be stated."""
    REPORTED = "reported, no limit"
    MISSING = "not measured"


def decide(value_mm: float, u_mm: float, limit_mm: float) -> Verdict:
    """Decide as ISO 14253-1 does: conformity only where |value| + U stays within the limit.

    The guard band is U = 2 u, as in the standard's first edition; its 2017 edition takes 1.65 u unless agreed
    otherwise, so a pass here is one there.

    Parameters
    ----------
    value_mm
        The figure, either sign.
    u_mm
        Its standard uncertainty.
    limit_mm
        Largest permitted magnitude.
    """
    guard = COVERAGE_FACTOR * u_mm
    if abs(value_mm) + guard <= limit_mm:
        return Verdict.PASS
    return Verdict.FAIL if abs(value_mm) - guard > limit_mm else Verdict.UNCERTAIN


@dataclass(frozen=True)
class Figure:
    """One quality figure, measured or with the reason why not.

    Parameters
    ----------
    quantity, artefact
        What of which artefact.
    value_mm
        None where it could not be measured.
    u_mm
        Standard uncertainty: root of the sum of squares of ``budget``.
    budget
        Standard uncertainties by cause, mm.
    points, rejected
        Points that went in, and how many of them were left out by the guideline's rule.
    noise_mm, noise_std_mm
        What the predicted noise of the points alone would give for this figure, and how far that would scatter; None
        where noise does not add to the figure on average.
    note
        Circumstances a reader must know, or the reason why it is missing.
    limit_mm
        Largest permitted magnitude; None only reports.
    """

    quantity: Quantity
    artefact: str
    value_mm: float | None
    budget: Mapping[str, float] = field(default_factory=dict)
    points: int = 0
    rejected: int = 0
    noise_mm: float | None = None
    noise_std_mm: float | None = None
    note: str = ""
    limit_mm: float | None = None

    @property
    def u_mm(self) -> float:
        """Standard uncertainty, mm."""
        return math.hypot(*self.budget.values())

    @property
    def expanded_mm(self) -> float:
        """U = k·u, mm."""
        return COVERAGE_FACTOR * self.u_mm

    @property
    def verdict(self) -> Verdict:
        """Decision against the limit."""
        if self.value_mm is None:
            return Verdict.MISSING
        if self.limit_mm is None:
            return Verdict.REPORTED
        return decide(self.value_mm, self.u_mm, self.limit_mm)

    def judged_by(self, limits: Limits) -> Figure:
        """Return the same figure with its limit."""
        return replace(self, limit_mm=limits.of(self.quantity))

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document."""
        return {
            "quantity": str(self.quantity),
            "artefact": self.artefact,
            "value_mm": self.value_mm,
            "standard_uncertainty_mm": None if self.value_mm is None else self.u_mm,
            "expanded_uncertainty_mm": None if self.value_mm is None else self.expanded_mm,
            "coverage_factor": COVERAGE_FACTOR,
            "uncertainty_budget_mm": dict(self.budget),
            "limit_mm": self.limit_mm,
            "verdict": str(self.verdict),
            "points": self.points,
            "rejected": self.rejected,
            "expected_from_noise_mm": self.noise_mm,
            "expected_from_noise_std_mm": self.noise_std_mm,
            "note": self.note,
        }


def overall(figures: list[Figure]) -> Verdict:
    """Verdict of all figures: fail before missing or uncertain before pass; a figure without limit decides nothing.

    A figure that has a limit and was not measured keeps the whole from passing.
    """
    limited = [f.verdict for f in figures if f.limit_mm is not None]
    for worst in (Verdict.FAIL, Verdict.MISSING, Verdict.UNCERTAIN):
        if worst in limited:
            return worst
    return Verdict.PASS if limited else Verdict.REPORTED
