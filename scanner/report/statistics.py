"""The charts: whether σ and misfit are what the noise model promises."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from scanner.report.figures import Series, histogram
from scanner.report.plates import has
from scanner.report.surface import LocalPlanes, median
from scanner.report.wording import figure, grid, number
from scanner.result import Flag, Maps

Array = NDArray[Any]

_BOUNCE, _SURFACE, _EXPECTED = "#d6264a", "#2f7fb5", "#8a8f98"
_SAMPLES = 500_000  # pixels that a histogram looks at


def statistics(maps: Maps, planes: LocalPlanes | None) -> str:
    """Chart predicted σ, misfit, and the points' scatter over their predicted σ."""
    region = maps.interreflection
    spoilt = Flag.LOW_MODULATION | Flag.SATURATED | Flag.INTERREFLECTION | Flag.DEPTH_EDGE
    clean = ~has(maps.flags, spoilt)
    charts = []
    sigma = next((v for v in (maps.sigma_point, maps.sigma_x, maps.sigma_y) if v is not None), None)
    if sigma is not None:
        unit = "px" if maps.sigma_point is None else "mm"
        charts.append(
            _chart(
                "sigma-chart",
                "Predicted σ",
                _logarithmic(_parts(sigma, ~region, region), f"predicted σ, {unit}"),
                "Round two measures the region again: its σ should be close to that of the surface beside it.",
            )
        )
    charts.append(
        _chart(
            "misfit-chart",
            "Misfit of one path",
            _logarithmic(_parts(maps.misfit, clean, region), "χ² per degree of freedom", maps.misfit_dof),
            "Surface without bounce should follow the dashed line. Right of it the noise model promises too little "
            "noise, left of it too much."
            if maps.misfit_dof
            else "Surface without bounce should gather around 1; above, the noise model promises too little noise.",
        )
    )
    if planes is not None and maps.sigma_point is not None and maps.points is not None:
        charts.append(_pulls(maps.points, maps.sigma_point, clean, planes))
    return grid("Statistics", charts)


def _parts(values: Array, surface: Array, region: Array) -> list[tuple[str, str, Array]]:
    return [("no bounce", _SURFACE, _sample(values, surface)), ("bounce region", _BOUNCE, _sample(values, region))]


def _pulls(points: Array, sigma: Array, clean: Array, planes: LocalPlanes) -> str:
    """Chart residuals of the local planes in units of their prediction."""
    points, sigma, clean = (v[:: planes.stride, :: planes.stride] for v in (points, sigma, clean))
    with np.errstate(divide="ignore", invalid="ignore"):
        # σ is along the viewing ray, the residual across the surface.
        slant = -(planes.normals * points).sum(axis=2) / np.linalg.norm(points, axis=2)
        pulls = _sample(planes.residual / (sigma * slant), clean)
    if pulls.size == 0:
        return ""
    edges = np.linspace(-5, 5, 81)
    spread = 1.4826 * median(np.abs(pulls - np.median(pulls)))
    series = [
        Series("no bounce", 100 * np.histogram(pulls, edges)[0] / pulls.size, _SURFACE),
        Series("if σ is right", 100 * np.diff(norm.cdf(edges)), _EXPECTED, expected=True),
    ]
    alt = f"Histogram of distance from the local plane over predicted σ, robust spread {spread:.3g}"
    return _chart(
        "pull-chart",
        "Is the predicted σ true?",
        histogram(edges, series, "distance from local plane / predicted σ", alt),
        f"Robust spread {number(spread)}; 1 where the surface is smooth over a window and σ is right. Texture and "
        "edges widen it.",
    )


def _chart(key: str, title: str, chart: str, caption: str) -> str:
    return figure(key, title, chart, caption) if chart else ""


def _sample(values: Array, where: NDArray[np.bool_]) -> Array:
    """Finite values where asked, thinned evenly to about `_SAMPLES`."""
    chosen = values[where & np.isfinite(values)]
    return chosen[:: max(1, chosen.size // _SAMPLES)]


def _logarithmic(parts: Iterable[tuple[str, str, Array]], xlabel: str, dof: int = 0) -> str:
    """Histogram over logarithmic bins, with the distribution of χ²/ν where ``dof`` is above 0; "" without values."""
    parts = [(label, colour, values[values > 0]) for label, colour, values in parts if (values > 0).any()]
    if not parts:
        return ""
    low = min(np.percentile(v, 0.2) for *_, v in parts)
    high = max(np.percentile(v, 99.8) for *_, v in parts)
    edges = np.geomspace(low / 1.1, high * 1.1, 91)
    series = [Series(label, 100 * np.histogram(v, edges)[0] / v.size, colour) for label, colour, v in parts]
    if dof:
        expected = 100 * np.diff(chi2.cdf(dof * edges, dof))
        series.append(Series(f"expected, ν = {dof:g}", expected, _EXPECTED, expected=True))
    alt = f"Histogram of {xlabel}: " + "; ".join(f"{label} median {np.median(v):.3g}" for label, _, v in parts)
    return histogram(edges, series, xlabel, alt, logarithmic=True)
