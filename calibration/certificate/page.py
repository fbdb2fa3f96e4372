"""The page: what is said, and in which order."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from calibration.acceptance.figures import Figure, Quantity, Verdict
from calibration.certificate.document import GUIDELINE, Certificate
from calibration.certificate.plates import artefact_section
from calibration.certificate.rig import rig_section
from calibration.certificate.wording import KINDS, MARKS, amount, deviation, expanded
from scanner.report.wording import number, section, table

_KEY_QUANTITIES = (
    Quantity.PROBING_FORM,
    Quantity.PROBING_SIZE,
    Quantity.SPHERE_SPACING,
    Quantity.FLATNESS,
    Quantity.REPEATABILITY,
    Quantity.BOUNCE_STD,
)


def render(certificate: Certificate) -> str:
    """Write a certificate as one self-contained HTML page."""
    stamp = '<div class="stamp" role="note">SIMULATED DATA</div>' if certificate.simulated else ""
    body = (
        _header(certificate),
        _key_figures(certificate.figures),
        _findings(certificate),
        _summary(certificate.figures),
        *(artefact_section(e) for e in certificate.evaluations),
        rig_section(certificate.rig, certificate.calibration),
        _reading(),
        _versions(certificate),
    )
    report, here = files("scanner.report"), files("calibration.certificate")
    style = "".join((place / name).read_text("utf-8") for place, name in ((report, "report.css"), (here, "style.css")))
    if certificate.simulated:
        # Printed sheets carry the stamp in their margin.
        style += '@page{@top-center{content:"SIMULATED DATA";font:bold 10pt sans-serif;color:#c8102e}}'
    script = (report / "viewer.js").read_text("utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Acceptance certificate{' (simulated)' if certificate.simulated else ''}</title>"
        f"<style>{style}</style></head><body>{stamp}<main>{''.join(body)}</main>"
        f"<script>{script}</script></body></html>\n"
    )


def _header(certificate: Certificate) -> str:
    verdict, limited = certificate.verdict, [f.verdict for f in certificate.figures if f.limit_mm is not None]
    kept = f"{limited.count(Verdict.PASS)} of {len(limited)} limits are kept"
    sentence = {
        Verdict.PASS: f"passed: all {len(limited)} limits are kept",
        Verdict.FAIL: f"failed: {limited.count(Verdict.FAIL)} of {len(limited)} limits are exceeded",
        Verdict.UNCERTAIN: f"no decision: {kept}, the rest lie within the uncertainty",
        Verdict.MISSING: f"not passed: {kept}, the rest was not measured or not decided",
        Verdict.REPORTED: "reported without limits",
    }[verdict]
    facts = {
        "Bench": certificate.bench,
        "Date": certificate.created.replace("T", " ").replace("+00:00", " UTC"),
        "Artefacts": len(certificate.evaluations),
        **certificate.conditions,
    }
    listed = "".join(
        f"<div><dt>{escape(str(k))}</dt><dd>{escape(number(v))}</dd></div>"
        for k, v in facts.items()
        if v not in (None, "")
    )
    simulated = (
        '<p class="simulated">SIMULATED DATA<small>no light was involved</small></p>' if certificate.simulated else ""
    )
    return (
        f'<header><div><h1>Acceptance certificate</h1><p class="under">{GUIDELINE}</p>'
        f'<p class="verdict {KINDS[verdict]}">{MARKS[verdict]} {sentence}</p><dl>{listed}</dl></div>'
        f"{simulated}</header>"
    )


def _key_figures(figures: list[Figure]) -> str:
    tiles = []
    for quantity in _KEY_QUANTITIES:
        measured = [f for f in figures if f.quantity is quantity and f.value_mm is not None]
        if not measured:
            continue
        worst = max(measured, key=lambda f: abs(f.value_mm or 0.0))
        small = f"worst of {len(measured)}" if len(measured) > 1 else escape(worst.artefact)
        if quantity is Quantity.BOUNCE_STD:
            before = [f for f in figures if f.quantity is Quantity.BOUNCE_STD_ROUND_ONE]
            small = f"round one alone: {deviation(next(f.value_mm for f in before if f.artefact == worst.artefact))}"
        elif worst.noise_mm is not None:
            small += f"; noise alone: {deviation(worst.noise_mm)}"
        tiles.append(f"<div><h3>{quantity.label}</h3><p>{deviation(worst.value_mm)}</p><small>{small}</small></div>")
    inside = "".join(tiles)
    return f'<section class="tiles" id="key-figures" aria-label="Key figures">{inside}</section>' if inside else ""


def _findings(certificate: Certificate) -> str:
    found = certificate.calibration.get("findings") or []
    items = "".join(
        f"<li><b>{'Refused' if f.get('refuses') else 'Note'}:</b> {escape(str(f.get('what', '')))} "
        f"<i>{escape(str(f.get('remedy', '')))}</i></li>"
        for f in found
        if isinstance(f, dict)
    )
    return f'<section class="warnings"><h2>Findings of the calibration</h2><ul>{items}</ul></section>' if items else ""


def _summary(figures: list[Figure]) -> str:
    rows = []
    for f in figures:
        cells = (
            f'<span class="mark">{MARKS[f.verdict]}</span> {f.verdict}',
            escape(f.quantity.label),
            escape(f.artefact),
            f"<b>{_with_uncertainty(f.value_mm, f.expanded_mm)}</b>",
            "–" if f.limit_mm is None else number(f.limit_mm),
            "–" if f.noise_mm is None else _with_uncertainty(f.noise_mm, f.noise_std_mm or 0.0),
            number(f.points) + (f" − {number(f.rejected)}" if f.rejected else "") if f.points else "–",
            escape(f.note),
        )
        rows.append((KINDS[f.verdict], cells))
    if not rows:
        return section("Figures", '<p class="empty">Nothing was measured and nothing was asked for.</p>')
    head = (
        "Verdict",
        "Figure",
        "Artefact",
        "Value ± U (k&nbsp;=&nbsp;2), mm",
        "Limit, mm",
        "Noise alone ± σ, mm",
        "Points − left out",
        "Remarks",
    )
    return section("Figures", f'<div class="wide">{table("figures", head, rows)}</div>')


def _with_uncertainty(value: float | None, u: float) -> str:
    return amount(value, u) + ("" if value is None or u == 0 else f" ± {expanded(u)}")


def _reading() -> str:
    rows = (
        (
            "Decision",
            "ISO 14253-1: pass where |value| + U stays within the limit, fail where |value| − U exceeds it. Between "
            "the two neither can be stated.",
        ),
        (
            "U",
            "Expanded uncertainty for k = 2 by the noise of the points as the scanner predicts it and by the "
            "calibration of the artefact. It holds no share of the scanner's systematic errors: those are what the "
            "figures measure.",
        ),
        (
            "PF, F",
            "Range of the distances from a Gaussian sphere or plane with all points alike, after at most 3 of 1000 "
            "points were left out. A range grows with noise and number of points even where the form is perfect: "
            "“noise alone” is what Gaussian noise of the predicted size gives for it, ± its standard deviation. What "
            "exceeds that is form.",
        ),
        ("PS, SD", "Measured minus calibrated diameter, and measured minus calibrated distance of two balls."),
        (
            "Points",
            "Chosen by where their viewing rays meet the artefact, within the limit of incidence, and never by their "
            "deviation.",
        ),
        (
            "Inter-reflection",
            "Deviations in the region where a mirror's bounce was detected, and in a rim around it, from an element "
            "through the surface outside. No guideline has this test.",
        ),
        (
            "Repeatability",
            "Standard deviation over repeated scans of an artefact that was not moved; of a point along its viewing "
            "ray (pooled over the pixels), and of the measured length.",
        ),
        (
            "Departures",
            "The guideline asks for many positions of each artefact, spread over the measuring volume; this page holds "
            "those listed above, and judges each by itself.",
        ),
    )
    items = "".join(f"<dt>{name}</dt><dd>{text}</dd>" for name, text in rows)
    return section("How to read this", f'<dl class="reading">{items}</dl>')


def _versions(certificate: Certificate) -> str:
    if not certificate.versions:
        return ""
    text = ", ".join(f"{escape(str(k))} {escape(str(v))}" for k, v in certificate.versions.items())
    return f'<p class="versions">Software: {text}</p>'
