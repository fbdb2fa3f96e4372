"""The search for the plan that reaches most within a frame budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanner.design.bounds import contrast, least_bounce, wrong_order_probability
from scanner.design.demand import Demand, DesignError
from scanner.design.designed import DesignedPlan, judge
from scanner.patterns import Axis

_LEAST_FREQUENCIES = 5
"""Two-path separation needs so many (`scanner.paths`)."""

_LEAST_FREE = 4
"""Fewer frequencies leave fewer than 6 degrees of freedom: many Δu then fit one path by chance."""


def design(demand: Demand) -> DesignedPlan:
    """Choose the plan with the least product of coordinate error and least bounce.

    Every number of steps is tried with the numbers of frequencies that use the budget up. Equidistant
    frequencies are tried all; free ones are improved one by one from several starts until none improves.

    Raises
    ------
    DesignError
        The budget, the periods or the noise leave no plan.
    """
    _check(demand)
    axes = demand.axes
    candidates = {axis: _Candidates(demand, axis) for axis in axes}
    least = _LEAST_FREQUENCIES if demand.separable else _LEAST_FREE
    best: DesignedPlan | None = None
    for steps in range(demand.steps[0], demand.steps[1] + 1):
        most = demand.frames // (steps * len(axes))
        for count in range(max(least, most - 1), most + 1):
            dof = len(axes) * (2 * count - 2)
            chosen = {axis: _choose(candidates[axis], count, steps, dof) for axis in axes}
            if any(c is None for c in chosen.values()):
                continue
            candidate = judge({a: c for a, c in chosen.items() if c is not None}, steps, demand)
            if best is None or _cost(candidate) < _cost(best):
                best = candidate
    if best is None:
        raise DesignError(
            f"no plan of {demand.frames} frames has fringes of {demand.shortest_px:g} to {demand.longest_px:g} px "
            f"whose orders are told with an error rate of {demand.wrong_orders:g} at σ/B = {demand.relative_noise:g}",
            f"Allow more frames (at least {least * demand.steps[0] * len(axes)}), a wider range of periods, or more "
            "wrong orders.",
        )
    return best


def trade(demand: Demand, budgets: Sequence[int]) -> list[DesignedPlan]:
    """Design for several frame budgets; those that leave no plan are left out."""
    plans = []
    for frames in budgets:
        try:
            plans.append(design(replace(demand, frames=frames)))
        except DesignError:
            continue
    return plans


def _check(demand: Demand) -> None:
    for axis in demand.axes:
        if not 0 < demand.from_px < demand.to_px <= demand.extent(axis) or not demand.orders(axis).size:
            raise DesignError(
                f"Δu from {demand.from_px:g} to {demand.to_px:g} px with periods of {demand.shortest_px:g} to "
                f"{demand.longest_px:g} px along {axis} of {demand.extent(axis)} px",
                "Both ranges must ascend and lie within the projector.",
            )
    if demand.steps[0] < 3 or demand.steps[0] > demand.steps[1]:
        raise DesignError(f"{demand.steps[0]} to {demand.steps[1]} phase steps", "Give a range from 3 on.")


def _cost(plan: DesignedPlan) -> float:
    return sum(b.cost for b in plan.bounds.values())


class _Candidates:
    """All fringes that one axis may have, with what each adds to the sums of the bounds."""

    def __init__(self, demand: Demand, axis: Axis) -> None:
        self.demand, self.extent, self.orders = demand, demand.extent(axis), demand.orders(axis)
        f = self.orders / self.extent
        self.weight = np.square(contrast(f, demand.blur_px))
        self.information = self.weight * f**2
        angle = 2 * np.pi * np.outer(f, demand.deltas(axis))
        self.along_amplitude = self.weight[:, None] * np.cos(angle)
        self.along_coordinate = (self.weight * f)[:, None] * np.sin(angle)

    def frequencies(self, chosen: NDArray[np.intp]) -> tuple[float, ...]:
        """1/px of the candidates ``chosen``."""
        return tuple(float(n) / self.extent for n in self.orders[chosen])

    def cost(self, chosen: NDArray[np.intp], steps: int, dof: int) -> float:
        """`AxisBounds.cost` of the candidates ``chosen``, up to a constant."""
        power, information = self.weight[chosen].sum(), self.information[chosen].sum()
        left = power - self.along_amplitude[chosen].sum(axis=0) ** 2 / power
        left -= self.along_coordinate[chosen].sum(axis=0) ** 2 / information
        least = np.log(least_bounce(left * steps / 2, self.demand, dof))
        return float(0.5 * (least.max() + least.mean()) - 0.5 * math.log(steps * information))

    def told(self, chosen: NDArray[np.intp], steps: int) -> bool:
        """Whether noise leaves the fringe orders alone."""
        d = self.demand
        f = np.array(self.frequencies(chosen))
        return wrong_order_probability(f, steps, d.relative_noise, self.extent, d.blur_px) <= d.wrong_orders


def _choose(candidates: _Candidates, count: int, steps: int, dof: int) -> tuple[float, ...] | None:
    """Best frequencies of one axis among those whose orders can be told; None where there are none."""
    many = len(candidates.orders)
    if many < count:
        return None
    combs = [np.arange(i, i + count) for i in range(many - count + 1)]
    if candidates.demand.separable:
        tried = combs
    else:
        rng = np.random.default_rng(count)
        starts = [np.linspace(0, many - 1, count).astype(np.intp)]
        starts += [np.sort(rng.choice(many, count, replace=False)) for _ in range(2)]
        tried = [_exchanged(s, many, lambda c: candidates.cost(c, steps, dof)) for s in starts] + combs
    ranked = sorted(tried, key=lambda c: candidates.cost(c, steps, dof))
    return next((candidates.frequencies(c) for c in ranked if candidates.told(c, steps)), None)


def _exchanged(start: NDArray[np.intp], many: int, cost: Callable[[NDArray[np.intp]], float]) -> NDArray[np.intp]:
    """Exchange one candidate at a time while it helps (Meyer and Nachtsheim, Technometrics 37, 60 (1995))."""
    best, lowest = start, cost(start)
    improved = True
    while improved:
        improved = False
        for slot in range(len(best)):
            others = np.delete(best, slot)
            for number in np.setdiff1d(np.arange(many), best):
                tried = np.append(others, number)
                value = cost(tried)
                if value < lowest - 1e-9:
                    best, lowest, improved = tried, value, True
    return np.sort(best)
