"""The report of all experiments as one HTML page: the promises, then each experiment beside the paper."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from pathlib import Path

from scanner.comparison.page import header, page, sections
from scanner.paper.claims import Experiment, Limit
from scanner.paper.noise import FRINGES, MAPS, ROC, NoiseStudy
from scanner.report.wording import figure, number, per_cent, section, table
from scanner.studies.detection import ALPHAS, SIGMAS_DN

_TITLE = "The paper's experiments again"

_PAPER_SAYS = {
    (0.05, 10.0): "spurs at the border",
    (0.05, 20.0): "fails",
}
"""What the paper says of its Fig. 23; of the other pairs, that the region is found."""

_LEAST_IOU = 0.95


@dataclass(frozen=True)
class Chapter:
    """One experiment as it stands on the page; the maps that its pictures were made from are not kept."""

    title: str
    facts: Mapping[str, str]
    simulated: bool
    limits: Sequence[Limit]
    parts: Sequence[str]


def chapter(e: Experiment, count: int) -> Chapter:
    """Write experiment number ``count``, from 1."""
    c = e.comparison
    heading = _heading(f"experiment-{count}", f"Experiment {count} · {escape(c.title)}")
    return Chapter(c.title, c.facts, c.simulated, e.limits(), [heading, _beside_the_paper(e, count), *sections(c)])


def render(chapters: Sequence[Chapter], noise: NoiseStudy | None, command: str) -> str:
    """Write the page, as far as the experiments go; it loads nothing from anywhere."""
    parts = [_head(chapters, command), _promises(chapters, noise)]
    parts += [part for one in chapters for part in one.parts]
    if noise is not None:
        parts += [_heading("noise", "Noise study · Figs. 22 and 23"), *_noise(noise)]
    return page(_TITLE, *parts, simulated=any(one.simulated for one in chapters))


def _head(chapters: Sequence[Chapter], command: str) -> str:
    first = chapters[0] if chapters else None
    facts = {
        "Paper": "Micro-frequency shifting, Opt. Express 27(20) 28293 (2019)",
        "Date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        **({k: first.facts[k] for k in ("Camera", "Scans of each", "Version") if k in first.facts} if first else {}),
    }
    said = (
        '<p class="caption">The paper measured real objects with a camera of 4008 × 2688 px; here the same scenes are '
        "simulated by ray casting, so that the truth is known and the bounces can be taken away. Each method decodes "
        "frames of its own plan; the row without bounces is the same scene with what throws them painted black. The "
        "numbers of the paper's Tables 1 and 2 are lost, so its statements are compared, not its figures.</p>"
    )
    return header(_TITLE, facts, command, any(one.simulated for one in chapters)) + said


def _heading(key: str, title: str) -> str:
    return f'<h1 class="part" id="{key}">{title}</h1>'


def _promises(chapters: Sequence[Chapter], noise: NoiseStudy | None) -> str:
    """Everything that the project promises for these experiments, in one table."""
    rows = []
    for count, one in enumerate(chapters, 1):
        for limit in one.limits:
            shown = (number, number) if limit.limit > 1 else (per_cent, per_cent)
            cells = (
                f'<a href="#experiment-{count}">{count}</a>',
                escape(limit.window),
                limit.what,
                shown[0](limit.found),
                shown[1](limit.limit),
            )
            rows.append(_judged(limit.met, cells))
    if noise is not None:
        worst = min((noise.mean(a, s, "pooled", "iou"), a, s) for a in ALPHAS for s in SIGMAS_DN)
        where = f"worst of the nine pairs: α = {worst[1]:g}, σ = {worst[2]:g} DN"
        what = "intersection over union at 1 % false alarms, pooled χ², at least"
        cells = ('<a href="#noise">noise</a>', where, what, number(worst[0]), number(_LEAST_IOU))
        rows.append(_judged(worst[0] >= _LEAST_IOU, cells))
    head = ("Verdict", "Experiment", "Where", "What", "Found", "Limit")
    return section("What the project promises here", f'<div class="wide">{table("promises", head, rows)}</div>')


def _judged(met: bool, cells: Sequence[str]) -> tuple[str, Sequence[str]]:
    return ("passed", ("✓ met", *cells)) if met else ("failed", ("✗ missed", *cells))


def _beside_the_paper(e: Experiment, count: int) -> str:
    rows = []
    for s in e.statements:
        holds, found = s.check(e)
        verdict = {True: "✓ agrees", False: "✗ does not", None: "–"}[holds]
        cells = (verdict, escape(s.source), escape(s.says), escape(found), escape(s.remark))
        rows.append(("passed" if holds else "failed" if holds is False else "", cells))
    head = ("", "In the paper", "It says", "Found here", "What it leaves out or gets wrong")
    return section("Beside the paper", f'<div class="wide">{table(f"paper-{count}", head, rows)}</div>') if rows else ""


def _noise(noise: NoiseStudy) -> list[str]:
    rows = []
    for alpha in ALPHAS:
        for sigma in SIGMAS_DN:
            iou = {d: noise.mean(alpha, sigma, d, "iou") for d in ("variation", "misfit", "pooled")}
            best = noise.mean(alpha, sigma, "variation", "best_iou")
            alarms, border = (noise.mean(alpha, sigma, "pooled", f) for f in ("false_alarms", "border_95_px"))
            cells = (
                f"α = {alpha:g}, σ = {sigma:g} DN",
                _PAPER_SAYS.get((alpha, sigma), "found"),
                *(f"{iou['variation']:.3f} ({best:.3f})", f"{iou['misfit']:.3f}", f"<b>{iou['pooled']:.3f}</b>"),
                f"{100 * alarms:.2f} %",
                f"{border:.1f} px",
            )
            rows.append(("passed" if iou["pooled"] >= _LEAST_IOU else "failed", cells))
    head = (
        "Pair", "Paper's Fig. 23", "std|z|, IoU (best threshold)", "χ², IoU", "χ² pooled, IoU", "False alarms, pooled",
        "95 % of the border within",
    )  # fmt: skip
    seeds, (height, width) = noise.document["seeds"], noise.document["shape"]
    caption = (
        f'<p class="caption">Means over {len(seeds)} pictures of {width} × {height} px (seeds {seeds[0]} to '
        f"{seeds[-1]}), thresholds at 1 % false alarms; pixels with |Δu| below {noise.document['not_counted_px']:g} px "
        "are not counted, because two paths at one place look like one. In brackets: the threshold that suits the "
        "picture best, which the paper may have chosen by eye. The paper's rule throws the phase away: its noise floor "
        "√(2/N)·σ is 4.1 and 8.2 DN at σ = 10 and 20 DN, where a bounce of α = 0.05 varies the modulation by 2.8 DN. "
        "Its two failures are those.</p>"
    )
    inside = f'<div class="wide">{table("pairs", head, rows)}</div>{caption}'
    pictures = (
        ("fig-22", FRINGES, "Fringes of direct light, of the bounce, and of both", "The region is outlined (Fig. 22)."),
        ("fig-23", MAPS, "Detected regions", "A row for every pair, a column for every rule (Fig. 23)."),
        ("roc", ROC, "What a threshold trades", "Share of bounces found against false alarms."),
    )
    drawn = "".join(figure(key, title, _image(noise.folder / name, title), said) for key, name, title, said in pictures)
    return [section("Nine pairs of attenuation and noise", inside), section("As pictures", drawn)]


def _image(path: Path, alt: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img class="plot" src="data:image/png;base64,{data}" alt="{escape(alt)}">'
