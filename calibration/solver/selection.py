"""Which distortion terms a lens needs, by information instead of habit.

Greedy forward selection over nested sets from none by the Bayesian information criterion BIC = χ² + k ln n (Schwarz,
Ann. Statist. 6, 461 (1978)) with the robust χ². Candidates are ranked by the score test, which needs no adjustment of
its own (Rao, 1948); what is taken is adjusted and has to keep its promise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.solver.adjustment import Adjusted, adjusted, normals, solved
from calibration.solver.measurements import Measurements
from calibration.solver.parameters import GROUPS, Freedom, State, lens_names

Array = NDArray[np.float64]

_NEEDS = {"k2": "k1", "k3": "k2", "rational": "k2"}


@dataclass(frozen=True)
class Terms:
    """Distortion terms of both lenses, as names of `calibration.solver.parameters.GROUPS`."""

    camera: tuple[str, ...] = ()
    projector: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        unknown = [group for group in (*self.camera, *self.projector) if group not in GROUPS]
        if unknown:
            raise ValueError(f"unknown distortion terms {', '.join(unknown)}; there are {', '.join(GROUPS)}")

    def of(self, lens: str) -> tuple[str, ...]:
        """Those of "camera" or "projector"."""
        return self.camera if lens == "camera" else self.projector

    def plus(self, lens: str, group: str) -> Terms:
        """With one more."""
        if lens == "camera":
            return Terms((*self.camera, group), self.projector)
        return Terms(self.camera, (*self.projector, group))

    def names(self) -> list[str]:
        """Names of the parameters."""
        return lens_names("camera", self.camera) + lens_names("projector", self.projector)


@dataclass(frozen=True)
class Trial:
    """One line of the table of a selection.

    Parameters
    ----------
    lens, group
        What was tried on top of the terms taken so far.
    chi2_drop
        By how much it lowers the robust χ², in units of the scaled σ.
    bic_change
        χ² change + k ln n; negative is better.
    taken
        Whether it was kept.
    """

    lens: str
    group: str
    chi2_drop: float
    bic_change: float
    taken: bool


def selected(
    start: State, data: Measurements, free: Callable[[Terms], Freedom], candidates: Terms
) -> tuple[Terms, Adjusted, tuple[Trial, ...]]:
    """Choose among ``candidates``.

    Parameters
    ----------
    start
        First estimate, without distortion.
    data
        The observations.
    free
        The free parameters of a model with given terms.
    candidates
        All terms that may be taken.

    Returns
    -------
    The terms, the adjustment with them, and the table of trials.
    """
    # The scale of σ comes from the richest model: a poor one would call its own misfit noise.
    scales = adjusted(start, data, free(candidates)).scales
    terms = Terms()
    fit = adjusted(start, data, free(terms), scales)
    penalty = float(np.log(np.count_nonzero(data.known)))
    table: list[Trial] = []
    while True:
        open_ = _open(terms, candidates)
        drops = _scores(fit, data, free, terms, open_, scales)
        gains = [len(GROUPS[group]) * penalty - drop for (_, group), drop in zip(open_, drops, strict=True)]
        if not open_ or min(gains) >= 0:
            table += [
                Trial(lens, group, drop, gain, False)
                for (lens, group), drop, gain in zip(open_, drops, gains, strict=True)
            ]
            break
        best = int(np.argmin(gains))
        lens, group = open_[best]
        trial = adjusted(fit.state, data, free(terms.plus(lens, group)), scales)
        drop = fit.cost - trial.cost
        change = len(GROUPS[group]) * penalty - drop
        table.append(Trial(lens, group, drop, change, change < 0))
        if change >= 0:
            break
        terms, fit = terms.plus(lens, group), trial
    fit = adjusted(fit.state, data, free(terms))
    return terms, replace(fit, covariance=_with_omitted(fit, data, free, terms, _open(terms, candidates))), tuple(table)


def _open(terms: Terms, candidates: Terms) -> list[tuple[str, str]]:
    return [
        (lens, group)
        for lens in ("camera", "projector")
        for group in candidates.of(lens)
        if group not in terms.of(lens) and _NEEDS.get(group, "") in ("", *terms.of(lens))
    ]


def _with_omitted(
    fit: Adjusted, data: Measurements, free: Callable[[Terms], Freedom], terms: Terms, open_: Sequence[tuple[str, str]]
) -> Array:
    """Mean squared error (q, q) of the parameters, with what leaving out the next terms may do to them.

    A term that information rejects is not zero, only too small to be seen: by up to 2.7 of its σ. What it would be,
    a ± σ_a, moves the others by B a, so that B (a aᵀ + cov a) Bᵀ adds to their covariance; without it intervals of a
    chosen model are too narrow (Burnham & Anderson, Model Selection and Multimodel Inference, 2002, §4.3).
    """
    if not open_:
        return fit.covariance
    freedom = free(_all_of(terms, open_))
    system, _, _ = normals(fit.state, data, freedom, fit.scales)
    information, gradient = system.reduced()
    known = set(free(terms).names)
    own = [freedom.names.index(name) for name in free(terms).names]
    rest = [i for i, name in enumerate(freedom.names) if name not in known]
    to_own = solved(information[np.ix_(own, own)], information[np.ix_(own, rest)])
    schur = information[np.ix_(rest, rest)] - information[np.ix_(rest, own)] @ to_own
    omitted_covariance = solved(schur, np.eye(len(rest)))
    omitted = omitted_covariance @ (gradient[rest] - to_own.T @ gradient[own])
    return np.asarray(fit.covariance + to_own @ (omitted_covariance + np.outer(omitted, omitted)) @ to_own.T)


def _all_of(terms: Terms, more: Sequence[tuple[str, str]]) -> Terms:
    for lens, group in more:
        terms = terms.plus(lens, group)
    return terms


def _scores(
    fit: Adjusted,
    data: Measurements,
    free: Callable[[Terms], Freedom],
    terms: Terms,
    open_: Sequence[tuple[str, str]],
    scales: Array,
) -> list[float]:
    """By how much χ² would drop with every candidate, to second order."""
    freedom = free(_all_of(terms, open_))
    system, _, _ = normals(fit.state, data, freedom, scales)
    information, gradient = system.reduced()
    base = [i for i, name in enumerate(freedom.names) if name in set(free(terms).names)]
    drops = []
    for lens, group in open_:
        chosen = base + [freedom.names.index(name) for name in lens_names(lens, (group,))]
        block = information[np.ix_(chosen, chosen)]
        scale = 1 / np.sqrt(np.diag(block))
        g = gradient[chosen] * scale
        drops.append(float(g @ np.linalg.solve(block * scale[:, None] * scale, g)))
    return drops
