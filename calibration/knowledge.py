"""How well a rig is known so far, against what a good calibration reaches."""

from __future__ import annotations

from collections.abc import Iterable

from calibration.guide.guidance import Bar
from calibration.planning import GOOD_BASELINE, GOOD_CENTRE_PX, GOOD_FOCAL
from calibration.solver.result import Calibration


def known(calibration: Calibration) -> tuple[Bar, ...]:
    """Standard uncertainties of focal lengths, principal points and baseline as bars, full where they will do.

    Of the two axes of a lens the worse one counts.

    Parameters
    ----------
    calibration
        Of the poses so far.
    """
    bars = []
    for lens in ("camera", "projector"):
        focal = _worst(sigma / value for value, sigma in _values(calibration, f"{lens}.fx", f"{lens}.fy"))
        centre = _worst(sigma for _, sigma in _values(calibration, f"{lens}.cx", f"{lens}.cy"))
        if focal is not None:
            bars.append(_bar(f"{lens}: focal length", 100 * focal, 100 * GOOD_FOCAL, "%"))
        if centre is not None:
            bars.append(_bar(f"{lens}: principal point", centre, GOOD_CENTRE_PX, "px"))
    length, sigma = calibration.baseline
    bars.append(_bar("baseline", sigma, GOOD_BASELINE * length, "mm"))
    return tuple(bars)


def _values(calibration: Calibration, *names: str) -> Iterable[tuple[float, float]]:
    return [calibration.value(name) for name in names if name in calibration.names]


def _worst(sigmas: Iterable[float]) -> float | None:
    return max(sigmas, default=None)


def _bar(label: str, sigma: float, wanted: float, unit: str) -> Bar:
    return Bar(label, wanted / sigma, sigma <= wanted, f"± {sigma:.2g} {unit}, wanted {wanted:.2g}")
