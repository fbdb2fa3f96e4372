"""The comparison's figure as a PNG: distance from the fitted surface, one map a method on one scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanner.comparison.judging import Row


def reach_of(rows: Sequence[Row]) -> float:
    """End of the common scale, mm: four times the best method's median distance."""
    medians = [r.mean["median_mm"] for r in rows if np.isfinite(r.mean["median_mm"])]
    return max(4 * min(medians, default=0.1), 0.01)


def picture(maps: Mapping[str, NDArray[np.float32]], rows: Sequence[Row], path: Path, simulated: bool) -> None:
    """Write the maps (H, W) of a window, by method and in the order of its ``rows``, to ``path``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    known = np.asarray(np.isfinite(np.stack(list(maps.values()))).any(axis=0))
    ys, xs = np.nonzero(known)
    window = (slice(ys.min(), ys.max() + 1), slice(xs.min(), xs.max() + 1)) if ys.size else (slice(None), slice(None))
    limit = reach_of(rows)
    shape = known[window].shape
    columns = min(len(maps), 5)
    lines = -(-len(maps) // columns)
    width = 3.2
    size = (width * columns + 1.0, lines * (width * shape[0] / shape[1] + 0.5) + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax in axes[len(maps) :]:
        ax.set_axis_off()
    for ax, (name, values), row in zip(axes, maps.items(), rows, strict=False):
        image = ax.imshow(values[window], cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        ax.set_facecolor("0.85")
        ax.set_xticks([])
        ax.set_yticks([])
        std, coverage = row.mean["std_mm"], row.mean["coverage"]
        ax.set_title(f"{name.upper()}   std {std:.3g} mm\n{100 * coverage:.1f} % covered", fontsize=10)
    figure.colorbar(image, ax=list(axes), label="distance from the fitted surface, mm", shrink=0.9, extend="both")
    stamp = "SIMULATED DATA · " if simulated else ""
    figure.suptitle(f"{stamp}{rows[0].window} after a fit; grey: no point", fontsize=9, color="0.3")
    figure.savefig(path, dpi=130)
