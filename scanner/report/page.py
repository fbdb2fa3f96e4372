"""The page: what is said, and in which order."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from html import escape
from importlib.resources import files

import matplotlib as mpl
import numpy as np

from scanner.quality import exposures_said
from scanner.report import plates
from scanner.report.figures import Scale, picture, shrink
from scanner.report.statistics import statistics
from scanner.report.surface import LocalPlanes, median, pack_points, planes_of_scan
from scanner.report.wording import length, listing, number, per_cent, section, table, words
from scanner.result import Flag, Maps, ScanResult
from scanner.rig import Rig

_MARKS = {"passed": "✓", "failed": "✗", "none": "○"}


def render(result: ScanResult, *, rig: Rig | None = None, title: str = "Scan report") -> str:
    """Write the report of a scan as one self-contained HTML page.

    Parameters
    ----------
    result
        The scan. Beyond the documented keys of its summary, ``bench`` (name) and ``created`` (ISO 8601) are shown where
        present.
    rig
        Shown as a table.
    title
        Heading and title of the page.

    Notes
    -----
    The page loads nothing from anywhere. Maps are averaged by area and points thinned, so that it stays below about
    6 MB for any camera.
    """
    maps = result.maps
    planes = None if maps.points is None else planes_of_scan(maps.points)
    stamp = '<div class="stamp" role="note">SIMULATED DATA</div>' if result.simulated else ""
    sections = (
        _header(result, title),
        _key_figures(result),
        _warnings(result),
        _gates(result),
        "" if planes is None else section("Surface", _view(maps, planes)),
        plates.round_one(maps),
        plates.round_two(maps),
        plates.coordinates(maps),
        plates.flags(maps),
        plates.precision(maps, planes),
        statistics(maps, planes),
        _tables(result, rig),
    )
    here = files("scanner.report")
    # Printed sheets carry the stamp in their margin.
    sheet = (
        '@page{@top-center{content:"SIMULATED DATA";font:bold 10pt sans-serif;color:#c8102e}}'
        if result.simulated
        else ""
    )
    style, script = ((here / name).read_text("utf-8") for name in ("report.css", "viewer.js"))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}{' (simulated)' if result.simulated else ''}</title><style>{style}{sheet}</style>"
        f"</head><body>{stamp}<main>{''.join(sections)}</main><script>{script}</script></body></html>\n"
    )


def _header(result: ScanResult, title: str) -> str:
    gates = result.summary.get("gates", [])
    failed = sum(not g["passed"] for g in gates)
    if not gates:
        verdict, kind = "no quality gates were set", "none"
    elif failed:
        verdict, kind = f"{failed} of {len(gates)} quality gates failed", "failed"
    else:
        verdict, kind = f"all {len(gates)} quality gates passed", "passed"
    created, method = result.summary.get("created"), result.method
    facts = {
        "Method": " · ".join(filter(None, (method, _title(method)))),
        "Bench": result.summary.get("bench"),
        "Date": created and str(created).replace("T", " ").replace("+00:00", " UTC"),
        "Camera": "{1} × {0} px".format(*result.maps.flags.shape),
        "Projector": result.summary.get("projector response"),
        "Exposures": exposures_said(result) and f"{exposures_said(result)} of the pixels",
        "Rounds": result.summary.get("rounds"),
    }
    listed = "".join(f"<div><dt>{k}</dt><dd>{escape(str(v))}</dd></div>" for k, v in facts.items() if v)
    simulated = (
        '<p class="simulated">SIMULATED DATA<small>no light was involved</small></p>' if result.simulated else ""
    )
    return (
        f'<header><div><h1>{escape(title)}</h1><p class="verdict {kind}">{_MARKS[kind]} {verdict}</p>'
        f"<dl>{listed}</dl></div>{simulated}</header>"
    )


def _title(method: str) -> str | None:
    """What the method calls itself; None for one that is not installed here."""
    from scanner.methods import METHODS

    return METHODS[method].title if method in METHODS else None


def _key_figures(result: ScanResult) -> str:
    maps, summary = result.maps, result.summary
    fringes = ~plates.has(maps.flags, Flag.LOW_MODULATION)
    count = int(fringes.sum()) or math.nan
    tiles: list[tuple[str, str, str]] = []
    if maps.points is not None:
        tiles.append(("points", number(int(np.isfinite(maps.points).all(axis=2).sum())), "in the cloud"))
    coverage = int((maps.valid & fringes).sum()) / count
    tiles.append(("coverage", per_cent(coverage), "of the pixels with fringes have a coordinate"))
    if maps.sigma_point is not None:
        tiles.append(("median σ", length(median(maps.sigma_point)), "predicted, along the viewing ray"))
        if maps.sigma_rig is not None:
            tiles.append(
                ("median σ of the rig", length(median(maps.sigma_rig)), "common to neighbours and to all scans")
            )
    else:
        for axis, sigma in (("x", maps.sigma_x), ("y", maps.sigma_y)):
            if sigma is not None:
                tiles.append((f"median σ, {axis}", f"{number(median(sigma))} px", "predicted, projector coordinate"))
    share = int((maps.interreflection & fringes).sum()) / count
    tiles.append(("bounce region", per_cent(share), "of the pixels with fringes"))
    if frames := summary.get("frames"):
        kinds = dict(frames) if isinstance(frames, Mapping) else {"recorded": frames}
        repeated = kinds.pop("repeated", 0)
        parts = [f"{words(k)}: {number(n)}" if len(kinds) > 1 else words(k) for k, n in kinds.items()]
        parts += [f"{number(repeated)} repeated"] if repeated else []
        tiles.append(("frames", number(sum(kinds.values())), ", ".join(parts)))
    if summary.get("timings_s"):
        tiles.append(("time", f"{number(_total_s(summary['timings_s']))} s", "all stages"))
    shown = "".join(f"<div><h3>{n}</h3><p>{v}</p><small>{s}</small></div>" for n, v, s in tiles)
    return f'<section class="tiles" id="key-figures" aria-label="Key figures">{shown}</section>'


def _total_s(timings: Mapping[str, float]) -> float:
    return timings["total"] if "total" in timings else sum(timings.values())


def _warnings(result: ScanResult) -> str:
    if not result.warnings:
        return ""
    items = "".join(f"<li>{escape(w)}</li>" for w in result.warnings)
    return f'<section class="warnings"><h2>Warnings</h2><ul>{items}</ul></section>'


def _gates(result: ScanResult) -> str:
    rows = []
    for gate in result.summary.get("gates", []):
        kind = "passed" if gate["passed"] else "failed"
        cells = (gate["name"], number(gate.get("value")), number(gate.get("limit")), gate.get("meaning", ""))
        rows.append((kind, (f"{_MARKS[kind]} {kind}", *(escape(str(c)) for c in cells))))
    if not rows:
        return ""
    head = ("Verdict", "Gate", "Value", "Limit", "Meaning")
    return section("Quality gates", f'<div class="wide">{table("gates", head, rows)}</div>')


def _view(maps: Maps, planes: LocalPlanes) -> str:
    """Draw the interactive view, and a still picture where it cannot run."""
    described, records = pack_points(maps, planes)
    if not described["count"]:
        return '<p class="empty">No pixel has a point.</p>'
    described["palette"] = {
        name: mpl.colormaps[name](np.linspace(0, 1, 32))[:, :3].round(3).ravel().tolist()
        for name in ("viridis", "cividis")
    }
    light = np.array([-0.42, -0.56, -0.71])  # over the observer's left shoulder
    shade = shrink(np.clip(planes.normals @ light, 0, 1))
    still = picture(
        Scale("gray", -0.15, 1.0).png(shade),
        (shade.shape[1], shade.shape[0]),
        "The measured surface as the camera sees it, shaded by its local normals",
    )
    modes = {"shape": "Shape", "grey": "Grey", "depth": "Depth", "sigma": "σ", "region": "Bounce region"}
    if described["sigma_mm"] is None:
        del modes["sigma"]
    buttons = "".join(
        f'<button type="button" data-mode="{key}" aria-pressed="{str(key == "shape").lower()}">{label}</button>'
        for key, label in modes.items()
    )
    return (
        '<figure class="viewer" id="viewer">'
        f'<div class="tools" role="toolbar" aria-label="Colour by">{buttons}'
        '<button type="button" data-view="reset">Reset view</button></div>'
        '<div class="stage"><canvas tabindex="0" role="img" aria-label="Interactive three-dimensional view of the '
        'point cloud"></canvas><svg class="axes" aria-hidden="true"></svg><div class="scalebar"></div>'
        f'<div class="legend"></div><div class="still">{still}</div></div>'
        f"<figcaption>{number(described['count'])} of {number(described['shown_of'])} points, mm, camera frame "
        "(x right, y down, z away). Drag to orbit, right-drag or Shift-drag to move, scroll or pinch to zoom "
        "(click the view first), arrow keys and + − 0 work too.</figcaption></figure>"
        f'<script type="application/json" id="cloud">{json.dumps(described)}</script>'
        f'<script type="text/plain" id="records">{records}</script>'
    )


def _tables(result: ScanResult, rig: Rig | None) -> str:
    summary = result.summary
    timings = {k: v for k, v in summary.get("timings_s", {}).items() if k != "total"}
    longest = max(timings.values(), default=0) or 1
    bars = "".join(
        f"<tr><th>{words(k)}</th><td>{number(v)} s</td>"
        f'<td class="share"><i style="width:{100 * v / longest:.1f}%"></i></td></tr>'
        for k, v in timings.items()
    )
    tables = (
        f'<div><h3>Time per stage</h3><table id="timings"><tbody>{bars}</tbody></table></div>' if bars else "",
        listing("counts", "Counts", {k: v for k, v in summary.get("counts", {}).items() if k[:5] != "flag "}, "px"),
        listing("quality", "Quality", summary.get("quality") or {}),
        listing("noise", "Noise model of the camera", summary.get("noise") or {}),
        listing("rig", "Rig", {} if rig is None else _rig_figures(rig, result.maps)),
        listing("versions", "Versions", summary.get("versions") or {}),
    )
    inside = "".join(tables)
    return section("Figures", f'<div class="tables">{inside}</div>' if inside else "")


def _rig_figures(rig: Rig, maps: Maps) -> dict[str, str]:
    turned = math.degrees(math.acos(np.clip((np.trace(rig.rotation) - 1) / 2, -1, 1)))
    listed = {"baseline": f"{np.linalg.norm(rig.translation):.4g} mm", "rotation between the axes": f"{turned:.3g}°"}
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        listed[name] = f"{lens.size[0]} × {lens.size[1]} px, f {lens.matrix[0, 0]:.5g} px"
    if maps.points is not None:
        middle = np.array([median(maps.points[..., i]) for i in range(3)])
        if np.isfinite(middle).all():
            to_projector = rig.projector_centre_cam - middle
            cosine = -middle @ to_projector / (np.linalg.norm(middle) * np.linalg.norm(to_projector))
            listed["median depth"] = f"{middle[2]:.5g} mm"
            listed["triangulation angle there"] = f"{math.degrees(math.acos(np.clip(cosine, -1, 1))):.3g}°"
    return listed
