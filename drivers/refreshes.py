"""Exposures and the refreshes of a projector, which makes grey levels by switching within each."""

from __future__ import annotations

_WHOLE = 0.01
"""How far an exposure may be from a whole number of refreshes, as a share of one: cameras round to their lines."""


def whole_refreshes(exposure_s: float, refresh_s: float) -> int | None:
    """Refreshes that an exposure lasts; None where that is no whole number of them, or none at all.

    Parameters
    ----------
    exposure_s, refresh_s
        Exposure of the camera and time from one refresh to the next, s.
    """
    refreshes = exposure_s / refresh_s
    whole = max(round(refreshes), 1)
    return whole if abs(refreshes - whole) <= _WHOLE else None
