"""From an adjustment to the `Calibration` that is handed out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.observations import PoseObservation
from calibration.solver.adjustment import Adjusted
from calibration.solver.measurements import Measurements, gathered
from calibration.solver.model import Model
from calibration.solver.parameters import CAMERA, PROJECTOR, TRANSLATION, State
from calibration.solver.projection import predicted
from calibration.solver.result import Calibration, PoseResult, notes
from calibration.solver.selection import Terms, Trial
from calibration.solver.start import homography, pose_start
from scanner.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """An adjustment with all that led to it."""

    model: Model
    data: Measurements
    terms: Terms
    table: tuple[Trial, ...]
    adjusted: Adjusted
    ids: NDArray[np.int64]
    board_sigma_mm: float | None = None


def reported(
    observations: Sequence[PoseObservation], usable: NDArray[np.bool_], kept: Sequence[int], fit: Fit
) -> Calibration:
    """Put a calibration together; of the ``usable`` poses those in ``kept`` (indices) took part."""
    state, freedom = fit.adjusted.state, fit.model.freedom(fit.terms, board_sigma_mm=fit.board_sigma_mm)
    rig = Rig(
        state.lens(CAMERA, fit.model.camera_size),
        state.lens(PROJECTOR, fit.model.projector_size),
        state.rotation,
        state.values[TRANSLATION],
    )
    values = np.array([state.values[int(np.flatnonzero(column)[0])] for column in freedom.spread.T])
    rms = _rms(_as_measured(fit.adjusted.residuals, fit.data) ** 2, fit.data)
    share = fit.adjusted.redundancy / np.maximum(fit.data.known.sum(axis=(1, 2)), 1)
    variance = np.divide(1.0, fit.data.weight, out=np.zeros_like(fit.data.weight), where=fit.data.known)
    variance *= share[:, None, None]
    variance[1] += np.where(fit.data.known[1], np.einsum("nij,nj->ni", fit.data.gradient**2, variance[0]), 0.0)
    predicted_rms = _rms(variance, fit.data)
    poses = _poses(observations, usable, kept, fit)
    return Calibration(
        rig,
        freedom.names,
        values,
        fit.adjusted.covariance,
        poses,
        fit.terms,
        fit.table,
        float(fit.adjusted.raw_scales[0]),
        float(fit.adjusted.raw_scales[1]),
        *rms,
        *predicted_rms,
        (),
        fit.adjusted,
        freedom,
        fit.data,
        fit.model,
    )


def annotated(c: Calibration, validity: Mapping[str, Any]) -> Calibration:
    """The calibration with its figures and findings written into the rig's metadata."""
    baseline, sigma = c.baseline
    figures = {
        "baseline_mm": baseline,
        "baseline_standard_uncertainty_mm": sigma,
        "rms_camera_px": c.rms_camera,
        "rms_projector_px": c.rms_projector,
        "rms_stereo_px": c.rms_stereo,
        "expected_rms_camera_px": c.expected_camera,
        "expected_rms_projector_px": c.expected_projector,
        "scale_camera": c.scale_camera,
        "scale_projector": c.scale_projector,
    }
    document = notes(c.names, c.values, c.covariance, c.terms, figures, c.poses, c.findings, validity)
    return replace(c, rig=replace(c.rig, metadata={"calibration": document}))


def _as_measured(residuals: Array, data: Measurements) -> Array:
    """Residuals (2, N, 2) with the projector's as they were measured, what the camera's do to them included."""
    whole = residuals[1] + np.einsum("nij,nj->ni", data.gradient, residuals[0])
    return np.stack([residuals[0], np.where(data.known[1], whole, 0.0)])


def _rms(squares: Array, data: Measurements) -> tuple[float, float, float]:
    """Root mean square over points of camera, projector and both."""
    counts = data.known.any(axis=2).sum(axis=1)
    sums = squares.sum(axis=(1, 2))
    camera, projector = np.sqrt(sums / np.maximum(counts, 1))
    return float(camera), float(projector), float(np.sqrt(sums.sum() / max(int(counts.sum()), 1)))


def _poses(
    observations: Sequence[PoseObservation], usable: NDArray[np.bool_], kept: Sequence[int], fit: Fit
) -> tuple[PoseResult, ...]:
    influence = _influence(fit.adjusted)
    rows = fit.data.slices()
    results = []
    for i, o in enumerate(observations):
        if i in kept:
            j = list(kept).index(i)
            turn, shift = fit.adjusted.state.turns[j], fit.adjusted.state.shifts[j]
            weight = float(influence[j])
        else:
            turn, shift = _alone(o, fit)
            weight = float("nan")
        data = replace(gathered([o]), extent=fit.data.extent, point=np.arange(len(o.ids)))
        state = State(fit.adjusted.state.values, turn[None], shift[None], _board_of(o, fit))
        residuals = np.where(data.known, data.measured - predicted(state, data), np.nan)
        sigmas = residuals * np.sqrt(data.weight) / fit.adjusted.scales[:, None, None]
        squares = fit.adjusted.residuals[:, rows[j]] ** 2 * fit.data.weight[:, rows[j]] if i in kept else None
        known = fit.data.known[:, rows[j]] if i in kept else None
        scaled = (
            float(np.sum(squares / fit.adjusted.scales[:, None, None] ** 2) / max(int(known.sum()) - 6, 1))
            if squares is not None and known is not None
            else float(np.nanmean(sigmas**2))
        )
        results.append(
            PoseResult(
                o.name,
                o.ids,
                turn,
                shift,
                residuals[0],
                residuals[1],
                sigmas[0],
                sigmas[1],
                np.asarray(o.projector, np.float64),
                scaled,
                weight,
                i in kept,
                not usable[i],
            )
        )
    return tuple(results)


def _board_of(o: PoseObservation, fit: Fit) -> Array:
    """(n, 3) how the points of a pose lie beside their definition; 0 for points that no other pose has shown."""
    place = {int(i): int(j) for i, j in zip(fit.ids, fit.data.point, strict=True)}
    rows = np.array([place.get(int(i), -1) for i in o.ids])
    return np.where((rows >= 0)[:, None], fit.adjusted.state.board[rows], 0.0)


def _alone(o: PoseObservation, fit: Fit) -> tuple[Array, Array]:
    """The pose of a board that did not take part, from its camera points only."""
    finite = np.isfinite(o.camera).all(axis=1)
    lens = fit.adjusted.state.lens(CAMERA, fit.model.camera_size)
    straight = lens.rays(o.camera[finite])[:, :2]
    good = np.isfinite(straight).all(axis=1)
    if np.count_nonzero(good) < 4:
        return np.eye(3), np.array([0.0, 0.0, 1e3])
    return pose_start(homography(o.points_board[finite][good, :2], straight[good]), np.array([1.0, 1.0, 0.0, 0.0]))


def _influence(fit: Adjusted) -> Array:
    """(m,) move of the parameters, in standard uncertainties, when a pose is left out (one step of Gauss-Newton)."""
    shares, gradients = fit.normals.shares()
    total, _ = fit.normals.reduced()
    scale = 1 / np.sqrt(np.diag(total))
    sigma = np.sqrt(np.diag(fit.covariance))
    moves = []
    for share, gradient in zip(shares, gradients, strict=True):
        rest = (total - share) * scale[:, None] * scale
        moved = np.linalg.lstsq(rest, -gradient * scale, rcond=None)[0] * scale
        moves.append(float(np.sqrt(np.mean((moved[: len(sigma)] / sigma) ** 2))))
    return np.array(moves)
