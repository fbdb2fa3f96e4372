"""A plan with what it reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanner.design.bounds import AxisBounds, bounds, detection_power, even_noncentrality
from scanner.design.demand import Demand
from scanner.patterns import Axis, Plan, phase_steps


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


def judge(frequencies: dict[Axis, tuple[float, ...]], steps: int, demand: Demand) -> DesignedPlan:
    """Bounds of a given plan, to compare a design with."""
    dof = sum(2 * len(f) - 2 for f in frequencies.values())
    found = {axis: bounds(f, steps, demand, axis, dof) for axis, f in frequencies.items()}
    return DesignedPlan(demand, steps, frequencies, found)
