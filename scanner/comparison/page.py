"""The comparison as one self-contained HTML page, in the order of the paper's figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from drivers import SceneTruth
from scanner.comparison.detection import bounces
from scanner.comparison.judging import FIGURES, Row, distances
from scanner.comparison.picture import reach_of
from scanner.comparison.windows import Window
from scanner.methods import METHODS
from scanner.report.figures import Scale, outline, picture, shrink
from scanner.report.oblique import Viewpoint
from scanner.report.plates import window_around
from scanner.report.surface import planes_of_scan
from scanner.report.wording import figure, grid, number, per_cent, section, table
from scanner.result import ScanResult

_COLUMNS = (
    ("coverage", "Coverage", "share"),
    ("std_mm", "Std, mm", "length"),
    ("std_ratio", "÷ no bounces", "ratio"),
    ("median_mm", "Median, mm", "length"),
    ("rmse_mm", "RMSE, mm", "length"),
    ("wrong_fringes", "Wrong fringe", "share"),
    ("close", "&lt; 0.1 px", "share"),
    ("precision", "Precision", "share"),
    ("recall", "Recall", "share"),
    ("auc", "AUC", "figure"),
    ("frames", "Frames", "count"),
    ("seconds", "Time, s", "time"),
)


@dataclass(frozen=True)
class Comparison:
    """What the page shows.

    Parameters
    ----------
    title, facts
        Heading, and lines below it, such as bench and seeds.
    methods
        Titles of the methods by name.
    results
        One scan of each method, by name, for the pictures.
    windows, rows
        Where was judged, and the figures over all scans.
    truth, least_alpha
        As `scanner.comparison.judge` had them.
    key
        Tells the figures of several comparisons on one page apart.
    """

    title: str
    facts: Mapping[str, str]
    methods: Mapping[str, str]
    results: Mapping[str, ScanResult]
    windows: Sequence[Window]
    rows: Sequence[Row]
    truth: SceneTruth | None
    least_alpha: float
    key: str = ""

    @property
    def simulated(self) -> bool:
        """Whether any of it is."""
        return any(r.simulated for r in self.results.values())


def render(c: Comparison, command: str) -> str:
    """Write the page; it loads nothing from anywhere. ``command`` makes all of it again."""
    return page(c.title, header(c.title, c.facts, command, c.simulated), *sections(c), simulated=c.simulated)


def page(title: str, *parts: str, simulated: bool) -> str:
    """Make one self-contained HTML page of its parts."""
    here = files("scanner.report")
    style, script = ((here / name).read_text("utf-8") for name in ("report.css", "viewer.js"))
    stamp = '<div class="stamp" role="note">SIMULATED DATA</div>' if simulated else ""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}{' (simulated)' if simulated else ''}</title><style>{style}</style></head>"
        f"<body>{stamp}<main>{''.join(parts)}</main><script>{script}</script></body></html>\n"
    )


def sections(c: Comparison) -> list[str]:
    """Tables and figures, without a heading of their own."""
    return [
        *(_table(c, w) for w in c.windows),
        _scene(c),
        _detection(c),
        _surfaces(c),
        *(_errors(c, w) for w in c.windows),
        _notes(c),
    ]


def header(title: str, facts: Mapping[str, str], command: str, simulated: bool) -> str:
    """Heading of a page, with facts and the command that makes it again."""
    listed = "".join(f"<div><dt>{k}</dt><dd>{escape(v)}</dd></div>" for k, v in facts.items() if v)
    stamp = '<p class="simulated">SIMULATED DATA<small>no light was involved</small></p>' if simulated else ""
    return (
        f"<header><div><h1>{escape(title)}</h1><dl>{listed}</dl>"
        f'<p class="command"><code>{escape(command)}</code></p></div>{stamp}</header>'
    )


def _scene(c: Comparison) -> str:
    """Draw what the camera sees, with the windows outlined."""
    result = next(iter(c.results.values()))
    drawn = np.logical_or.reduce([w.mask for w in c.windows])
    bright = result.maps.brightness
    figures = [
        _map(
            f"{c.key}scene",
            "The scene",
            bright,
            Scale("gray", 0.0, float(np.nanpercentile(bright, 99.5)), "DN"),
            "Mean of the fringes as the camera sees them. Outlined: where errors are judged.",
            drawn,
        ),
        _map(
            f"{c.key}modulation",
            "Modulation of the captured fringes",
            result.maps.modulation,
            Scale.of(result.maps.modulation, "viridis", "DN"),
            "Where two paths meet, their fringes add and cancel in turn.",
        ),
    ]
    return grid("What is scanned", figures)


def _table(c: Comparison, window: Window) -> str:
    rows = [r for r in c.rows if r.window == window.name]
    shown = [column for column in _COLUMNS if any(math.isfinite(r.mean[column[0]]) for r in rows)]
    named = [r for r in rows if r.method in METHODS and r.mean["coverage"] > 0.5]
    best = min((r.mean["std_mm"] for r in named), default=math.nan)
    body = []
    for row in rows:
        cells = [f"<b>{escape(row.method)}</b><small>{escape(c.methods.get(row.method, ''))}</small>"]
        cells += [_cell(row.mean[key], row.half_width[key], kind) for key, _, kind in shown]
        body.append(("best" if row in named and row.mean["std_mm"] == best else "", cells))
    head = ("Method", *(f'<span title="{escape(FIGURES[key])}">{label}</span>' for key, label, _ in shown))
    seeds = max((r.seeds for r in rows), default=1)
    said = f"Means over {seeds} seeds; ± is half the 95 % confidence interval. " if seeds > 1 else ""
    explained = " ".join(f"<i>{label}:</i> {escape(FIGURES[key])}." for key, label, _ in shown[:-2])
    caption = (
        f'<p class="caption">{said}Window of {number(int(window.mask.sum()))} px, {window.fit} fitted to the points of '
        f"each method; marked: the smallest std with more than half of the window covered. {explained}</p>"
    )
    inside = f'<div class="wide">{table(f"figures-{c.key}{_key(window.name)}", head, body)}</div>{caption}'
    return section(f"Figures · {escape(window.name)}", inside)


def _cell(mean: float, half: float, kind: str) -> str:
    if not math.isfinite(mean):
        return "–"
    if kind == "count":
        return number(round(mean))
    factor = 100.0 if kind == "share" else 1.0
    value = mean * factor
    three_figures = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 1
    decimals = {"time": 1, "share": 1 if value >= 10 else 2, "figure": 4}.get(kind, min(three_figures, 5))
    text = f"{value:,.{decimals}f}".replace(",", "\u202f") + (" %" if kind == "share" else "")
    if math.isfinite(half) and kind != "time":
        half *= factor
        two_figures = max(0, 1 - math.floor(math.log10(half))) if half > 0 else 0
        text += f"<small>± {half:.{min(two_figures, 6)}f}</small>"
    return text


def _key(name: str) -> str:
    return "".join(ch if ch.isalnum() else "-" for ch in name)


def _detection(c: Comparison) -> str:
    """Draw the true bounces, what each method detected, and its regional pattern as captured."""
    figures = []
    if c.truth is not None:
        bounce, _ = bounces(c.truth, c.least_alpha)
        alpha = np.where(np.isfinite(c.truth.x_p), np.nan_to_num(c.truth.alpha, nan=0.0), np.nan)
        figures.append(
            _map(
                f"{c.key}truth",
                "Truth: share α of bounced light",
                alpha,
                Scale("magma", 0.0, min(1.0, float(np.nanpercentile(alpha, 99.5))), "α"),
                f"Modulation of the bounced fringes over that of the direct ones. Outlined: α ≥ {c.least_alpha:g}. "
                "Grey: no direct light.",
                bounce,
            )
        )
    for name, result in c.results.items():
        maps = result.maps
        if maps.score is not None and name in METHODS:
            figures.append(
                _map(
                    f"{c.key}detected-{_key(name)}",
                    f"{escape(name)}: detected region",
                    maps.score,
                    Scale.of(np.maximum(maps.score, 1e-2), "gray", "statistic, logarithmic", logarithmic=True),
                    f"The statistic that is compared with the threshold; {per_cent(float(maps.interreflection.mean()))}"
                    " of the picture detected, outlined.",
                    maps.interreflection,
                )
            )
        if maps.regional_pattern is not None:
            pattern = maps.regional_pattern.astype(np.float32)
            figures.append(
                _map(
                    f"{c.key}regional-{_key(name)}",
                    f"{escape(name)}: regional pattern as captured",
                    pattern,
                    Scale("gray", 0.0, max(float(np.percentile(pattern, 99.8)), 1.0), "DN"),
                    "A picture of round two. Inside the outline there should be clean fringes, and nothing that could "
                    "light it elsewhere."
                    + ("" if maps.lit is None else f" {per_cent(float(maps.lit.mean()))} of the projector is lit."),
                    maps.interreflection,
                )
            )
    return grid("Where bounces are", figures)


def _surfaces(c: Comparison) -> str:
    """Draw every method's surface from one viewpoint."""
    with_points = {name: r.maps.points for name, r in c.results.items() if r.maps.points is not None}
    if not with_points:
        return ""
    aimed = next(iter(with_points.values())) if c.truth is None else np.where(
        np.isfinite(c.truth.x_p)[..., None], c.truth.points, np.nan
    )  # fmt: skip
    view = Viewpoint.of(aimed)
    shown = {"truth": aimed, **with_points} if c.truth is not None else with_points
    figures = []
    for name, points in shown.items():
        shade = view.shaded(points, planes_of_scan(points))
        what = "What is really there." if name == "truth" and c.truth is not None else _points_said(points)
        source = Scale("gray", -0.1, 1.0).png(shade)
        drawn = picture(source, view.size, f"{name}: surface seen from the right and above")
        figures.append(figure(f"{c.key}surface-{_key(name)}", escape(name), drawn, what))
    return grid("Surfaces from one viewpoint", figures)


def _points_said(points: NDArray[np.float32]) -> str:
    return f"{number(int(np.isfinite(points[..., 2]).sum()))} points; dark: strays without a neighbourhood."


def _errors(c: Comparison, window: Window) -> str:
    rows = [r for r in c.rows if r.window == window.name]
    reach = reach_of(rows)
    factor, unit = (1000.0, "µm") if reach < 0.5 else (1.0, "mm")
    cut = window_around(window.mask)
    figures = []
    for row in rows:
        off = distances(c.results[row.method], window)
        found = off[np.isfinite(off)]
        std = f"std {found.std():.3g} mm, " if found.size else ""
        figures.append(
            _map(
                f"{c.key}error-{_key(window.name)}-{_key(row.method)}",
                escape(row.method),
                off[cut] * factor,
                Scale("RdBu_r", -reach * factor, reach * factor, unit),
                f"{std}{per_cent(found.size / max(int(window.mask.sum()), 1))} of the window's pixels have a point.",
            )
        )
    return grid(f"Error after {window.fit} fit · {escape(window.name)}", figures)


def _notes(c: Comparison) -> str:
    said = [(name, warning) for name, result in c.results.items() for warning in result.warnings if "gate " in warning]
    items = "".join(f"<li><b>{escape(name)}</b>: {escape(warning)}</li>" for name, warning in said)
    return section("Gates that failed", f"<ul>{items}</ul>" if items else "")


def _map(
    key: str,
    title: str,
    values: NDArray[np.floating],
    scale: Scale,
    caption: str,
    region: NDArray[np.bool_] | None = None,
) -> str:
    small = shrink(values)
    size = small.shape[1], small.shape[0]
    drawn = picture(scale.png(small), size, f"{title}: map", "" if region is None else outline(region, size))
    return figure(key, title, drawn + scale.bar(), caption)
