"""Maps as pictures with colour bars, and charts: all as HTML fragments that follow the page's light or dark colours."""

from __future__ import annotations

import base64
import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[Any]

PICTURE_AREA = 240_000
"""Pixels of a picture at most, so that the page stays small whatever the camera."""
MISSING = (150, 153, 158)
"""The neutral grey of NaN."""
_NAN_INDEX = 255


def fitted(shape: tuple[int, ...]) -> tuple[int, int]:
    """(width, height) of the picture of an (H, W) map: its own aspect, at most `PICTURE_AREA` px."""
    height, width = shape
    factor = min(1.0, math.sqrt(PICTURE_AREA / (height * width)))
    return max(1, int(width * factor)), max(1, int(height * factor))


def shrink(values: Array) -> NDArray[np.float32]:
    """Area average of an (H, W) map to its `fitted` size; NaN counts as absent, and wins where it has the majority."""
    valid = np.isfinite(values)
    size = fitted(values.shape)
    if size == values.shape[::-1]:
        return np.where(valid, values, np.nan).astype(np.float32)
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(np.where(valid, values, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(share >= 0.5, total / share, np.nan).astype(np.float32)


@dataclass(frozen=True)
class Scale:
    """How values become colours: a perceptually uniform map from ``low`` to ``high``, linear or logarithmic.

    Parameters
    ----------
    colormap
        Name of a Matplotlib colormap.
    low, high
        The values at its ends, in ``unit``; what lies beyond is shown in the end's colour.
    """

    colormap: str
    low: float
    high: float
    unit: str = ""
    logarithmic: bool = False

    @classmethod
    def of(cls, values: Array, colormap: str, unit: str = "", *, logarithmic: bool = False) -> Self:
        """Span the 1st to 99th percentile of ``values``."""
        good = values[np.isfinite(values)]
        if logarithmic:
            good = good[good > 0]
        if good.size == 0:
            return cls(colormap, *((0.1, 1.0) if logarithmic else (0.0, 1.0)), unit, logarithmic)
        low, high = (float(v) for v in np.percentile(good, (1, 99)))
        if high - low <= 1e-6 * max(abs(low), abs(high), 1e-9):
            pad = 0.05 * abs(low) or 1.0
            low, high = low - pad, high + pad
        return cls(colormap, low, high, unit, logarithmic)

    def _position(self, values: Array) -> Array:
        """Where values lie between the ends, 0..1."""
        if self.logarithmic:
            return np.asarray(np.log(np.maximum(values, self.low) / self.low) / math.log(self.high / self.low))
        return np.asarray((values - self.low) / (self.high - self.low))

    def palette(self) -> NDArray[np.uint8]:
        """(256, 3) colours of the indices; the last is the grey of NaN."""
        colours = mpl.colormaps[self.colormap](np.linspace(0, 1, _NAN_INDEX))[:, :3]
        return np.vstack([np.rint(255 * colours), [MISSING]]).astype(np.uint8)

    def png(self, values: Array) -> str:
        """``values`` (h, w) as the data URL of a palette PNG."""
        missing = np.isnan(values)
        position = np.clip(self._position(np.where(missing, self.low, values)), 0, 1)
        indices = np.where(missing, _NAN_INDEX, np.rint(position * (_NAN_INDEX - 1))).astype(np.uint8)
        return png(indices, self.palette())

    def ticks(self) -> list[tuple[float, str]]:
        """Choose some round values and their labels."""
        values: list[float] = []
        if self.logarithmic:
            for subs in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)):
                if len(values) < 3:
                    values = self._within(LogLocator(subs=subs).tick_values(self.low, self.high))
            values = values[:: math.ceil(len(values) / 6) or 1]
        if len(values) < 3:
            values = self._within(MaxNLocator(nbins=5).tick_values(self.low, self.high))
        return [(v, f"{v:.6g}".replace("-", "−")) for v in values]

    def _within(self, values: Iterable[float]) -> list[float]:
        return [float(v) for v in values if self.low <= v <= self.high]

    def bar(self) -> str:
        """Draw the colour bar as HTML."""
        strip = png(np.arange(_NAN_INDEX, dtype=np.uint8)[None], self.palette())
        labels = "".join(
            f'<span style="left:{100 * float(self._position(np.array(v))):.2f}%">{label}</span>'
            for v, label in self.ticks()
        )
        unit = f'<span class="unit">{html.escape(self.unit)}</span>'
        return f'<div class="bar"><img src="{strip}" alt=""><div class="ticks">{labels}</div>{unit}</div>'


def png(indices: NDArray[np.uint8], palette: NDArray[np.uint8]) -> str:
    """Indexed picture (h, w) as a data URL."""
    picture = Image.fromarray(indices)
    picture.putpalette(palette.tobytes())
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def outline(region: NDArray[np.bool_], size: tuple[int, int]) -> str:
    """SVG path around ``region`` (H, W) in a picture of ``size`` (w, h), without specks below 12 of its px."""
    mask = cv2.resize(region.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) >= 128
    # Contours run through pixel centres of the region; a doubled mask puts them on its edge, half a pixel off at most.
    doubled = cv2.resize(mask.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    contours, _ = cv2.findContours(doubled, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    large = sorted((c for c in contours if cv2.contourArea(c) >= 4 * 12), key=cv2.contourArea, reverse=True)
    parts = []
    for contour in large[:500]:
        vertices = cv2.approxPolyDP(contour, 1.0, closed=True)[:, 0] / 2 + 0.25
        parts.append("M" + "L".join(f"{x:g} {y:g}" for x, y in vertices) + "Z")
    return "".join(parts)


def picture(source: str, size: tuple[int, int], alt: str, outlined: str = "") -> str:
    """Draw a PNG (data URL) of ``size`` (w, h) with an outline on top, as one accessible SVG."""
    width, height = size
    path = f'<path class="outline" d="{outlined}"/>' if outlined else ""
    return (
        f'<svg class="map" viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(alt)}">'
        f'<image width="{width}" height="{height}" href="{source}"/>{path}</svg>'
    )


@dataclass(frozen=True)
class Series:
    """One histogram of a chart: ``weights`` per bin, drawn as steps or, where ``expected``, as a smooth dashed line."""

    label: str
    weights: Array
    colour: str
    expected: bool = False


def histogram(edges: Array, series: Sequence[Series], xlabel: str, alt: str, *, logarithmic: bool = False) -> str:
    """Histograms over common bins as inline SVG whose text and axes take the page's colour.

    Parameters
    ----------
    edges
        (n + 1,) bin edges.
    series
        With (n,) weights each, in per cent of the pixels.
    """
    ink = "#010203"  # stands for the page's own text colour, put in below
    style: dict[Any, Any] = {
        "svg.fonttype": "none",
        "svg.hashsalt": alt,
        "font.size": 9,
        "axes.edgecolor": ink,
        "axes.labelcolor": ink,
        "xtick.color": ink,
        "ytick.color": ink,
        "text.color": ink,
        "axes.spines.top": False,
        "axes.spines.right": False,
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(5.2, 3.1))
        axes = figure.add_axes((0.1, 0.16, 0.88, 0.8))
        centres = np.sqrt(edges[1:] * edges[:-1]) if logarithmic else (edges[1:] + edges[:-1]) / 2
        for one in series:
            if one.expected:
                axes.plot(centres, one.weights, "--", color=one.colour, linewidth=1.6, label=one.label)
            else:
                axes.stairs(one.weights, edges, fill=True, color=one.colour, alpha=0.35)
                axes.stairs(one.weights, edges, color=one.colour, linewidth=1.2, label=one.label)
        if logarithmic:
            axes.set_xscale("log")
            axes.minorticks_off()
            ticks = Scale("gray", float(edges[0]), float(edges[-1]), logarithmic=True).ticks()
            axes.set_xticks([v for v, _ in ticks], [label for _, label in ticks])
        axes.set(xlim=(edges[0], edges[-1]), ylim=(0, None), xlabel=xlabel, ylabel="% of pixels per bin")
        axes.legend(frameon=False, fontsize=8)
        buffer = io.StringIO()
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(ink, "currentColor")
    svg = re.sub(r' id="[\w.]+_\d+"', "", svg)  # names of groups: several charts share one page
    svg = re.sub(r'<svg [^>]*?viewBox="([^"]+)"[^>]*>', r'<svg class="chart" viewBox="\1">', svg, count=1)
    return svg.replace('class="chart"', f'class="chart" role="img" aria-label="{html.escape(alt)}"', 1)
