"""What the certificate says about the rig: its parameters and how surely the solver knows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from calibration.certificate.wording import amount, expanded
from scanner.report.wording import listing, number, section
from scanner.rig import Rig

_UNITS = {"translation": "mm", "rotation": "rad", "bend": "mm"}
_PIXELS = ("fx", "fy", "cx", "cy")
_LISTED = {
    "baseline_mm", "baseline_standard_uncertainty_mm", "rms_camera_px", "rms_projector_px", "rms_stereo_px",
    "expected_rms_camera_px", "expected_rms_projector_px", "parameters", "values", "standard_uncertainty",
    "interval_95", "covariance", "correlation", "terms", "poses", "poses_dropped", "findings",
}  # fmt: skip


def rig_section(rig: Rig | None, calibration: Mapping[str, Any]) -> str:
    """Show the rig and its calibration; whatever key is missing is said to be."""
    tables = (
        _parameters(calibration),
        listing("reprojection", "Reprojection, RMS", _reprojection(calibration)),
        listing("views", "Poses and lens models", _views(calibration)),
        listing("geometry", "Rig", {} if rig is None else _geometry(rig, calibration)),
        listing("validity", "Belongs to the calibration", _further(calibration)),
    )
    inside = "".join(tables)
    missing = "" if calibration else '<p class="empty">The rig carries no notes of a calibration.</p>'
    return section("Calibration", f'{missing}<div class="tables">{inside}</div>' if inside or missing else "")


def _parameters(calibration: Mapping[str, Any]) -> str:
    names, values = calibration.get("parameters"), calibration.get("values")
    if not _sequence(names) or not _sequence(values):
        return ""
    assert names is not None
    assert values is not None
    sigma = calibration.get("standard_uncertainty")
    stated = list(sigma) if _sequence(sigma) and sigma is not None else [None] * len(names)
    rows = "".join(
        f"<tr><th>{escape(str(name))}</th><td>{amount(value, u)}</td>"
        f"<td>{'–' if u is None else expanded(float(u))}</td><td>{_unit(str(name))}</td></tr>"
        for name, value, u in zip(names, values, stated, strict=False)
    )
    head = "<tr><th>Parameter</th><th>Value</th><th>u</th><th></th></tr>"
    return f'<div><h3>Parameters</h3><table id="parameters"><thead>{head}</thead><tbody>{rows}</tbody></table></div>'


def _unit(name: str) -> str:
    group, _, term = name.partition(".")
    if term in _PIXELS:
        return "px"
    return _UNITS.get(group, _UNITS.get(term.partition("_")[0], ""))


def _reprojection(calibration: Mapping[str, Any]) -> dict[str, str]:
    listed = {}
    for key, name in (("camera", "camera"), ("projector", "projector"), ("stereo", "both")):
        rms, expected = calibration.get(f"rms_{key}_px"), calibration.get(f"expected_rms_{key}_px")
        if rms is not None:
            listed[name] = f"{number(rms)} px" + ("" if expected is None else f" (expected {number(expected)} px)")
    return listed


def _views(calibration: Mapping[str, Any]) -> dict[str, str]:
    listed = {}
    poses, dropped = calibration.get("poses"), calibration.get("poses_dropped")
    if _sequence(poses) and poses is not None:
        listed["poses used"] = str(len(poses))
    if _sequence(dropped) and dropped:
        listed["poses dropped"] = ", ".join(str(p) for p in dropped)
    terms = calibration.get("terms")
    for name, chosen in terms.items() if isinstance(terms, Mapping) else ():
        listed[f"distortion, {name}"] = (", ".join(map(str, chosen)) if _sequence(chosen) else str(chosen)) or "none"
    return listed


def _geometry(rig: Rig, calibration: Mapping[str, Any]) -> dict[str, str]:
    baseline, sigma = float(np.linalg.norm(rig.translation)), calibration.get("baseline_standard_uncertainty_mm")
    turned = math.degrees(math.acos(np.clip((np.trace(rig.rotation) - 1) / 2, -1, 1)))
    listed = {
        "baseline": f"{amount(baseline, sigma)} mm" + ("" if sigma is None else f" ± {expanded(float(sigma))} mm"),
        "rotation between the axes": f"{turned:.4g}°",
    }
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        listed[name] = f"{lens.size[0]} × {lens.size[1]} px"
    return listed


def _further(calibration: Mapping[str, Any]) -> dict[str, Any]:
    """What the solver passed through: board, date, temperature, focus, and scales of σ."""
    return {
        key: value
        for key, value in calibration.items()
        if key not in _LISTED and isinstance(value, str | int | float) and value != ""
    }


def _sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)
