"""Weighted, robust bundle adjustment: Levenberg–Marquardt with the poses eliminated.

Normal equations with the Schur complement over the poses (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000,
§6); Huber weights on the distance of a point in units of σ (Huber, Ann. Math. Stat. 35, 73 (1964)); the scales of the
camera's and the projector's σ are estimated with the rest, as variance components (Förstner, 1979).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import gamma, gammainc, gammaincc

from calibration.solver.measurements import Measurements
from calibration.solver.parameters import Freedom, State
from calibration.solver.projection import linearised, predicted

Array = NDArray[np.float64]

HUBER = 3.0  # σ; 99 % of good points lie inside, so robustness costs next to no precision
_STEPS, _ROUNDS = 60, 10
_CONVERGED = 1e-8  # of the cost: far below what moving one parameter by a hundredth of its σ changes
_POSE_PRIOR = np.array([1e-2, 1e-2, 1e-2, 1e-10, 1e-10, 1e-10])  # 1/rad², 1/mm²: only keeps matrices invertible


@dataclass(frozen=True, eq=False)
class Normals:
    """Normal equations of one linearisation, pose by pose; q free globals (and board coordinates), m poses.

    Parameters
    ----------
    globals_, cross, poses
        Blocks (m, q, q), (m, q, 6), (m, 6, 6) of JᵀWJ.
    gradients, pose_gradients
        (m, q), (m, 6) of JᵀW (measured − predicted).
    prior, prior_gradient
        (q, q), (q,) of what is known beforehand.
    """

    globals_: Array
    cross: Array
    poses: Array
    gradients: Array
    pose_gradients: Array
    prior: Array
    prior_gradient: Array

    def shares(self) -> tuple[Array, Array]:
        """What every pose tells about the globals once it is eliminated itself: (m, q, q) and gradients (m, q)."""
        solved = np.linalg.solve(self.poses, np.swapaxes(self.cross, 1, 2))
        return (
            self.globals_ - self.cross @ solved,
            self.gradients - np.einsum("mkq,mk->mq", solved, self.pose_gradients),
        )

    def reduced(self) -> tuple[Array, Array]:
        """Information (q, q) about the globals, priors included, and its gradient (q,)."""
        information, gradients = self.shares()
        return information.sum(0) + self.prior, gradients.sum(0) + self.prior_gradient

    def step(self, damping: float) -> tuple[Array, Array]:
        """Levenberg–Marquardt step (q,), (m, 6); the damping scales the diagonal (Marquardt, 1963)."""
        corner = np.arange(6)
        poses = self.poses.copy()
        poses[:, corner, corner] *= 1 + damping
        damped = Normals(
            self.globals_, self.cross, poses, self.gradients, self.pose_gradients, self.prior, self.prior_gradient
        )
        information, gradient = damped.reduced()
        diagonal = np.einsum("mqq->q", self.globals_) + np.diag(self.prior)
        step = solved(information + np.diag(damping * diagonal), gradient)
        rest = self.pose_gradients - np.einsum("mqk,q->mk", self.cross, step)
        return step, np.linalg.solve(poses, rest[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjustment that has converged.

    Parameters
    ----------
    state
        The estimate.
    scales
        (2,) by what the σ of camera and projector have to be multiplied to be what the residuals show; not below 1.
    raw_scales
        (2,) the same without the lower limit.
    residuals
        (2, N, 2) measured − predicted, px, the projector's at the camera's places; 0 where nothing was measured.
    weights
        (2, N) Huber weights of points.
    cost
        Robust χ², in units of the scaled σ.
    covariance
        (q, q) of the free parameters.
    redundancy
        (2,) degrees of freedom that camera and projector contribute (Förstner, 1979).
    normals
        At the estimate.
    """

    state: State
    scales: Array
    raw_scales: Array
    residuals: Array
    weights: Array
    cost: float
    covariance: Array
    redundancy: Array
    normals: Normals


def adjusted(
    start: State, data: Measurements, free: Freedom, scales: Array | None = None, rounds: int = _ROUNDS
) -> Adjusted:
    """Minimise the robust χ² of all observations.

    Parameters
    ----------
    start
        A first estimate, good to some tens of px.
    data
        The observations.
    free
        What is estimated.
    scales
        (2,) scales of σ to keep; None estimates them.
    rounds
        Most rounds of adjustment and estimation of the scales.
    """
    state = start
    held = scales is not None
    current = np.asarray(scales, np.float64) if scales is not None else _spread(start, data)
    result = None
    for _ in range(1 if held else rounds):
        state = _minimised(state, data, free, current)
        result = _summary(state, data, free, current)
        if held or np.all(np.abs(result.scales / current - 1) < 0.01):
            break
        current = result.scales
    assert result is not None
    return result


def normals(state: State, data: Measurements, free: Freedom, scales: Array) -> tuple[Normals, Array, Array]:
    """Normal equations at ``state``, with the residuals (2, N, 2) and Huber weights (2, N)."""
    pixels, by_globals, by_pose, by_point = linearised(state, data)
    residuals = np.where(data.known, data.measured - pixels, 0.0)
    weights = _huber(_distance(residuals, data, scales))
    root = np.sqrt(data.weight * weights[..., None]) / scales[:, None, None]
    J = by_globals @ free.spread
    if free.board_prior is not None:
        J = np.concatenate([J, _board_columns(by_point, data)], axis=3)
    J = J * root[..., None]
    P = by_pose * root[..., None]
    r = residuals * root
    q = J.shape[-1]
    blocks = [
        (
            np.concatenate([J[:, s].reshape(-1, q), P[:, s].reshape(-1, 6)], axis=1),
            r[:, s].reshape(-1),
        )
        for s in data.slices()
    ]
    products = np.stack([block.T @ block for block, _ in blocks])
    gradients = np.stack([block.T @ rest for block, rest in blocks])
    prior = free.spread.T @ (free.prior[:, None] * free.spread)
    prior_gradient = free.spread.T @ (free.prior * (free.prior_mean - state.values))
    if free.board_prior is not None:
        prior = block_diag(prior, free.board_prior * np.eye(state.board.size))
        prior_gradient = np.append(prior_gradient, -free.board_prior * state.board.ravel())
    return (
        Normals(
            products[:, :q, :q],
            products[:, :q, q:],
            products[:, q:, q:] + np.diag(_POSE_PRIOR),
            gradients[:, :q],
            gradients[:, q:],
            prior,
            prior_gradient,
        ),
        residuals,
        weights,
    )


def _minimised(state: State, data: Measurements, free: Freedom, scales: Array) -> State:
    damping = 1e-4
    cost = _cost(state, data, free, scales)
    for _ in range(_STEPS):
        system, _, _ = normals(state, data, free, scales)
        while True:
            step, pose_steps = system.step(damping)
            count = len(free.names)
            board_step = step[count:].reshape(state.board.shape) if free.board_prior is not None else 0.0
            trial = state.moved(free.spread @ step[:count], pose_steps, board_step)
            trial_cost = _cost(trial, data, free, scales)
            if trial_cost < cost:
                break
            damping *= 8
            if damping > 1e8:
                return state
        gain, state, cost = cost - trial_cost, trial, trial_cost
        damping = max(damping / 8, 1e-10)
        if gain < _CONVERGED * cost:
            break
    return state


def _summary(state: State, data: Measurements, free: Freedom, scales: Array) -> Adjusted:
    system, residuals, weights = normals(state, data, free, scales)
    information, _ = system.reduced()
    covariance = solved(information, np.eye(len(information)))
    count = len(free.names)
    used = _parameters_used(state, data, free, scales, weights, system, covariance)
    observed = data.known.sum(axis=(1, 2))
    redundancy = np.maximum(observed - used, 1.0)
    distance = _distance(residuals, data, scales)
    rho = np.where(distance < HUBER, distance**2, HUBER * distance)
    dimensions = data.known.sum(axis=2)
    # What Huber's weights take away from a sum of squares of Gaussian residuals.
    lost = np.array([1.0, _kept(1), _kept(2)])[dimensions]
    expected = np.divide((lost * dimensions).sum(1), observed, out=np.ones(2), where=observed > 0)
    raw = scales * np.sqrt(rho.sum(1) / expected / redundancy)
    raw = np.where(observed > 0, raw, 1.0)
    return Adjusted(
        state,
        np.maximum(raw, 1.0),
        raw,
        residuals,
        weights,
        _cost(state, data, free, scales),
        covariance[:count, :count],
        redundancy,
        system,
    )


def _parameters_used(
    state: State, data: Measurements, free: Freedom, scales: Array, weights: Array, system: Normals, covariance: Array
) -> Array:
    """(2,) how many of the estimated parameters camera and projector each pay for: traces of the leverage."""
    _, by_globals, by_pose, by_point = linearised(state, data)
    root = np.sqrt(data.weight * weights[..., None]) / scales[:, None, None]
    all_columns = by_globals @ free.spread
    if free.board_prior is not None:
        all_columns = np.concatenate([all_columns, _board_columns(by_point, data)], axis=3)
    inverse = np.linalg.inv(system.poses)
    used = np.zeros(2)
    for i, rows in enumerate(data.slices()):
        to_pose = inverse[i] @ system.cross[i].T
        for lens in range(2):
            J = (all_columns[lens, rows] * root[lens, rows][..., None]).reshape(-1, len(covariance))
            P = (by_pose[lens, rows] * root[lens, rows][..., None]).reshape(-1, 6)
            eliminated = J - P @ to_pose
            used[lens] += np.sum((eliminated @ covariance) * eliminated) + np.sum((P @ inverse[i]) * P)
    return used


def _board_columns(by_point: Array, data: Measurements) -> Array:
    """(2, N, 2, 3k): every point's derivatives in the columns of its own three coordinates."""
    count = len(data.point)
    columns = np.zeros((2, count, 2, data.board_size, 3))
    columns[:, np.arange(count), :, data.point] = np.moveaxis(by_point, 1, 0)
    return columns.reshape(2, count, 2, -1)


def _spread(state: State, data: Measurements) -> Array:
    """(2,) robust scale of the residuals in units of σ, with which an adjustment begins."""
    residuals = np.where(data.known, data.measured - predicted(state, data), 0.0)
    in_sigmas = np.abs(residuals) * np.sqrt(data.weight)
    return np.array(
        [
            max(1.0, 1.4826 * float(np.median(in_sigmas[i][data.known[i]]))) if data.known[i].any() else 1.0
            for i in (0, 1)
        ]
    )


def _cost(state: State, data: Measurements, free: Freedom, scales: Array) -> float:
    distance = _distance(data.measured - predicted(state, data), data, scales)
    robust = np.where(distance < HUBER, distance**2, 2 * HUBER * distance - HUBER**2)
    known = (free.prior * (state.values - free.prior_mean) ** 2).sum()
    return float(robust.sum() + known + (free.board_prior or 0.0) * (state.board**2).sum())


def _distance(residuals: Array, data: Measurements, scales: Array) -> Array:
    """(2, N) distance of points from where they should be, in scaled σ."""
    return np.asarray(np.sqrt((data.weight * residuals**2).sum(2)) / scales[:, None])


def _huber(distance: Array) -> Array:
    return np.where(distance < HUBER, 1.0, HUBER / np.maximum(distance, HUBER))


def _kept(dimensions: int) -> float:
    """Share of E[d²] that Huber's ψ(d) d keeps of Gaussian residuals: d² inside, HUBER·d outside, d follows χ."""
    half = dimensions / 2
    inside = gammainc(half + 1, HUBER**2 / 2)
    outside = HUBER * math.sqrt(2) * gamma(half + 0.5) / gamma(half) * gammaincc(half + 0.5, HUBER**2 / 2)
    return float(inside + outside / dimensions)


def solved(matrix: Array, right: Array) -> Array:
    """Solution of a symmetric positive definite system, scaled to a unit diagonal because units differ by 1e6."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix * scale[:, None] * scale
    right = right * (scale if right.ndim == 1 else scale[:, None])
    try:
        solution = np.linalg.solve(scaled, right)
    except np.linalg.LinAlgError:
        solution = np.linalg.lstsq(scaled, right, rcond=None)[0]
    return np.asarray(solution * (scale if right.ndim == 1 else scale[:, None]))
