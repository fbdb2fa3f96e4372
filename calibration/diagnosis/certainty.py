"""Parameters that the poses leave open, whatever the residuals look like."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.observations import Finding
from calibration.planning.coverage import common_view
from calibration.solver.parameters import DISTORTION
from calibration.solver.result import Calibration

Array = NDArray[np.float64]

_FOCAL_REFUSED, _FOCAL_FLAGGED = 0.01, 0.004
_DISTORTION_PX = 1.0
_NOISE_RATIO = 1.5


def uncertain(calibration: Calibration) -> list[Finding]:
    """Findings about focal lengths, distortion, axes and noise."""
    return [*_focal(calibration), *_distortion(calibration), *_axes(calibration), *_noise(calibration)]


def _focal(calibration: Calibration) -> list[Finding]:
    relative = {}
    for name in calibration.names:
        if name.endswith((".fx", ".fy")):
            value, sigma = calibration.value(name)
            relative[name] = sigma / value
    name = max(relative, key=lambda key: relative[key])
    if relative[name] < _FOCAL_FLAGGED:
        return []
    value, sigma = calibration.value(name)
    lens, axis = name.split(".")
    return [
        Finding(
            "focal_undetermined",
            relative[name] > _FOCAL_REFUSED,
            f"the {lens}'s focal length {axis} = {value:.0f} px is known to ± {1.96 * sigma:.0f} px only "
            f"({196 * relative[name]:.1f} %, 95 %)",
            "Add poses with the board tilted by 20° to 40° in different directions, near and far, filling the picture.",
        )
    ]


def distortion_uncertainty(calibration: Calibration, lens: str) -> float:
    """Standard uncertainty (px) of the distortion at the worst place that camera and projector both see.

    Of the displacement by the distortion terms alone, with all else as estimated; what a focal length can take up is
    left to it (the covariance conditional on focal lengths and centre).
    """
    names = [f"{lens}.{term}" for term in DISTORTION if f"{lens}.{term}" in calibration.names]
    if not names:
        return 0.0
    part = calibration.rig.camera if lens == "camera" else calibration.rig.projector
    rays = part.rays(getattr(common_view(calibration), lens))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if not len(rays):
        return float("inf")
    _, jacobian = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), part.matrix, _all_terms(part.distortion))[:2]
    slopes = jacobian.reshape(-1, 2, 24)[..., 10:]
    chosen = slopes[..., [DISTORTION.index(name.split(".")[1]) for name in names]]
    index = [calibration.names.index(name) for name in names]
    held = [i for i, name in enumerate(calibration.names) if name in {f"{lens}.{p}" for p in ("fx", "fy", "cx", "cy")}]
    cov = calibration.covariance
    cross = cov[np.ix_(index, held)]
    own = cov[np.ix_(index, index)] - cross @ np.linalg.solve(cov[np.ix_(held, held)], cross.T)
    variance = np.einsum("nij,jk,nik->ni", chosen, own, chosen)
    return float(np.sqrt(np.maximum(variance, 0).sum(axis=1).max()))


def _all_terms(distortion: Array) -> Array:
    out = np.zeros(len(DISTORTION))
    out[: len(distortion)] = distortion
    return out


def _distortion(calibration: Calibration) -> list[Finding]:
    worst = {lens: distortion_uncertainty(calibration, lens) for lens in ("camera", "projector")}
    return [
        Finding(
            "distortion_undetermined",
            False,
            f"the {lens}'s distortion is known to ± {1.96 * sigma:.1f} px only (95 %) where its picture is known least",
            "Hold the board into all corners of the picture that both see, or calibrate with fewer distortion terms.",
        )
        for lens, sigma in worst.items()
        if sigma > _DISTORTION_PX
    ]


def _axes(calibration: Calibration) -> list[Finding]:
    if all(calibration.model.axes):
        return []
    axis, other = ("x", "y") if calibration.model.axes[0] else ("y", "x")
    _, sigma = calibration.value(f"translation.{other}")
    turn = abs(float(np.degrees(np.arctan2(calibration.rig.rotation[1, 0], calibration.rig.rotation[0, 0]))))
    findings = [
        Finding(
            "single_axis",
            False,
            f"only projector {axis} was measured: the projector's focal length along {other} is taken as along {axis}, "
            f"its centre as the picture's, and translation {other} is open to ± {1.96 * sigma:.0f} mm; depth from "
            f"{axis} does not feel it",
            f"Project fringes along {other} as well if points are to be checked against epipolar lines.",
        )
    ]
    if 45 < turn < 135:
        findings.append(
            Finding(
                "swapped_axes",
                True,
                f"the projector's {axis} axis is turned by {turn:.0f}° against the camera's: what was decoded as "
                f"{axis} is probably {other}",
                "Decode the sequence as the axis along which its fringes vary.",
            )
        )
    return findings


def _noise(calibration: Calibration) -> list[Finding]:
    told = [
        f"{lens} {ratio:.1f} times (r.m.s. {rms:.3f} px where {expected:.3f} px were predicted)"
        for lens, ratio, rms, expected in (
            ("camera", calibration.scale_camera, calibration.rms_camera, calibration.expected_camera),
            ("projector", calibration.scale_projector, calibration.rms_projector, calibration.expected_projector),
        )
        if ratio > _NOISE_RATIO
    ]
    if not told:
        return []
    return [
        Finding(
            "noise_underestimated",
            False,
            f"residuals are larger than the stated noise: {'; '.join(told)}; uncertainties are widened accordingly",
            "State how exact the print is (its points are then estimated too), look for a bent board, blur, movement "
            "during a pose, or too few distortion terms.",
        )
    ]
