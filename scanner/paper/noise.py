"""The noise study, Figs. 22 and 23: attenuation against noise, the paper's detector beside this project's."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scanner.folder import DETECTION_STUDY, write_json
from scanner.paper.shelf import program
from scanner.studies import detection, figures
from scanner.studies.ideal import AMPLITUDE_DN, MEAN_DN, curved_scene

FRINGES, MAPS, ROC = "fringes.png", "maps.png", "roc.png"
FALSE_ALARM_RATE = 0.01


@dataclass(frozen=True)
class NoiseStudy:
    """Tables of the study, and the folder with its pictures."""

    folder: Path
    document: dict[str, Any]

    def mean(self, alpha: float, sigma_dn: float, detector: str, figure: str) -> float:
        """A figure of one pair of α and σ, mean over the seeds."""
        wanted = alpha, sigma_dn, detector
        row = next(r for r in self.document["pairs"] if (r["alpha"], r["sigma_dn"], r["detector"]) == wanted)
        value = row[figure]["mean"]
        return float("nan") if value is None else float(value)


def study_noise(folder: Path, seeds: int, shape: tuple[int, int], report: Callable[[str], None]) -> NoiseStudy:
    """Make the study, or take the one that is there.

    Parameters
    ----------
    folder
        For tables and pictures.
    seeds
        Independent pictures of every pair; their seeds are 201, 202, …, which nothing was chosen on.
    shape
        Rows and columns of a picture.
    report
        Is told what is being done.
    """
    numbers = list(range(201, 201 + seeds))
    asked = {"program": program(), "seeds": numbers, "shape": list(shape), "false_alarm_rate": FALSE_ALARM_RATE}
    path = folder / DETECTION_STUDY
    if path.is_file():
        known = json.loads(path.read_text("utf-8"))
        if {k: known.get(k) for k in asked} == asked:
            return NoiseStudy(folder, known)
    folder.mkdir(exist_ok=True)
    pairs, examples = detection.pairs_study(
        numbers, ("x",), shape, FALSE_ALARM_RATE, report=lambda text: report(f"noise study, {text}")
    )
    figures.maps_figure(examples, pairs, folder / MAPS)
    figures.roc_figure(examples, pairs, folder / ROC)
    _fringes(shape, folder / FRINGES)
    write_json(path, {**asked, "not_counted_px": detection.NEAR_PX, "pairs": pairs})
    return NoiseStudy(folder, json.loads(path.read_text("utf-8")))


def _fringes(shape: tuple[int, int], path: Path, alpha: float = 0.4) -> None:
    """Draw direct light, bounce and their sum as fringes, the region outlined (Fig. 22)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = curved_scene(shape, alpha, np.random.default_rng(201), ("x",))
    frequency, u, delta = detection.PAPER_FREQUENCIES[0], scene.direct["x"], scene.delta["x"]
    direct = MEAN_DN + AMPLITUDE_DN * np.cos(2 * np.pi * frequency * u)
    bounce = scene.alpha * (MEAN_DN + AMPLITUDE_DN * np.cos(2 * np.pi * frequency * (u + delta)))
    figure = Figure(figsize=(12.5, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    titles = "direct light", f"bounce, α = {alpha:g}", "both, as the camera sees them"
    for panel, picture, title in zip(figure.subplots(1, 3), (direct, bounce, direct + bounce), titles, strict=True):
        panel.imshow(picture, cmap="gray", vmin=0, vmax=2 * MEAN_DN * (1 + alpha), interpolation="nearest")
        panel.contour(scene.region, [0.5], colors="#ff2b3d", linewidths=1.2)
        panel.set_title(title, fontsize=10)
        panel.set_xticks([])
        panel.set_yticks([])
    figure.savefig(path, dpi=100)
