"""What `scan doctor` reports, line by line; benches and packages give it through the group ``scanner.examinations``."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """How a finding is to be taken."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    """A scan can start; something is not as it should be."""
    FAULT = "fault"
    """A scan that needs this cannot start."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Parameters
    ----------
    topic
        What it belongs to: ``cameras``, ``displays``, ``serial ports``, ``USB projectors``, ``disk``, ``memory`` …
    item
        Which one, such as a serial number or a path.
    verdict
        How it is to be taken.
    text
        What was found.
    remedy
        What to do about it; empty where nothing is to be done. May hold several lines to paste.
    """

    topic: str
    item: str
    verdict: Verdict
    text: str
    remedy: str = ""
