"""Hypotheses of both axes together: which are worth a refinement, and how likely each is; see `scanner.paths.joint`.

Numba's cache of `joint_block` does not see this file: `make` compiles it anew.
"""

from __future__ import annotations

import math

from scanner.paths.joint_fit import Reals, covariance, improve, normal_equations, solve
from scanner.paths.rotation import compiled

HOPELESS_CHI2 = 16.0
"""Excess over the best hypothesis from which one is hopeless."""
_STEPS = 14
"""Levenberg-Marquardt steps at most; two or three are usual."""
_VISIBLE_SIGMAS = 5.0
"""A direct path that is weaker than this is none."""
SAME_PX = 0.5
"""Direct places nearer than this are one place, whatever the bounce is."""
SAME_FIT_PX = 0.25
"""A hypothesis whose first step leads this near to a fit that is known, in all places, leads to that fit."""
_TINY = 1e-300


@compiled  # pragma: no cover
def leads_to_known(thetas: Reals, step: Reals, scores: Reals, h: int, count: int, near: float) -> bool:
    """Whether the first step of the hypothesis ``h`` ends at one of those that have a score already."""
    for other in range(count):
        away = 0.0 if scores[other] < math.inf else math.inf
        for k in (0, 1, 4, 5):
            away = max(away, abs(thetas[other, k] - thetas[h, k] - step[k]))
        if away < near:
            return True
    return False


@compiled  # pragma: no cover
def propose(
    along: Reals, across: Reals, thetas: Reals, priors: Reals, systems: Reals, chi2s: Reals, gains: Reals,
    promised: Reals, steps: Reals, scores: Reals, h: int, least: float,
) -> bool:  # fmt: skip
    """Take the first normal equations of the hypothesis ``h``; False where what they promise is hopeless."""
    chi2s[h] = normal_equations(along, across, priors[h], thetas[h], systems[h])
    gains[h] = solve(systems[h], 0.0, steps[h])
    promised[h] = chi2s[h] - gains[h]
    if gains[h] < 0 or not promised[h] < least + HOPELESS_CHI2:
        return False
    scores[h] = math.inf
    return True


@compiled  # pragma: no cover
def refine(
    along: Reals, across: Reals, thetas: Reals, priors: Reals, systems: Reals, chi2s: Reals, gains: Reals,
    promised: Reals, steps: Reals, scores: Reals, variances: Reals, trial: Reals, spare: Reals, low_a: float,
    high_a: float, low_b: float, high_b: float, larger_is_direct: float, first: int, count: int, least: float,
) -> float:  # fmt: skip
    """Refine the hypotheses first..count that are not hopeless and give them scores; returns the least χ².

    The most promising first: what it reaches shows which of the others are hopeless, and which lead to it.
    """
    # No place is less known than anywhere in the picture.
    place_a, place_b = 12 / (high_a - low_a) ** 2, 12 / (high_b - low_b) ** 2
    for _ in range(first, count):
        h = first + int(promised[first:count].argmin())
        if not promised[h] < least + HOPELESS_CHI2:
            break
        promised[h] = math.inf
        theta = thetas[h]
        if leads_to_known(thetas, steps[h], scores, h, count, SAME_FIT_PX):
            continue
        chi2s[h] = improve(
            along, across, priors[h], theta, chi2s[h], gains[h], steps[h], systems[h], trial, spare, _STEPS,
        )  # fmt: skip
        least = min(least, chi2s[h])
        if not chi2s[h] < least + HOPELESS_CHI2:
            continue
        if not (low_a <= theta[0] < high_a and low_b <= theta[4] < high_b):
            continue
        determinant, mutual = covariance(systems[h], place_a, place_b, variances[h])
        if not (determinant > 0 and theta[2] > _VISIBLE_SIGMAS * math.sqrt(variances[h, 2])):
            continue
        # Evidence by Laplace's method, with a scale-free prior on the amplitudes.
        score = chi2s[h] + 2 * math.log(theta[2] + theta[3]) - math.log(determinant)
        lead = (theta[2] - theta[3]) / math.sqrt(max(variances[h, 2] + variances[h, 3] - 2 * mutual, _TINY))
        sure = 0.5 * math.erfc(-lead / math.sqrt(2.0))
        score -= 2 * math.log(larger_is_direct * sure + (1 - larger_is_direct) * (1 - sure))
        # A fit that is reached a second time is not twice as likely.
        for other in range(count):
            away = 0.0 if other != h and scores[other] < math.inf else math.inf
            for k in (0, 1, 4, 5):
                away = max(away, abs(thetas[other, k] - theta[k]))
            if away < SAME_FIT_PX:
                score, scores[other] = min(score, scores[other]), math.inf
        scores[h] = score
    return least


@compiled  # pragma: no cover
def apart(thetas: Reals, one: int, other: int) -> bool:
    """Whether the direct places of two hypotheses are two."""
    return bool(max(abs(thetas[one, 0] - thetas[other, 0]), abs(thetas[one, 4] - thetas[other, 4])) > SAME_PX)


@compiled  # pragma: no cover
def rival(thetas: Reals, scores: Reals, best: int, count: int) -> int:
    """The likeliest hypothesis with another direct place than ``best``; -1 where there is none."""
    found = -1
    for h in range(count):
        if scores[h] < math.inf and apart(thetas, h, best) and (found < 0 or scores[h] < scores[found]):
            found = h
    return found
