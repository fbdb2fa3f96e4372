"""Which frequencies, how many steps? A plan of a frame budget, chosen by what it can reach at best.

A plan of frequencies f_t with N steps each is judged by three bounds, all for a pixel of modulation B and frames of
noise σ, with m_t the contrast that projector and lens leave at f_t:

* *coordinate*: Cramér-Rao, σ_u = √(2/N) (σ/B) / (2π √Σ m_t² f_t²) (method.md §1; Kay, *Estimation Theory*, §3.4);
* *fringe order*: the probability that noise lifts a side lobe of the likelihood above the true place, summed over the
  side lobes (union bound);
* *detection*: a bounce of amplitude ratio α at Δu leaves ``α m_t e^{i2πf_t Δu}`` less what the one-path fit takes of it
  (to first order: amplitude and coordinate). Over the noise its square is the noncentrality of the fit's χ², and gives
  the power at a false-alarm rate (Kay, *Detection Theory*, §2.2.3). Since it grows with α², one figure says all: the
  *least bounce* α₅₀(Δu), found every other time.

The bounce is taken to be displaced along one axis only, which is the harder case; χ² of all axes is tested.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import ncx2, norm

from drivers.errors import OperatorError
from scanner.patterns import Axis, Plan, phase_steps

Floats = NDArray[np.float64]

_LEAST_FREQUENCIES = 5
"""Two-path separation needs so many (`scanner.paths`)."""

_LEAST_FREE = 4
"""Fewer frequencies leave fewer than 6 degrees of freedom: many Δu then fit one path by chance."""

_DELTA_STEP_PX = 1.0
"""Steps of Δu; the residual's size changes within a fringe."""

_LAG_STEP_PX = 0.5
"""Steps in the search for side lobes, a fraction of a fringe."""


class DesignError(OperatorError):
    """No plan meets the demand."""


@dataclass(frozen=True)
class Demand:
    """What a plan is wanted for.

    Parameters
    ----------
    size
        Projector (width, height), px.
    frames
        Frames of one round, all axes together, at most.
    from_px, to_px
        Range of Δu, the distance on the projector between the two paths of a pixel, that matters.
    relative_noise
        σ/B: noise of a frame over the fringe modulation.
    false_alarm_rate
        Of the detection.
    axes
        To measure.
    steps
        Least and most phase steps N; from 4 on a stale frame shows.
    shortest_px, longest_px
        Range of the periods: the shortest that projector and camera resolve, the longest for which diffuse bounces
        average out.
    blur_px
        Standard deviation of projector and camera blur together, projector px.
    wrong_orders
        Probability of a wrong fringe order at most.
    separable
        Whether two paths must be separable from this round alone, which MFS asks for: equidistant frequencies whose
        spacing is unambiguous over the projector. Otherwise any frequencies are allowed.
    """

    size: tuple[int, int] = (1280, 800)
    frames: int = 108
    from_px: float = 16
    to_px: float = 600
    relative_noise: float = 0.05
    false_alarm_rate: float = 0.01
    axes: tuple[Axis, ...] = ("x", "y")
    steps: tuple[int, int] = (4, 12)
    shortest_px: float = 12
    longest_px: float = 20
    blur_px: float = 1.0
    wrong_orders: float = 1e-3
    separable: bool = True

    def extent(self, axis: Axis) -> int:
        """Projector pixels along ``axis``."""
        return self.size[0] if axis == "x" else self.size[1]

    def orders(self, axis: Axis) -> NDArray[np.int64]:
        """Fringes over the whole picture, those that the range of periods allows."""
        extent = self.extent(axis)
        return np.arange(math.ceil(extent / self.longest_px - 1e-9), math.floor(extent / self.shortest_px + 1e-9) + 1)


@dataclass(frozen=True)
class AxisBounds:
    """What the fringes of one axis can reach.

    Parameters
    ----------
    sigma_px
        Least standard deviation of a coordinate, px.
    wrong_orders
        Probability of a wrong fringe order.
    delta_px, least_bounce
        (n,) Δu and the amplitude ratio α₅₀ that is detected there every other time.
    """

    sigma_px: float
    wrong_orders: float
    delta_px: Floats
    least_bounce: Floats

    @property
    def worst_bounce(self) -> float:
        """α₅₀ at the worst Δu."""
        return float(self.least_bounce.max())

    @property
    def typical_bounce(self) -> float:
        """α₅₀, geometric mean over Δu."""
        return float(np.exp(np.log(self.least_bounce).mean()))

    @property
    def cost(self) -> float:
        """Coordinate error and least bounce (half its mean, half its worst), as the logarithm of their product."""
        return math.log(self.sigma_px) + 0.5 * (math.log(self.worst_bounce) + math.log(self.typical_bounce))


@dataclass(frozen=True)
class DesignedPlan:
    """Frequencies by axis (1/px), the steps of each, and what they reach."""

    demand: Demand
    steps: int
    frequencies: dict[Axis, tuple[float, ...]]
    bounds: dict[Axis, AxisBounds]

    @property
    def frame_count(self) -> int:
        """Frames of one round."""
        return self.steps * sum(len(f) for f in self.frequencies.values())

    @property
    def sigma_px(self) -> float:
        """Coordinate bound of the worse axis, px."""
        return max(b.sigma_px for b in self.bounds.values())

    @property
    def worst_bounce(self) -> float:
        """α₅₀ at the worst Δu of the worse axis."""
        return max(b.worst_bounce for b in self.bounds.values())

    @property
    def typical_bounce(self) -> float:
        """α₅₀, geometric mean over Δu, of the worse axis."""
        return max(b.typical_bounce for b in self.bounds.values())

    @property
    def wrong_orders(self) -> float:
        """Probability of a wrong order on the worse axis."""
        return max(b.wrong_orders for b in self.bounds.values())

    def power(self, alpha: float) -> tuple[float, float]:
        """Share of bounces of amplitude ratio ``alpha`` that are detected: mean over Δu and axes, and worst."""
        dof = sum(2 * len(f) - 2 for f in self.frequencies.values())
        rate = self.demand.false_alarm_rate
        least = np.concatenate([b.least_bounce for b in self.bounds.values()])
        found = detection_power(even_noncentrality(dof, rate) * (alpha / least) ** 2, dof, rate)
        return float(found.mean()), float(found.min())

    def plan(self) -> Plan:
        """Make the plan of one round."""
        return Plan(
            self.demand.size,
            tuple(phase_steps(a, f, self.steps) for a, fs in self.frequencies.items() for f in fs),
        )

    def yaml(self) -> str:
        """Lines for the ``scan:`` section of a bench file."""
        lines = [f"  axes: [{', '.join(self.frequencies)}]", f"  steps: {self.steps}", "  frequencies_per_px:"]
        for axis, values in self.frequencies.items():
            extent = self.demand.extent(axis)
            lines.append(f"    {axis}: [{', '.join(f'{round(f * extent)}/{extent}' for f in values)}]")
        return "\n".join(lines)


def contrast(frequencies: Floats, blur_px: float) -> Floats:
    """(T,) m_t that a Gaussian blur leaves of fringes."""
    return np.asarray(np.exp(-2 * (np.pi * frequencies * blur_px) ** 2))


def coordinate_bound(frequencies: Floats, steps: int, relative_noise: float, blur_px: float = 0.0) -> float:
    """Cramér-Rao bound of one coordinate, px."""
    power = np.square(contrast(frequencies, blur_px) * frequencies).sum()
    return float(math.sqrt(2 / steps) * relative_noise / (2 * np.pi * math.sqrt(power)))


def wrong_order_probability(
    frequencies: Floats, steps: int, relative_noise: float, extent: float, blur_px: float = 0.0
) -> float:
    """Union bound over the side lobes of the likelihood, for places spread evenly over the projector.

    A side lobe at lag δ is beaten by Σ m_t² (1 - cos 2πf_t δ), with the noise of the difference: Q(√(that/2)/σ_z).
    """
    weights = np.square(contrast(frequencies, blur_px))
    lag = np.arange(0.5 / frequencies.max(), extent, _LAG_STEP_PX)
    lost = (weights * (1 - np.cos(2 * np.pi * np.outer(lag, frequencies)))).sum(axis=1)
    lobe = np.flatnonzero((lost[1:-1] <= lost[:-2]) & (lost[1:-1] <= lost[2:])) + 1
    sigma_z = math.sqrt(2 / steps) * relative_noise
    chance = norm.sf(np.sqrt(np.maximum(lost[lobe], 0) / 2) / sigma_z)
    return float(min(1.0, (2 * (1 - lag[lobe] / extent) * chance).sum()))


def noncentrality(
    frequencies: Floats, steps: int, relative_noise: float, delta_px: Floats, alpha: float, blur_px: float = 0.0
) -> Floats:
    """(n,) noncentrality of the one-path χ² for a bounce of ratio ``alpha`` at ``delta_px`` (n,), to first order."""
    m = contrast(frequencies, blur_px)
    bounce = m * np.exp(2j * np.pi * np.outer(delta_px, frequencies))
    # The fit takes a change of amplitude (along m) and of coordinate (along i m f), which are orthogonal.
    power = m @ m - (bounce.real @ m) ** 2 / (m @ m)
    power -= (bounce.imag @ (m * frequencies)) ** 2 / np.square(m * frequencies).sum()
    return np.asarray(alpha**2 * np.maximum(power, 0) * steps / (2 * relative_noise**2))


def detection_power(noncentralities: Floats, dof: int, false_alarm_rate: float) -> Floats:
    """Share of bounces that χ² with ``dof`` degrees of freedom detects."""
    return np.asarray(ncx2.sf(chi2_distribution.isf(false_alarm_rate, dof), dof, np.maximum(noncentralities, 1e-12)))


@lru_cache(maxsize=256)
def even_noncentrality(dof: int, false_alarm_rate: float) -> float:
    """Noncentrality that is detected every other time."""
    threshold = float(chi2_distribution.isf(false_alarm_rate, dof))
    return float(brentq(lambda value: ncx2.sf(threshold, dof, value) - 0.5, 1e-9, 4 * threshold))


def bounds(frequencies: Sequence[float], steps: int, demand: Demand, axis: Axis, dof: int) -> AxisBounds:
    """What fringes of one axis reach; ``dof`` are the degrees of freedom of all axes together."""
    f = np.asarray(frequencies, np.float64)
    delta = _deltas(demand, axis)
    return AxisBounds(
        coordinate_bound(f, steps, demand.relative_noise, demand.blur_px),
        wrong_order_probability(f, steps, demand.relative_noise, demand.extent(axis), demand.blur_px),
        delta,
        _least_bounce(noncentrality(f, steps, demand.relative_noise, delta, 1.0, demand.blur_px), demand, dof),
    )


def judge(frequencies: dict[Axis, tuple[float, ...]], steps: int, demand: Demand) -> DesignedPlan:
    """Bounds of a given plan, to compare a design with."""
    dof = sum(2 * len(f) - 2 for f in frequencies.values())
    found = {axis: bounds(f, steps, demand, axis, dof) for axis, f in frequencies.items()}
    return DesignedPlan(demand, steps, frequencies, found)


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


def _deltas(demand: Demand, axis: Axis) -> Floats:
    return np.arange(demand.from_px, min(demand.to_px, demand.extent(axis)) + 1e-9, _DELTA_STEP_PX)


def _least_bounce(one: Floats, demand: Demand, dof: int) -> Floats:
    """α₅₀ where a bounce as strong as the direct path has the noncentrality ``one``."""
    return np.asarray(np.sqrt(even_noncentrality(dof, demand.false_alarm_rate) / np.maximum(one, 1e-12)))


class _Candidates:
    """All fringes that one axis may have, with what each adds to the sums of the bounds."""

    def __init__(self, demand: Demand, axis: Axis) -> None:
        self.demand, self.extent, self.orders = demand, demand.extent(axis), demand.orders(axis)
        f = self.orders / self.extent
        self.weight = np.square(contrast(f, demand.blur_px))
        self.information = self.weight * f**2
        angle = 2 * np.pi * np.outer(f, _deltas(demand, axis))
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
        least = np.log(_least_bounce(left * steps / 2, self.demand, dof))
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
