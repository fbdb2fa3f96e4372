"""A calibration: the rig, how surely every parameter is known, and what is left over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Finding
from calibration.solver.adjustment import Adjusted
from calibration.solver.measurements import Measurements
from calibration.solver.model import Model
from calibration.solver.parameters import Freedom
from calibration.solver.selection import Terms, Trial
from scanner.rig import Rig

Array = NDArray[np.float64]

COVERAGE_95 = 1.959964
"""Half-width of a 95 % interval of a Gaussian, in standard uncertainties (GUM, 6.3)."""


@dataclass(frozen=True, eq=False)
class PoseResult:
    """One pose of the board after the adjustment.

    Parameters
    ----------
    name, ids
        As observed.
    rotation, translation
        (3, 3), (3,) mm: X_cam = R X_board + t.
    camera, projector
        (n, 2) residuals measured − predicted, px, the projector's at the places where the camera found the points; NaN
        where nothing was measured or the point was left out.
    camera_sigmas, projector_sigmas
        (n, 2) the same in units of the scaled σ.
    projector_px
        (n, 2) measured projector coordinates, px.
    chi2_per_dof
        Of all residuals of the pose, 1 where it fits as the others do.
    influence
        By how many standard uncertainties (root mean square over the parameters) the rig would move without this pose.
    used
        False for a pose that was dropped; its residuals are those against the rig of the others.
    mislabelled
        It was dropped because its points do not lie on one board.
    """

    name: str
    ids: NDArray[np.int64]
    rotation: Array
    translation: Array
    camera: Array
    projector: Array
    camera_sigmas: Array
    projector_sigmas: Array
    projector_px: Array
    chi2_per_dof: float
    influence: float
    used: bool
    mislabelled: bool


@dataclass(frozen=True, eq=False)
class Calibration:
    """What `calibrate_rig` found.

    Parameters
    ----------
    rig
        With `metadata` "calibration": all figures of this class that a file can hold.
    names
        (q,) of the estimated parameters, as `calibration.solver.parameters.NAMES`.
    values
        (q,).
    covariance
        (q, q), with σ scaled to what the residuals show where that is more than was stated.
    poses
        All poses, dropped ones too.
    terms
        Distortion terms.
    table
        How they were chosen; empty where they were given.
    scale_camera, scale_projector
        Observed over stated σ of camera and projector (variance components); below 1 where σ was stated too large.
    rms_camera, rms_projector, rms_stereo
        Reprojection errors, px: √mean(dx² + dy²), as OpenCV states them: the projector's hold what the camera's errors
        do to them. Stereo is over the points of both.
    expected_camera, expected_projector, expected_stereo
        What the stated σ predict for them, px.
    findings
        What is wrong, or worth to be known.
    adjusted, freedom, data, model
        The adjustment itself, for diagnosis and planning.
    """

    rig: Rig
    names: tuple[str, ...]
    values: Array
    covariance: Array
    poses: tuple[PoseResult, ...]
    terms: Terms
    table: tuple[Trial, ...]
    scale_camera: float
    scale_projector: float
    rms_camera: float
    rms_projector: float
    rms_stereo: float
    expected_camera: float
    expected_projector: float
    expected_stereo: float
    findings: tuple[Finding, ...]
    adjusted: Adjusted
    freedom: Freedom
    data: Measurements
    model: Model

    @property
    def usable(self) -> bool:
        """Whether no finding refuses the rig."""
        return not any(finding.refuses for finding in self.findings)

    @property
    def dropped(self) -> tuple[str, ...]:
        """Names of the poses that were dropped."""
        return tuple(pose.name for pose in self.poses if not pose.used)

    @property
    def standard_uncertainty(self) -> Array:
        """(q,) of the parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def correlation(self) -> Array:
        """(q, q) of the parameters."""
        sigma = self.standard_uncertainty
        return np.asarray(self.covariance / sigma[:, None] / sigma)

    @property
    def baseline(self) -> tuple[float, float]:
        """Distance of the projector's centre from the camera's, and its standard uncertainty, mm."""
        T = self.rig.translation
        length = float(np.linalg.norm(T))
        slope = np.zeros(len(self.names))
        for name, part in zip(("translation.x", "translation.y", "translation.z"), T / length, strict=True):
            if name in self.names:
                slope[self.names.index(name)] = part
        return length, float(np.sqrt(slope @ self.covariance @ slope))

    def value(self, name: str) -> tuple[float, float]:
        """A parameter and its standard uncertainty."""
        i = self.names.index(name)
        return float(self.values[i]), float(np.sqrt(self.covariance[i, i]))

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter, or of ``baseline`` (mm)."""
        value, sigma = self.baseline if name == "baseline" else self.value(name)
        return value - COVERAGE_95 * sigma, value + COVERAGE_95 * sigma


def notes(
    names: tuple[str, ...],
    values: Array,
    covariance: Array,
    terms: Terms,
    figures: Mapping[str, float],
    poses: tuple[PoseResult, ...],
    findings: tuple[Finding, ...],
    validity: Mapping[str, Any],
) -> dict[str, Any]:
    """JSON-ready notes on a calibration, for `Rig.metadata`.

    ``validity`` is passed through: board, date, temperature, focus, whatever the rig's truth depends on.
    """
    sigma = np.sqrt(np.diag(covariance))
    return {
        "parameters": list(names),
        "values": values.tolist(),
        "standard_uncertainty": sigma.tolist(),
        "interval_95": np.column_stack([values - COVERAGE_95 * sigma, values + COVERAGE_95 * sigma]).tolist(),
        "covariance": covariance.tolist(),
        "correlation": (covariance / sigma[:, None] / sigma).tolist(),
        "terms": {"camera": list(terms.camera), "projector": list(terms.projector)},
        **{name: float(value) for name, value in figures.items()},
        "poses": [pose.name for pose in poses if pose.used],
        "poses_dropped": [pose.name for pose in poses if not pose.used],
        "findings": [{"code": f.code, "refuses": f.refuses, "what": f.what, "remedy": f.remedy} for f in findings],
        **validity,
    }
