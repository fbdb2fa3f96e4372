"""The pictures of an artefact: where it deviates, how the deviations are distributed, and what makes up each U."""

from __future__ import annotations

import math
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from calibration.acceptance.evaluation import Evaluation, Picture
from calibration.acceptance.figures import Figure
from calibration.certificate.wording import deviation
from scanner.report.figures import Scale, Series, histogram, outline, picture, shrink
from scanner.report.wording import figure, per_cent, section

Array = NDArray[Any]

_MEASURED, _EXPECTED = "#2f7fb5", "#c2571a"
_BINS = 81
_SIGMAS = 5.0  # a map spans so many of the predicted standard deviations at least
_COMPONENTS = 64


def artefact_section(evaluation: Evaluation) -> str:
    """Show one artefact; where nothing could be measured, say why."""
    if not evaluation.pictures:
        reasons = sorted({f.note for f in evaluation.figures if f.value_mm is None and f.note})
        text = "".join(f'<p class="empty">Not measured: {escape(reason)}</p>' for reason in reasons)
        return section(escape(evaluation.artefact), text)
    reach = _common_reach(evaluation.pictures)
    maps = [_map(p, reach) for p in evaluation.pictures]
    distributions = [_distribution(p) for p in evaluation.pictures]
    budgets = _budgets(evaluation.figures)
    if len(maps) == 1:
        inside = f'<div class="beside artefact">{maps[0]}<div>{distributions[0]}{budgets}</div></div>'
    else:
        inside = f'<div class="grid three">{"".join(maps + distributions)}</div>{budgets}'
    return section(escape(evaluation.artefact), inside)


def _common_reach(pictures: list[Picture]) -> float:
    """Half-width (mm) of the maps' common scale: what noise explains fills it; what it does not leaves it.

    The state with the least scatter sets it, so that an error of another state shows beside it.
    """
    reaches = []
    for p in pictures:
        sigma = p.sigma[np.isfinite(p.sigma)]
        noise = _SIGMAS * float(np.median(sigma)) if sigma.size else 0.0
        spread = float(np.percentile(np.abs(p.residuals), 99)) if p.residuals.size else math.inf
        reaches.append(max(noise, spread))
    least = min(reaches)
    return least if 0 < least < math.inf else 1e-3


def _map(p: Picture, reach: float) -> str:
    rows, columns = _window(p.region)
    values, region = p.deviation[rows, columns], p.region[rows, columns]
    factor, unit = (1000.0, "µm") if reach < 1 else (1.0, "mm")
    small = shrink(values * factor)
    scale = Scale("RdBu_r", -reach * factor, reach * factor, unit)
    size = small.shape[1], small.shape[0]
    ends = f"{reach * factor:.3g} {unit}"
    alt = f"{p.title}: map of {size[0]} by {size[1]} px, colours from −{ends} to {ends}"
    covered = float((np.isfinite(p.deviation) & p.region).sum()) / max(int(p.region.sum()), 1)
    beyond = float((np.abs(p.residuals) > reach).mean()) if p.residuals.size else math.nan
    caption = (
        "Camera's view, cut out; red is nearer or outside, blue farther or inside, grey is not measured. "
        f"{per_cent(covered)} of the outlined region has a point; {per_cent(beyond)} of these lie beyond the scale."
    )
    return figure(
        f"map-{_key(p.title)}",
        escape(p.title),
        picture(scale.png(small), size, alt, outline(region, size)) + scale.bar(),
        caption,
    )


def _distribution(p: Picture) -> str:
    if p.residuals.size < 2:
        return ""
    sigma = p.sigma[np.isfinite(p.sigma) & (p.sigma > 0)]
    spread = float(p.residuals.std())
    typical = float(np.sqrt(np.mean(sigma**2))) if sigma.size else spread
    reach = max(_SIGMAS * typical, float(np.percentile(np.abs(p.residuals), 99.5)), 1e-9)
    factor, unit = (1000.0, "µm") if reach < 1 else (1.0, "mm")
    edges = np.linspace(-reach, reach, _BINS + 1)
    counts = 100 * np.histogram(p.residuals, edges)[0] / p.residuals.size
    series = [Series("measured", counts, _MEASURED)]
    if sigma.size:
        # Points differ in σ: their distribution is the mean of their Gaussians.
        some = np.sort(sigma)[((np.arange(_COMPONENTS) + 0.5) * sigma.size / _COMPONENTS).astype(int)]
        expected = 100 * np.diff(norm.cdf(edges[:, None] / some).mean(axis=1))
        series.append(Series("noise alone", expected, _EXPECTED, expected=True))
    alt = (
        f"Histogram of deviations, {p.title}: standard deviation {spread:.3g} mm, predicted from noise {typical:.3g} mm"
    )
    predicted = f", predicted from the points' noise {deviation(typical)}" if sigma.size else ""
    caption = f"Standard deviation {deviation(spread)}{predicted}. Wider than noise is form, calibration or bounce."
    chart = histogram(edges * factor, series, f"deviation, {unit}", alt)
    return figure(f"distribution-{_key(p.title)}", "Distribution of the deviations", chart, caption)


def _budgets(figures: list[Figure]) -> str:
    rows = []
    for f in figures:
        if f.value_mm is None:
            continue
        parts = [f"{escape(name)} {deviation(u)}" for name, u in f.budget.items() if u > 0]
        rows.append(
            f"<tr><th>{escape(f.quantity.label)}</th><td>{deviation(f.u_mm) if f.u_mm else '–'}</td>"
            f"<td>{'; '.join(parts) or 'not stated'}</td></tr>"
        )
    if not rows:
        return ""
    head = "".join(f"<th>{h}</th>" for h in ("Figure", "Standard uncertainty u", "made up of"))
    return f'<div class="wide budget"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _window(region: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns around ``region`` with some air; all of it where it is empty."""
    height, width = region.shape
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    if rows.size == 0:
        return slice(0, height), slice(0, width)
    air = round(0.06 * max(np.ptp(rows), np.ptp(columns))) + 2
    return (
        slice(max(int(rows[0]) - air, 0), min(int(rows[-1]) + air + 1, height)),
        slice(max(int(columns[0]) - air, 0), min(int(columns[-1]) + air + 1, width)),
    )


def _key(title: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in title.lower())
