"""Whether a stored rig still holds, from one pose of a board.

Two questions that need no adjustment: do the projector's coordinates lie on the epipolar lines of the camera's pixels,
and are the distances between triangulated points those of the board? And one test that misses nothing a single pose
can show: by how much would the projector have to have moved against the camera to explain the pose, compared with how
surely that is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2

from calibration.observations import Finding, PoseObservation
from calibration.solver.adjustment import adjusted, normals, solved
from calibration.solver.measurements import Measurements, gathered
from calibration.solver.parameters import (
    CAMERA,
    INDEX,
    NAMES,
    PROJECTOR,
    ROTATION,
    TRANSLATION,
    Freedom,
    State,
    freedom,
)
from calibration.solver.screening import LEAST_POINTS, screened
from calibration.solver.start import homography, pose_start, rotation_vector
from drivers.errors import OperatorError
from scanner.optics import triangulate_plain
from scanner.rig import Lens, Rig

Array = NDArray[np.float64]

_FALSE_ALARM, _MISSED = 0.01, 0.05
_MISFIT = 2.0  # residuals over stated noise that no motion explains
_MOVING = tuple(f"{part}.{axis}" for part in ("rotation", "translation") for axis in "xyz")


class DriftError(OperatorError):
    """The pose cannot be used for a check."""


@dataclass(frozen=True, eq=False)
class DriftReport:
    """Verdict on a rig.

    Parameters
    ----------
    holds
        Whether the rig may go on being used.
    reason
        Why, with figures.
    epipolar_px, epipolar_expected_px
        Root mean square distance of the points from their epipolar lines, and what noise and the rig's stated
        uncertainty predict for it; NaN with one axis.
    scale, scale_sigma
        Distances between triangulated points over those of the board, and its standard uncertainty.
    turn_deg, turn_sigma_deg, turn_limit_deg
        (3,) by how much the projector seems to have turned about its own axes, how surely, and the least turn about
        each axis alone that the check finds 19 times in 20.
    shift_mm, shift_sigma_mm, shift_limit_mm
        (3,) the same for a shift of the projector's centre along its axes.
    p_value
        Probability of so large a motion in a rig that holds.
    misfit
        Residuals over stated noise once the motion is allowed for; 1 is good.
    findings
        ``drifted`` or ``lens_changed`` or ``rig_without_covariance``.
    """

    holds: bool
    reason: str
    epipolar_px: float
    epipolar_expected_px: float
    scale: float
    scale_sigma: float
    turn_deg: Array
    turn_sigma_deg: Array
    turn_limit_deg: Array
    shift_mm: Array
    shift_sigma_mm: Array
    shift_limit_mm: Array
    p_value: float
    misfit: float
    findings: tuple[Finding, ...]


def check(rig: Rig, observations: PoseObservation | Sequence[PoseObservation]) -> DriftReport:
    """Judge a rig by one pose of a board, or by several.

    The motion δ of the projector and the poses of the board are estimated with the lenses as stored. δ has the
    covariance of the noise plus K Σ Kᵀ, with Σ the rig's stated covariance and K what an error of the rig does to δ;
    δᵀ C⁻¹ δ is compared with χ² of six degrees of freedom at 1 % false alarms.

    Parameters
    ----------
    rig
        As stored; its metadata should hold the covariance that `calibration.bundle.calibrate_rig` writes.
    observations
        Of a board of known size.

    Raises
    ------
    DriftError
        Too few points, or points that do not lie on their board.
    """
    poses = [observations] if isinstance(observations, PoseObservation) else list(observations)
    sieve = screened(poses)
    if not sieve.usable.all() or not poses:
        names = ", ".join(o.name for o, good in zip(poses, sieve.usable, strict=True) if not good) or "no pose"
        raise DriftError(
            f"{names} cannot be used to check the rig: fewer than {LEAST_POINTS} points, or points that do not lie on "
            "their board",
            "Hold the named board whole into the pictures of camera and projector, and take it again.",
        )
    data = gathered(poses, sieve.keep)
    start = _start(rig, data)
    document = rig.metadata.get("calibration", {})
    stated, covariance = _stated(document)
    scales = np.array([max(1.0, float(document.get(f"scale_{lens}", 1.0))) for lens in ("camera", "projector")])
    free = _motion(start)
    fit = adjusted(start, data, free, scales)
    misfit = _misfit(fit.residuals, data, scales, len(poses))
    about_centre = _about_centre(rig.translation)
    moved = about_centre @ _moved(start, fit.state)
    noise, to_motion = _sensitivity(fit.state, data, free, stated, scales)
    C = about_centre @ (noise * max(1.0, misfit) ** 2 + to_motion @ covariance @ to_motion.T) @ about_centre.T
    information = solved(C, np.eye(6))
    statistic = float(moved @ information @ moved)
    p_value = float(chi2.sf(statistic, 6))
    limit = math.sqrt(_noncentrality()) / np.sqrt(np.diag(information))
    epipolar, epipolar_expected, scale, scale_sigma = _figures(rig, data, start, stated, covariance, scales)
    sigma = np.sqrt(np.diag(C))
    turn, shift = np.degrees(moved[:3]), moved[3:]
    figures = _told((epipolar, epipolar_expected), (scale, scale_sigma))
    findings = _judged(p_value, misfit, moved, sigma, figures, stated)
    refused = [finding for finding in findings if finding.refuses]
    reason = "; ".join(finding.what for finding in refused) if refused else f"the rig holds: {figures}"
    return DriftReport(
        not refused, reason, epipolar, epipolar_expected, scale, scale_sigma,
        turn, np.degrees(sigma[:3]), np.degrees(limit[:3]), shift, sigma[3:], limit[3:], p_value, misfit,
        tuple(findings),
    )  # fmt: skip


def _start(rig: Rig, data: Measurements) -> State:
    values = np.zeros(len(NAMES))
    for part, lens in ((CAMERA, rig.camera), (PROJECTOR, rig.projector)):
        values[part][:4] = lens.matrix[0, 0], lens.matrix[1, 1], lens.matrix[0, 2], lens.matrix[1, 2]
        values[part][4 : 4 + len(lens.distortion)] = lens.distortion
    values[ROTATION], values[TRANSLATION] = rotation_vector(rig.rotation), rig.translation
    poses = []
    for rows in data.slices():
        straight = rig.camera.rays(data.measured[0, rows])[:, :2]
        good = np.isfinite(straight).all(axis=1)
        H = homography(data.points[rows][good, :2], straight[good])
        poses.append(pose_start(H, np.array([1.0, 1.0, 0.0, 0.0])))
    flat = np.zeros((data.board_size, 3))
    return State(values, np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]), flat)


def _stated(document: Mapping[str, Any]) -> tuple[list[str], Array]:
    names = [name for name in document.get("parameters", []) if name in INDEX]
    return names, np.array(document["covariance"], np.float64) if names else np.zeros((0, 0))


def _motion(start: State) -> Freedom:
    prior = np.zeros(len(NAMES))
    # A projector that has moved by decimetres or radians is not in doubt; one axis alone needs the limit.
    prior[ROTATION], prior[TRANSLATION] = 1.0, 1e-4
    return freedom(_MOVING, {}, prior, start.values)


def _moved(start: State, end: State) -> Array:
    """(6,) rad and mm: turn about the projector's axes and shift."""
    return np.concatenate(
        [rotation_vector(end.rotation @ start.rotation.T), end.values[TRANSLATION] - start.values[TRANSLATION]]
    )


def _about_centre(T: Array) -> Array:
    """(6, 6) from a change (ω, δT) of X_proj = R X + T to a turn about the projector's centre and the centre's shift.

    A projector that turns by ω and moves by s has T' = exp(ω)(T − s), so that s = ω × T − δT.
    """
    out = np.zeros((6, 6))
    out[:3, :3] = np.eye(3)
    out[3:, :3] = np.cross(np.eye(3), T).T
    out[3:, 3:] = -np.eye(3)
    return out


def _misfit(residuals: Array, data: Measurements, scales: Array, poses: int) -> float:
    in_sigmas = residuals**2 * data.weight / scales[:, None, None] ** 2
    # The median of χ² of one degree of freedom is 0.455: strangers do not count.
    spread = float(np.median(in_sigmas[data.known])) / 0.4549
    count = int(data.known.sum())
    return math.sqrt(spread * count / max(count - 6 * poses - 6, 1))


def _sensitivity(
    state: State, data: Measurements, free: Freedom, names: Sequence[str], scales: Array
) -> tuple[Array, Array]:
    """Covariance (6, 6) of the motion from noise, and what errors (q,) of the rig's parameters do to it (6, q)."""
    others = [name for name in names if name not in _MOVING]
    prior = np.zeros(len(NAMES))
    both = freedom([*_MOVING, *others], {}, prior, state.values)
    system, _, _ = normals(state, data, both, scales)
    information, _ = system.reduced()
    own = information[:6, :6] + np.diag(free.spread.T @ free.prior)
    to_motion = np.zeros((6, len(names)))
    cross = -solved(own, information[:6, 6:]) if others else np.zeros((6, 0))
    for column, name in enumerate(names):
        if name in _MOVING:
            # The stored pose was wrong by this much already.
            to_motion[_MOVING.index(name), column] = -1.0
        else:
            to_motion[:, column] = cross[:, others.index(name)]
    return solved(own, np.eye(6)), to_motion


def _noncentrality() -> float:
    """Noncentrality that χ² of six degrees needs to pass the limit 19 times in 20."""
    limit = float(chi2.isf(_FALSE_ALARM, 6))
    return float(brentq(lambda value: ncx2.cdf(limit, 6, value) - _MISSED, 1.0, 200.0))


def _figures(
    rig: Rig, data: Measurements, start: State, names: Sequence[str], covariance: Array, scales: Array
) -> tuple[float, float, float, float]:
    """Epipolar distance and its expectation (px), scale and its σ; the rig's part by finite differences."""
    distances, scale = _distances_and_scale(start, rig, data)
    noise = _epipolar_noise(rig, data, scales)
    slopes, scale_slopes = [], []
    for name, sigma in zip(names, np.sqrt(np.diag(covariance)), strict=True):
        step = np.zeros(len(NAMES))
        step[INDEX[name]] = max(float(sigma), 1e-9)
        moved, other = _distances_and_scale(start.moved(step, np.zeros((data.count, 6))), rig, data)
        slopes.append((moved - distances) / step[INDEX[name]])
        scale_slopes.append((other[0] - scale[0]) / step[INDEX[name]])
    J, j = np.array(slopes).reshape(len(names), len(distances)), np.array(scale_slopes)
    from_rig = np.einsum("qn,qr,rn->n", J, covariance, J)
    known = np.isfinite(distances)
    if not known.any():
        return math.nan, math.nan, scale[0], math.hypot(scale[1], math.sqrt(float(j @ covariance @ j)))
    return (
        float(np.sqrt(np.mean(distances[known] ** 2))),
        float(np.sqrt(np.mean(noise[known] ** 2 + from_rig[known]))),
        scale[0],
        math.hypot(scale[1], math.sqrt(float(j @ covariance @ j))),
    )


def _distances_and_scale(state: State, rig: Rig, data: Measurements) -> tuple[Array, tuple[float, float]]:
    """Signed distances (n,) from the epipolar curves, px, and the scale of the triangulated points with its noise."""
    camera, projector = state.lens(CAMERA, rig.camera.size), state.lens(PROJECTOR, rig.projector.size)
    sigma = np.where(data.known[1], 1 / np.sqrt(np.maximum(data.weight[1], 1e-300)), np.inf).T
    rays = camera.rays(data.measured[0])
    with np.errstate(all="ignore"):
        z, _, distances = triangulate_plain(
            rays[:, :2], projector.vector, state.rotation, state.values[TRANSLATION], data.measured[1].T, sigma
        )
    X = rays * z[:, None]
    both = data.known[1].all(axis=1)
    ratios, weights, left = [], [], []
    for rows in data.slices():
        good = np.isfinite(X[rows]).all(axis=1)
        found, told = X[rows][good], data.points[rows][good]
        found, told = found - found.mean(0), told - told.mean(0)
        # Least squares similarity (Umeyama, IEEE TPAMI 13, 376 (1991)).
        u, s, vt = np.linalg.svd(found.T @ told)
        sign = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
        weights.append(float(np.sum(told**2)))
        ratios.append(float(s @ sign) / weights[-1])
        left.append(float(np.sum((found - ratios[-1] * told @ (u @ np.diag(sign) @ vt).T) ** 2)) / (3 * len(told) - 7))
    total = sum(weights)
    scale = float(np.dot(ratios, weights) / total)
    return np.where(both, distances, np.nan), (scale, math.sqrt(float(np.mean(left)) / total))


def _epipolar_noise(rig: Rig, data: Measurements, scales: Array) -> Array:
    """(n,) standard deviation of the distance from the epipolar curve, px: the projector's noise and the camera's."""

    def sigma(lens: int) -> Array:
        known = data.weight[lens]
        return np.asarray(
            scales[lens] * np.sqrt(np.divide(1.0, known, out=np.zeros_like(known), where=known > 0).mean(1))
        )

    # A coordinate that was read at the camera's point makes a true pair with it, whatever that point's error.
    apart = ~data.gradient.any(axis=(1, 2))
    return np.hypot(sigma(1), apart * sigma(0) * _focal(rig.projector) / _focal(rig.camera))


def _focal(lens: Lens) -> float:
    return float(lens.matrix[0, 0] + lens.matrix[1, 1]) / 2


def _told(epipolar: tuple[float, float], scale: tuple[float, float]) -> str:
    lies = f"points lie {epipolar[0]:.3f} px r.m.s. from their epipolar lines ({epipolar[1]:.3f} px expected), "
    return f"{lies if math.isfinite(epipolar[0]) else ''}scale {scale[0]:.5f} ± {1.96 * scale[1]:.5f}"


def _judged(
    p_value: float, misfit: float, moved: Array, sigma: Array, figures: str, names: Sequence[str]
) -> list[Finding]:
    findings = []
    if p_value < _FALSE_ALARM:
        findings.append(
            Finding(
                "drifted",
                True,
                "the projector has moved against the camera: "
                f"turned by {_vector(np.degrees(moved[:3]), np.degrees(sigma[:3]), '°')}, "
                f"shifted by {_vector(moved[3:], sigma[3:], ' mm')}; {figures}",
                "Tighten both devices and let them warm up, then calibrate again; if only the scale is wrong, check "
                "that the board is the one that was named.",
            )
        )
    if misfit > _MISFIT:
        findings.append(
            Finding(
                "lens_changed",
                True,
                f"residuals are {misfit:.1f} times the stated noise whatever the projector's place: the lenses are not "
                "as they were, or the board is bent",
                "Check that neither focus nor zoom was touched and that the board is flat; then calibrate again.",
            )
        )
    if not names:
        findings.append(
            Finding(
                "rig_without_covariance",
                False,
                "the rig does not say how surely it is known, so that its own errors count as drift",
                "Calibrate with this program, which stores the covariance with the rig.",
            )
        )
    return findings


def _vector(values: Array, sigma: Array, unit: str) -> str:
    return "(" + ", ".join(f"{v:.3f} ± {1.96 * s:.3f}" for v, s in zip(values, sigma, strict=True)) + f"){unit}"
