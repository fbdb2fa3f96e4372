"""Which exposures a scan has, and how a recording says so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers import Bench, DeviceSettingError, ExposureControl
from scanner.patterns import Plan

_MADE = 0.01
"""How far a camera's exposure may be from what was asked for, as a share."""


@dataclass(frozen=True)
class ExposureSeries:
    """The exposures of a scan, in the order in which they are taken.

    Parameters
    ----------
    reference_s
        The bench's own exposure, s: grey values of fused frames are in its units.
    made_s
        What the camera has made of each, s.
    """

    reference_s: float
    made_s: tuple[float, ...]

    def __len__(self) -> int:
        return len(self.made_s)

    @property
    def relative(self) -> tuple[float, ...]:
        """Each in units of the reference."""
        return tuple(s / self.reference_s for s in self.made_s)

    def label(self, number: int) -> str:
        """Short name of exposure ``number`` (from 0) for messages."""
        return f"exposure {number + 1} of {len(self)} ({1e3 * self.made_s[number]:.4g} ms)"

    def recorded(self, plan: Plan) -> dict[str, Any]:
        """JSON-ready document of all that a round of ``plan`` projects: its sequences once for every exposure."""
        document = plan.to_json()
        return document | {
            "sequences": document["sequences"] * len(self),
            "exposures": {"reference_s": self.reference_s, "made_s": list(self.made_s)},
        }


def read_plan(document: Mapping[str, Any]) -> tuple[Plan, ExposureSeries | None]:
    """Inverse of `ExposureSeries.recorded`, and of `Plan.to_json` for a round of one exposure.

    Returns
    -------
    plan, series
        What every exposure projects; None for a single exposure. Sequence s of exposure k is recorded as number
        k · len(plan.sequences) + s.
    """
    exposures = document.get("exposures")
    if exposures is None:
        return Plan.from_json(document), None
    series = ExposureSeries(exposures["reference_s"], tuple(exposures["made_s"]))
    sequences = document["sequences"][: len(document["sequences"]) // len(series)]
    return Plan.from_json({**document, "sequences": sequences}), series


def agree(bench: Bench, factors: Sequence[float]) -> ExposureSeries | None:
    """Ask the camera for every exposure before anything is projected, and leave it at the bench's own.

    Parameters
    ----------
    bench
        Open.
    factors
        Exposures in units of the bench's own.

    Returns
    -------
    The series; None for one exposure, which needs nothing of the bench.

    Raises
    ------
    DeviceSettingError
        The bench cannot change its exposure, refuses one of these, or makes another of it.
    """
    if len(factors) == 1:
        return None
    if not isinstance(bench, ExposureControl):
        raise DeviceSettingError(
            f"{bench.name}: this bench cannot change its exposure in a scan",
            "Scan with one exposure: leave scan.exposures out.",
        )
    own_s = bench.exposure_s
    for factor in factors:
        bench.check_exposure(own_s * factor)
    made = []
    for factor in factors:
        made.append(bench.set_exposure(own_s * factor))
        if abs(made[-1] / (own_s * factor) - 1) > _MADE:
            bench.set_exposure(own_s)
            raise DeviceSettingError(
                f"{bench.name}: the camera makes {1e6 * made[-1]:.0f} µs of an exposure of {1e6 * own_s * factor:.0f} "
                f"µs (scan.exposures: {factor:g} × {1e6 * own_s:.0f} µs)",
                "Choose scan.exposures within what the camera can do, or another bench.camera.exposure_us.",
            )
    bench.set_exposure(own_s)
    return ExposureSeries(own_s, tuple(made))
