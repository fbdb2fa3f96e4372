"""What the study commands write: one JSON table and its figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scanner.design import Demand, DesignedPlan, design, judge, trade
from scanner.patterns import Axis
from scanner.studies import detection, figures

_DISTANCES_PX = (
    0, 5, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100, 120, 142, 180, 240, 320, 400, 480, 560, 600, 628, 632, 636, 640, 644,
    648, 652, 680, 720,
)  # fmt: skip
_QUICK_DISTANCES_PX = (0, 20, 40, 80, 142, 320, 636, 644, 720)

BUDGETS = (48, 60, 72, 84, 96, 108, 132, 162, 216)
"""Frames of one round for which the trade is shown."""


def detection_study(
    folder: Path,
    seeds: int = 8,
    axes: Sequence[Axis] = ("x",),
    quick: bool = False,
    report: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Run the study of detection at the limit and write ``maps.png``, ``roc.png`` and ``distance.png`` to ``folder``.

    Parameters
    ----------
    seeds
        Independent pictures for every figure: seeds 1, 2, …
    quick
        Smaller pictures and fewer Δu, to see whether everything runs.

    Returns
    -------
    dict
        The tables: ``pairs``, ``distance``, ``clean`` and ``plans``, with what they were made with.
    """
    numbers = range(1, seeds + 1)
    shape = (192, 256) if quick else (384, 512)
    pairs, examples = detection.pairs_study(numbers, axes, shape, report=report)
    figures.maps_figure(examples, pairs, folder / "maps.png")
    figures.roc_figure(examples, pairs, folder / "roc.png")
    distances = [
        row
        for alpha, sigma in ((0.05, 10.0), (0.05, 20.0), (0.4, 20.0))
        for row in detection.distance_study(
            _QUICK_DISTANCES_PX if quick else _DISTANCES_PX, numbers[:4], alpha, sigma, axes, report=report
        )
    ]
    figures.distance_figure(distances, folder / "distance.png")
    clean = detection.clean_study((0.01, 0.001), numbers, axes, shape=shape, report=report)
    half = design(Demand(relative_noise=10 / 80))
    plans = detection.plan_study(
        {
            "paper": (dict.fromkeys(("x", "y"), detection.PAPER_FREQUENCIES), detection.PAPER_STEPS),
            "designed": (half.frequencies, half.steps),
        },
        numbers[:4],
        (((0.05, 0.6), 2.0), ((0.05, 0.6), 10.0), ((0.05, 0.05), 20.0)),
        report=report,
    )
    return {
        "axes": list(axes),
        "seeds": list(numbers),
        "shape": list(shape),
        "not_counted_px": detection.NEAR_PX,
        "interval": "95 %, Student, over seeds",
        "pairs": pairs,
        "distance": distances,
        "clean": clean,
        "plans": plans,
    }


def design_study(
    demand: Demand, folder: Path | None, budgets: Sequence[int] = BUDGETS
) -> tuple[DesignedPlan, DesignedPlan, list[DesignedPlan]]:
    """Design a plan beside the paper's, and the trade over frame budgets; with ``folder``, ``trade.png`` as well."""
    chosen = design(demand)
    usual = judge(dict.fromkeys(demand.axes, detection.PAPER_FREQUENCIES), detection.PAPER_STEPS, demand)
    plans = trade(demand, sorted({*budgets, demand.frames}))
    if folder is not None:
        figures.trade_figure(plans, chosen, usual, folder / "trade.png")
    return chosen, usual, plans


def plan_rows(plans: Sequence[DesignedPlan]) -> list[dict[str, Any]]:
    """JSON-ready rows of plans."""
    return [
        {
            "frames": p.frame_count,
            "steps": p.steps,
            "frequencies_per_px": {a: list(f) for a, f in p.frequencies.items()},
            "orders": {a: np.round(np.multiply(f, p.demand.extent(a)), 3).tolist() for a, f in p.frequencies.items()},
            "sigma_px": p.sigma_px,
            "wrong_orders": p.wrong_orders,
            "least_bounce_typical": p.typical_bounce,
            "least_bounce_worst": p.worst_bounce,
        }
        for p in plans
    ]
