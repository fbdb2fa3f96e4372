"""What a certificate holds, and its files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from calibration.acceptance.evaluation import Evaluation
from calibration.acceptance.figures import COVERAGE_FACTOR, Figure, Limits, Verdict, overall
from drivers.errors import OperatorError
from scanner.rig import Rig

GUIDELINE = "in the manner of VDI/VDE 2634 part 2 (August 2012)"
_FORMAT, _VERSION = "mfs-scanner certificate", 1


class CertificateError(OperatorError):
    """The certificate cannot be written."""


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, eq=False)
class Certificate:
    """All that an acceptance found.

    Parameters
    ----------
    bench
        Name of the bench.
    simulated
        True where no light was involved; everything written is stamped with it.
    evaluations
        Of each artefact at each place (`calibration.acceptance.evaluation.evaluate` and
        `calibration.acceptance.interreflection.evaluate_beside_mirror`).
    limits
        By which the figures are judged; a limit whose quantity no evaluation has is listed as not measured.
    rig
        With which was scanned.
    calibration
        Notes of the solver about it, as in ``rig.metadata["calibration"]``; any of its keys may be missing.
    conditions
        What else belongs to the result, as name → value: method, temperature, operator.
    versions
        Package → version.
    created
        ISO 8601.
    """

    bench: str
    simulated: bool
    evaluations: Sequence[Evaluation]
    limits: Limits = field(default_factory=Limits)
    rig: Rig | None = None
    calibration: Mapping[str, Any] = field(default_factory=dict)
    conditions: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    created: str = field(default_factory=_now)

    @property
    def figures(self) -> list[Figure]:
        """All figures with their limits, and one without a value for each limit that nothing answers to."""
        found = [f.judged_by(self.limits) for e in self.evaluations for f in e.figures]
        answered = {f.quantity for f in found}
        note = "no artefact for this limit was scanned: add one to the bench file's acceptance"
        unanswered = [q for q in self.limits.limited() if q not in answered]
        return found + [Figure(q, "–", None, note=note).judged_by(self.limits) for q in unanswered]

    @property
    def verdict(self) -> Verdict:
        """Verdict of the whole."""
        return overall(self.figures)

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; NaN and infinity become null."""
        document = {
            "format": _FORMAT,
            "version": _VERSION,
            "created": self.created,
            "bench": self.bench,
            "simulated": self.simulated,
            "verdict": str(self.verdict),
            "guideline": GUIDELINE,
            "decision_rule": f"ISO 14253-1 with the guard band U = {COVERAGE_FACTOR:g} u",
            "figures": [f.to_json() for f in self.figures],
            "artefacts": [{"title": e.artefact, **e.description} for e in self.evaluations],
            "conditions": dict(self.conditions),
            "calibration": dict(self.calibration),
            "rig": None if self.rig is None else {**self.rig.to_json(), "metadata": {}},
            "versions": dict(self.versions),
        }
        plain: dict[str, Any] = _plain(document)
        return plain

    def to_html(self) -> str:
        """One self-contained page that loads nothing from anywhere."""
        from calibration.certificate.page import render

        return render(self)

    def write(self, data: Path, page: Path) -> None:
        """Write ``data`` (JSON) and ``page`` (HTML), each appearing when it is complete.

        Raises
        ------
        CertificateError
            The disk is full or refuses a file.
        """
        document = json.dumps(self.to_json(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        for path, text in ((page, self.to_html()), (data, document)):
            draft = path.with_name(f".{path.name}.part")
            try:
                with open(draft, "w", encoding="utf-8") as file:
                    file.write(text)
                    file.flush()
                    os.fsync(file.fileno())
                draft.replace(path)
            except OSError as error:
                draft.unlink(missing_ok=True)
                raise CertificateError(
                    f"cannot write {path}: {error.strerror or error}",
                    "Choose a place that can be written and has room; the scans are kept, verify again.",
                ) from None


def _plain(value: Any) -> Any:
    match value:
        case Mapping():
            return {str(k): _plain(v) for k, v in value.items()}
        case list() | tuple():
            return [_plain(v) for v in value]
        case np.generic() | np.ndarray():
            return _plain(value.tolist())
        case float() if not math.isfinite(value):
            return None
    return value
