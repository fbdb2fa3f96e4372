"""Figures of the studies, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scanner.studies.detection import NEAR_PX, roc
from scanner.studies.ideal import DETECTORS, IdealScene, Judgement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scanner.design import DesignedPlan

NAMES = {"variation": "std |z| (the paper's)", "misfit": "χ²", "pooled": "χ² pooled"}
_COLOURS = {"variation": "#c0392b", "misfit": "#7f8c8d", "pooled": "#1f6fb2"}
_STAMP = "ideal signals, A = B = 80 DN"


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def maps_figure(
    examples: Mapping[tuple[float, float], tuple[IdealScene, dict[str, Judgement]]],
    rows: Sequence[Mapping[str, Any]],
    path: Path,
) -> None:
    """Detected regions beside the truth: a row for every pair of α and σ, a column for every detector."""
    figure = _figure(12.5, 2.45 * len(examples) + 0.6)
    panels = figure.subplots(len(examples), len(DETECTORS) + 1, squeeze=False)
    known = {(r["alpha"], r["sigma_dn"], r["detector"]): r["iou"]["mean"] for r in rows}
    for line, ((alpha, sigma), (scene, judged)) in zip(panels, examples.items(), strict=True):
        near = scene.region & (scene.distance < NEAR_PX)
        truth = np.where(near, 0.5, scene.region.astype(float))
        line[0].imshow(truth, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        line[0].set_title(f"truth: α = {alpha:g}, σ = {sigma:g} DN", fontsize=9)
        for panel, detector in zip(line[1:], DETECTORS, strict=True):
            found = judged[detector].region
            right, wrong = found & scene.region, found & ~scene.region
            picture = np.zeros((*found.shape, 3))
            picture[right] = (1, 1, 1)
            picture[wrong] = (0.95, 0.35, 0.1)
            picture[scene.region & ~found & ~near] = (0.15, 0.35, 0.75)
            picture[near & ~found] = (0.35, 0.35, 0.35)
            panel.imshow(picture, interpolation="nearest")
            panel.set_title(f"{NAMES[detector]}: IoU {known[alpha, sigma, detector]:.3f}", fontsize=9)
        for panel in line:
            panel.set_xticks([])
            panel.set_yticks([])
    figure.suptitle(
        f"{_STAMP}. White: found; blue: missed; orange: false; grey: |Δu| < {NEAR_PX:g} px, not counted. "
        "First seed shown, IoU the mean of all",
        fontsize=9,
    )
    figure.savefig(path, dpi=90)


def distance_figure(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Intersection over union and area under the ROC against Δu, a column for every pair of α and σ."""
    pairs = sorted({(r["alpha"], r["sigma_dn"]) for r in rows})
    figure = _figure(5.2 * len(pairs), 6.4)
    panels = figure.subplots(2, len(pairs), squeeze=False, sharex=True, sharey="row")
    for column, (alpha, sigma) in enumerate(pairs):
        for line, key in enumerate(("iou", "auc")):
            panel = panels[line][column]
            for detector in DETECTORS:
                chosen = [r for r in rows if (r["alpha"], r["sigma_dn"], r["detector"]) == (alpha, sigma, detector)]
                x = [r["delta_px"] for r in chosen]
                panel.plot(x, [r[key]["mean"] for r in chosen], ".-", color=_COLOURS[detector], label=NAMES[detector])
                panel.fill_between(
                    x,
                    [r[key]["low"] for r in chosen],
                    [r[key]["high"] for r in chosen],
                    color=_COLOURS[detector],
                    alpha=0.2,
                    linewidth=0,
                )
            panel.axvline(640, color="0.7", linewidth=0.8, zorder=0)
            panel.set_ylim(0 if key == "iou" else 0.4, 1.02)
            panel.grid(alpha=0.25)
            if line == 0:
                panel.set_title(f"α = {alpha:g}, σ = {sigma:g} DN", fontsize=10)
            else:
                panel.set_xlabel("Δu, px")
        panels[0][0].set_ylabel("intersection over union")
        panels[1][0].set_ylabel("area under the ROC")
    panels[1][0].legend(fontsize=8, loc="lower right")
    figure.suptitle(f"{_STAMP}; one Δu over a disc of 80 px; bands: 95 % interval over seeds; line: 640 px", fontsize=9)
    figure.savefig(path, dpi=110)


def roc_figure(
    examples: Mapping[tuple[float, float], tuple[IdealScene, dict[str, Judgement]]],
    rows: Sequence[Mapping[str, Any]],
    path: Path,
) -> None:
    """Draw the receiver operating characteristic of every pair of α and σ; false alarms on a logarithmic axis."""
    known = {(r["alpha"], r["sigma_dn"], r["detector"]): r["auc"]["mean"] for r in rows}
    columns = min(3, len(examples))
    lines = -(-len(examples) // columns)
    figure = _figure(4.0 * columns, 3.1 * lines + 0.4)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    rates = np.geomspace(1e-4, 1, 60)
    for panel, ((alpha, sigma), (scene, judged)) in zip(panels.ravel(), examples.items(), strict=False):
        wanted = scene.region & (scene.distance >= NEAR_PX)
        for detector in DETECTORS:
            values = judged[detector].score
            panel.semilogx(
                rates,
                roc(values[wanted], values[~scene.region], rates),
                color=_COLOURS[detector],
                label=f"{NAMES[detector]}: AUC {known[alpha, sigma, detector]:.3f}",
            )
        panel.set_title(f"α = {alpha:g}, σ = {sigma:g} DN", fontsize=9)
        panel.set_ylim(0, 1.02)
        panel.grid(alpha=0.25)
        panel.legend(fontsize=7, loc="lower right")
    for panel in panels[-1]:
        panel.set_xlabel("false-alarm rate")
    for panel in panels[:, 0]:
        panel.set_ylabel("detected")
    figure.suptitle(f"{_STAMP}; pixels with |Δu| ≥ {NEAR_PX:g} px; curves: first seed, AUC: mean of all", fontsize=9)
    figure.savefig(path, dpi=110)


def trade_figure(plans: Sequence[DesignedPlan], chosen: DesignedPlan, usual: DesignedPlan, path: Path) -> None:
    """Frames against coordinate error and least bounce; and the least bounce against Δu of two plans."""
    figure = _figure(13.5, 4.0)
    error, bounce, range_ = figure.subplots(1, 3)
    frames = [p.frame_count for p in plans]
    error.plot(frames, [p.sigma_px for p in plans], "o-", color=_COLOURS["pooled"], label="designed")
    error.plot(usual.frame_count, usual.sigma_px, "D", color=_COLOURS["variation"], label="(80 + t)/1280, 12 steps")
    error.set(xlabel="frames of one round", ylabel="coordinate bound σ_u, px", ylim=(0, None))
    bounce.plot(frames, [p.typical_bounce for p in plans], "o-", color=_COLOURS["pooled"], label="typical Δu")
    bounce.plot(frames, [p.worst_bounce for p in plans], "o--", color=_COLOURS["pooled"], label="worst Δu")
    bounce.plot([usual.frame_count] * 2, [usual.typical_bounce, usual.worst_bounce], "D", color=_COLOURS["variation"])
    bounce.set(xlabel="frames of one round", ylabel="least bounce α₅₀ of one pixel", ylim=(0, None))
    for plan, colour, name in ((usual, "variation", "(80 + t)/1280, 12 steps"), (chosen, "pooled", "designed")):
        for axis, found in plan.bounds.items():
            range_.plot(
                found.delta_px,
                found.least_bounce,
                "-" if axis == "x" else ":",
                color=_COLOURS[colour],
                linewidth=1,
                label=f"{name}, {plan.frame_count} frames, {axis}",
            )
    range_.set(xlabel="Δu, px", ylabel="least bounce α₅₀ of one pixel", yscale="log")
    for panel in (error, bounce, range_):
        panel.grid(alpha=0.25)
        panel.legend(fontsize=8)
    demand = chosen.demand
    figure.suptitle(
        f"σ/B = {demand.relative_noise:.4g}, Δu {demand.from_px:g} to {demand.to_px:g} px, false alarms "
        f"{100 * demand.false_alarm_rate:g} %; a bounce of α₅₀ times the direct light is found every other time",
        fontsize=9,
    )
    figure.savefig(path, dpi=110)
