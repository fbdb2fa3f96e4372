"""The choice between the hypotheses of both axes together; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.paths.joint_fit import Reals, factorise, load, set_line, variance
from scanner.paths.joint_hypotheses import HOPELESS_CHI2, apart, leads_to_known, propose, refine, rival
from scanner.paths.joint_nearby import NEARBY, nearby
from scanner.paths.joint_spread import OUTSIDE, by_bounce, widened
from scanner.paths.rotation import compiled

Floats = NDArray[np.float32]

FIELDS = 17
"""Of a hypothesis: u₁, u₂, a₁, a₂ along the line and across it, the σ of all eight, χ²."""
ROWS = 2 * FIELDS + 1
"""Of a pixel's result: the best hypothesis, its rival, and half the difference of their scores."""
_SAME_START_PX = 2.0
"""A start this near to a known fit, in all places, leads to it."""
_DOUBTFUL_SIGMAS = 1.3
"""Excess of χ² in its standard deviations from which a fit is doubted: one good fit in ten."""
_NEAR, _FARTHER = (1, 1), (4, 2)
"""Steps of the direct place to either side of a fit, and how many are a fringe; the second where the fit is doubted."""
_NEAR_RIVAL = 12.0
"""Excess of a rival's score up to which it is looked at as closely as the best."""
_NEGLIGIBLE = 1e-3
"""Weight over that of the best from which a hypothesis says nothing about σ."""


@compiled  # pragma: no cover
def joint_block(
    za: NDArray[np.complex64], zb: NDArray[np.complex64], sigma_a: Reals, sigma_b: Reals, gain_a: Reals, gain_b: Reals,
    comb: Reals, low_a: float, high_a: float, low_b: float, high_b: float, seeds: Reals, lines: Reals, bounds: Reals,
    prior: Reals, larger_is_direct: float, distance_a: Reals, table_a: Reals, length_a: Reals, taken_a: Reals,
    distance_b: Reals, table_b: Reals, length_b: Reals, taken_b: Reals, near_a: Reals, near_b: Reals, near_x: Reals,
    power_a: Reals, power_b: Reals, near_row: Reals, posterior_a: Reals, posterior_b: Reals, out: Floats, start: int,
) -> None:  # fmt: skip
    """The likeliest direct path of the pixels from ``start`` on, and its rival, as rows of ``out``.

    ``seeds``, ``lines``, ``bounds`` as `scanner.paths.joint_seeds.seed_block` leaves them; the arrays after
    ``larger_is_direct`` are `Profiles.arrays` of both axes and `workspace` of `scanner.paths.joint_nearby`.
    """
    count_a, count_b, most = za.shape[0], zb.shape[0], bounds.shape[1]
    room = most + 3 * NEARBY
    dof = 2 * (count_a + count_b) - 5
    doubtful = dof + _DOUBTFUL_SIGMAS * math.sqrt(2.0 * dof)
    ya, yb = np.empty(count_a, np.complex128), np.empty(count_b, np.complex128)
    wa, wb = np.empty((4, count_a)), np.empty((4, count_b))
    thetas, steps = np.empty((room, 8)), np.empty((room, 8))
    priors, gradients = np.empty((room, 7)), np.empty((room, 8))
    chi2s, scores, promised, normals = np.empty(room), np.empty(room), np.empty(room), np.zeros((room, 8, 8))
    weights, of_place, sigmas, found = np.empty(room), np.empty(room), np.zeros((room, 8)), np.empty((NEARBY, 9))
    factor, step, nothing, anywhere, unit = np.zeros((8, 8)), np.empty(8), np.zeros(8), np.zeros(8), np.empty(8)
    for k in (0, 1, 4, 5):
        # No place is less known than anywhere in the picture.
        anywhere[k] = 12 / (high_a - low_a if k < 4 else high_b - low_b) ** 2
    mixture = np.empty((max(room, len(posterior_a)), 3))
    trial, normal2, slope2 = np.empty(8), np.zeros((8, 8)), np.empty(8)
    for n in range(bounds.shape[0]):
        p = start + n
        load(za, gain_a, sigma_a[p], p, comb[0], comb[1], ya, wa)
        load(zb, gain_b, sigma_b[p], p, comb[2], comb[3], yb, wb)
        tried, least = 0, math.inf
        for h in range(most):
            if not bounds[n, h] < math.inf:
                break
            if bounds[n, h] > least + HOPELESS_CHI2:
                continue
            for k in range(8):
                thetas[tried, k] = seeds[n, h, k]
            set_line(priors[tried], prior, lines[n, h, 0], lines[n, h, 1], lines[n, h, 2])
            if propose(
                ya, wa, yb, wb, comb, thetas, priors, normals, gradients, chi2s, promised, steps, scores, factor, step,
                nothing, tried, least,
            ):  # fmt: skip
                least = min(least, promised[tried])
                tried += 1
        least = refine(
            ya, wa, yb, wb, comb, thetas, priors, normals, gradients, chi2s, promised, steps, scores, factor, step,
            trial, normal2, slope2, nothing, unit, anywhere, low_a, high_a, low_b, high_b, larger_is_direct, 0, tried,
            math.inf,
        )  # fmt: skip
        if tried == 0:
            continue
        best = int(scores[:tried].argmin())
        if not scores[best] < math.inf:
            continue
        # Whether there is another bounce that fits about as well, or another fringe order.
        other, known_a, known_b = -1, 0, 0
        for turn in range(3):
            about = other if turn == 1 else best
            if turn == 1 and (other < 0 or scores[other] > scores[best] + _NEAR_RIVAL):
                continue
            # Where even the best fits badly, what fits better may lie farther off.
            if turn == 2 and not chi2s[best] > doubtful:
                break
            reach, per_fringe = _FARTHER if turn == 2 else _NEAR
            starts, known_a, known_b = nearby(
                ya, yb, gain_a, gain_b, sigma_a[p], sigma_b[p], comb, thetas[about], chi2s[about], prior, distance_a,
                table_a, length_a, taken_a, distance_b, table_b, length_b, taken_b, near_a, near_b, near_x, power_a,
                power_b, near_row, posterior_a, posterior_b, known_a, known_b, found, reach, per_fringe,
            )  # fmt: skip
            first = tried
            for j in range(starts):
                for k in range(8):
                    thetas[tried, k] = found[j, k]
                for k in range(7):
                    priors[tried, k] = priors[about, k]
                for k in range(8):
                    steps[tried, k] = 0.0
                if leads_to_known(thetas, steps[tried], scores, tried, first, _SAME_START_PX):
                    continue
                if propose(
                    ya, wa, yb, wb, comb, thetas, priors, normals, gradients, chi2s, promised, steps, scores, factor,
                    step, nothing, tried, least,
                ):  # fmt: skip
                    tried += 1
            least = refine(
                ya, wa, yb, wb, comb, thetas, priors, normals, gradients, chi2s, promised, steps, scores, factor, step,
                trial, normal2, slope2, nothing, unit, anywhere, low_a, high_a, low_b, high_b, larger_is_direct, first,
                tried, least,
            )  # fmt: skip
            best = int(scores[:tried].argmin())
            other = rival(thetas, scores, best, tried)
        for h in range(tried):
            weights[h] = math.exp(0.5 * (scores[best] - scores[h]))
        here = elsewhere = 0.0
        for h in range(tried):
            if apart(thetas, h, best):
                elsewhere += weights[h]
            else:
                here += weights[h]
        out[2 * FIELDS, p] = math.log(here / elsewhere) if elsewhere > 0 else math.inf
        for h, row in ((best, 0), (other, FIELDS)):
            if h < 0:
                continue
            others = 0.0
            for i in range(tried):
                of_place[i] = 0.0
                if weights[i] > _NEGLIGIBLE * weights[h] and not apart(thetas, i, h):
                    of_place[i] = weights[i]
                    others += weights[i] if i != h else 0.0
            alone = others < 0.5 * OUTSIDE * weights[h]
            for i in range(tried):
                if i == h or (of_place[i] > 0 and not alone):
                    factorise(normals[i], 1e-9, nothing, factor)
                    for k in range(8):
                        for j in range(8):
                            unit[j] = 1.0 if j == k else 0.0
                        sigmas[i, k] = math.sqrt(variance(factor, unit, k, step))
            for k in range(8):
                out[row + k, p] = thetas[h, k]
                sigma = sigmas[h, k]
                if not alone:
                    parts = 0
                    for i in range(tried):
                        if of_place[i] > 0:
                            mixture[parts, 0] = of_place[i]
                            mixture[parts, 1], mixture[parts, 2] = thetas[i, k], sigmas[i, k]
                            parts += 1
                    sigma = widened(mixture, parts, thetas[h, k], sigma)
                if k == 0:
                    sigma = max(sigma, by_bounce(posterior_a, known_a, thetas[h, 0], sigmas[h, 0], mixture))
                elif k == 4:
                    sigma = max(sigma, by_bounce(posterior_b, known_b, thetas[h, 4], sigmas[h, 4], mixture))
                out[row + 8 + k, p] = sigma
            out[row + 16, p] = chi2s[h]
