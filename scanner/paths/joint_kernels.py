"""The choice between the hypotheses of both axes together; see `scanner.paths.joint`.

One axis, *along*, is that which the epipolar line runs along; the other is *across*.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from scanner.paths.folding import COLUMNS, fold
from scanner.paths.joint_fit import Phasors, Reals, set_line
from scanner.paths.joint_hypotheses import HOPELESS_CHI2, apart, leads_to_known, propose, refine, rival
from scanner.paths.joint_nearby import NEARBY, Profile, Workspace, nearby
from scanner.paths.joint_spread import OUTSIDE, by_bounce, widened
from scanner.paths.rotation import compiled

Floats = NDArray[np.float32]
FitWorkspace = tuple[
    Phasors, Phasors, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals, Reals,
    Reals, Reals, Reals,
]  # fmt: skip

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


def fit_workspace(count_a: int, count_b: int, most: int, near: Workspace) -> FitWorkspace:
    """Arrays that `joint_block` works in, of so many frequencies along and across and hypotheses; one set a thread."""
    room = most + 3 * NEARBY
    return (
        np.empty(count_a, np.complex128),
        np.empty(count_b, np.complex128),
        np.empty((count_a // 2 + 2, COLUMNS)),
        np.empty((count_b // 2 + 2, COLUMNS)),
        np.empty((room, 8)),
        np.empty((room, 8)),
        np.empty((room, 8)),
        np.empty((room, 7)),
        np.zeros((room, 8, 4)),
        np.empty(room),
        np.empty(room),
        np.empty(room),
        np.empty(room),
        np.empty(8),
        np.zeros((8, 4)),
        np.empty(room),
        np.empty(room),
        np.empty((NEARBY, 9)),
        np.empty((max(room, len(near[8])), 3)),
    )


@compiled  # pragma: no cover
def joint_block(
    za: NDArray[np.complex64], zb: NDArray[np.complex64], sigma_a: Reals, sigma_b: Reals, gain_a: Reals, gain_b: Reals,
    comb: Reals, low_a: float, high_a: float, low_b: float, high_b: float, numbers: NDArray[np.intp],
    seeds: Reals, lines: Reals, bounds: Reals, prior: Reals, larger_is_direct: float, profile_a: Profile,
    profile_b: Profile, near: Workspace, work: FitWorkspace, undecided_if: tuple[float, float, float], out: Floats,
) -> None:  # fmt: skip
    """The likeliest direct path of the pixels ``numbers`` (n,), and its rival, as rows of ``out``.

    ``seeds``, ``lines``, ``bounds`` as `scanner.paths.joint_seeds.seed_block` leaves them; the profiles are
    `Profiles.arrays` of both axes, ``near`` is `workspace` of `scanner.paths.joint_nearby`, ``work`` is
    `fit_workspace`. A pixel stays without a result where half the lead of its best hypothesis' score over a rival's is
    below the first of ``undecided_if``, its χ² above the second, or the distance of its paths along below the third.
    """
    posterior_a, posterior_b = near[8], near[9]
    least_lead, most_chi2, least_apart = undecided_if
    count_a, count_b, most = za.shape[0], zb.shape[0], bounds.shape[1]
    dof = 2 * (count_a + count_b) - 5
    doubtful = dof + _DOUBTFUL_SIGMAS * math.sqrt(2.0 * dof)
    (
        ya, yb, folded_a, folded_b, thetas, steps, variances, priors, systems, chi2s, gains, promised, scores, trial,
        spare, weights, of_place, found, mixture,
    ) = work  # fmt: skip
    for n in range(numbers.size):
        p = numbers[n]
        out[:, p] = math.nan
        for t in range(count_a):
            ya[t] = (1 / gain_a[t]) * za[t, p]
        for t in range(count_b):
            yb[t] = (1 / gain_b[t]) * zb[t, p]
        fold(ya, gain_a, sigma_a[p], comb[0], comb[1], folded_a)
        fold(yb, gain_b, sigma_b[p], comb[2], comb[3], folded_b)
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
                folded_a, folded_b, thetas, priors, systems, chi2s, gains, promised, steps, scores, tried, least,
            ):  # fmt: skip
                least = min(least, promised[tried])
                tried += 1
        least = refine(
            folded_a, folded_b, thetas, priors, systems, chi2s, gains, promised, steps, scores, variances, trial, spare,
            low_a, high_a, low_b, high_b, larger_is_direct, 0, tried, math.inf,
        )  # fmt: skip
        if tried == 0:
            continue
        best = int(scores[:tried].argmin())
        if not scores[best] < math.inf:
            continue
        other = rival(thetas, scores, best, tried)
        if other >= 0 and 0.5 * (scores[other] - scores[best]) < least_lead:
            continue
        if chi2s[best] > most_chi2 or abs(thetas[best, 0] - thetas[best, 1]) < least_apart:
            continue
        # Whether there is another bounce that fits about as well, or another fringe order.
        known_a = known_b = 0
        for turn in range(3):
            about = other if turn == 1 else best
            if turn == 1 and (other < 0 or scores[other] > scores[best] + _NEAR_RIVAL):
                continue
            # Where even the best fits badly, what fits better may lie farther off.
            if turn == 2 and not chi2s[best] > doubtful:
                break
            reach, per_fringe = _FARTHER if turn == 2 else _NEAR
            starts, known_a, known_b = nearby(
                ya, yb, gain_a, gain_b, sigma_a[p], sigma_b[p], comb, thetas[about], chi2s[about], prior, profile_a,
                profile_b, near, known_a, known_b, found, reach, per_fringe,
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
                    folded_a, folded_b, thetas, priors, systems, chi2s, gains, promised, steps, scores, tried, least,
                ):  # fmt: skip
                    tried += 1
            least = refine(
                folded_a, folded_b, thetas, priors, systems, chi2s, gains, promised, steps, scores, variances, trial,
                spare, low_a, high_a, low_b, high_b, larger_is_direct, first, tried, least,
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
            for k in range(8):
                out[row + k, p] = thetas[h, k]
                sigma = own = math.sqrt(variances[h, k])
                if not alone:
                    parts = 0
                    for i in range(tried):
                        if of_place[i] > 0:
                            mixture[parts, 0] = of_place[i]
                            mixture[parts, 1], mixture[parts, 2] = thetas[i, k], math.sqrt(variances[i, k])
                            parts += 1
                    sigma = widened(mixture, parts, thetas[h, k], sigma)
                if k == 0:
                    sigma = max(sigma, by_bounce(posterior_a, known_a, thetas[h, 0], own, mixture))
                elif k == 4:
                    sigma = max(sigma, by_bounce(posterior_b, known_b, thetas[h, 4], own, mixture))
                out[row + 8 + k, p] = sigma
            out[row + 16, p] = chi2s[h]
