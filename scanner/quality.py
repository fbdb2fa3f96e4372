"""Figures about a result: counts, quality per stage, and the gates that decide over exit code 4."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import NoiseModel
from scanner.config import GatesSection
from scanner.interreflection import excess_misfit
from scanner.result import Flag, Maps, ScanResult

_PACKAGES = ("mfs-scanner", "numpy", "numba", "scipy", "opencv-contrib-python-headless", "open3d")


def summarise(
    method: str,
    maps: Maps,
    *,
    simulated: bool,
    gates: GatesSection,
    noise: NoiseModel,
    frames: Mapping[str, int],
    timings_s: Mapping[str, float],
    bench: str,
    projector: str = "",
    rounds: str = "",
    exposures: Sequence[Mapping[str, Any]] = (),
    warnings: Sequence[str] = (),
) -> ScanResult:
    """Count, judge and pack a result.

    Parameters
    ----------
    method, simulated
        As in `ScanResult`.
    maps
        Per-pixel results.
    gates
        Limits from the configuration.
    noise
        The noise model that σ was computed with.
    frames
        Frames by purpose, such as ``{"round 1": 216, "repeated": 12}``.
    timings_s
        Seconds by stage.
    bench
        Where the frames come from, in words.
    projector
        What the patterns took its response to be, in words, where that is known.
    rounds
        What was decided about a second round and why, in words; empty where nothing was.
    exposures
        Figures of each exposure, as `scanner.exposures.Fused`; none where there was one.
    warnings
        Sentences for the operator; those about failed gates are added.
    """
    valid = maps.valid
    modulated = (maps.flags & Flag.LOW_MODULATION) == 0
    misfits = (maps.flags & Flag.MISFIT) != 0
    region = maps.interreflection
    counts = {
        "pixels": int(valid.size),
        "modulated": int(modulated.sum()),
        "valid": int(valid.sum()),
        "points": 0 if maps.depth is None else int(np.isfinite(maps.depth).sum()),
        "region": int(region.sum()),
        "region valid": int((region & valid).sum()),
        **{f"flag {f.name}": int(((maps.flags & f) != 0).sum()) for f in Flag},
    }
    quality: dict[str, float] = {
        "valid share": _share(valid.sum(), valid.size),
        "region share of valid": _share((region & valid).sum(), valid.sum()),
        "region coverage": _share((region & valid).sum(), region.sum()),
        "median modulation DN": _median(maps.modulation[modulated]),
        "median misfit chi2/dof": _median(maps.misfit[valid & ~region]),
    }
    for name, values, where in (
        ("median sigma x px", maps.sigma_x, valid),
        ("median sigma y px", maps.sigma_y, valid),
        ("median sigma point mm", maps.sigma_point, valid),
        ("median sigma rig mm", maps.sigma_rig, valid),
        ("median depth mm", maps.depth, valid),
        ("median epipolar distance px", None if maps.epipolar_px is None else np.abs(maps.epipolar_px), valid),
        ("median misfit round 2 chi2/dof", maps.misfit_round2, region),
    ):
        if values is not None:
            quality[name] = _median(values[where])
    judged = [
        _gate(
            "min_valid_share",
            quality["valid share"],
            gates.min_valid_share,
            quality["valid share"] >= gates.min_valid_share,
            "share of all pixels with a coordinate",
        ),
        _gate(
            "max_misfit_share",
            _share((misfits & modulated).sum(), modulated.sum()),
            gates.max_misfit_share,
            _share((misfits & modulated).sum(), modulated.sum()) <= gates.max_misfit_share,
            "share of the modulated pixels whose fringes fit no model",
        ),
    ]
    # What a regional sequence has measured is judged by its own fringes.
    last = maps.misfit if maps.misfit_round2 is None else maps.misfit_round2
    misfit = np.where(np.isfinite(last), last, maps.misfit)
    excess = excess_misfit(misfit * np.float32(maps.misfit_dof), max(maps.misfit_dof, 1), modulated)
    judged.append(
        _gate(
            "max_excess_misfit",
            excess,
            gates.max_excess_misfit,
            maps.misfit_dof == 0 or excess <= gates.max_excess_misfit,
            "misfit of the better quarter of the pixels over that of noise alone",
        )
    )
    said = list(warnings)
    said += [
        f"gate {g['name']} failed: {g['meaning']} is {g['value']:.3f}, the limit is {g['limit']:g}"
        for g in judged
        if not g["passed"]
    ]
    if not all(g["passed"] for g in judged[1:]):
        said.append(
            "fringes that fit nowhere come from another order of the frames than the plan's, another phase convention, "
            "another plan, a moving object or a projector response that is far from linear"
        )
    return ScanResult(
        method,
        simulated,
        maps,
        {
            "bench": bench,
            **({"projector response": projector} if projector else {}),
            **({"rounds": rounds} if rounds else {}),
            **({"exposures": [dict(e) for e in exposures]} if exposures else {}),
            "counts": counts,
            "frames": dict(frames),
            "timings_s": dict(timings_s),
            "quality": quality,
            "gates": judged,
            "noise": {"read_dn": noise.read_dn, "dn_per_electron": noise.dn_per_electron},
            "versions": _versions(),
        },
        said,
    )


def exposures_said(result: ScanResult) -> str:
    """What each exposure was good for, in words; empty where there was one."""
    return ", ".join(
        f"{1e3 * e['exposure_s']:.4g} ms for {100 * e['used_share']:.1f} %" for e in result.summary.get("exposures", ())
    )


def passed(result: ScanResult) -> bool:
    """Whether a result passes all its gates."""
    return all(g["passed"] for g in result.summary["gates"])


def _gate(name: str, value: float, limit: float, ok: bool, meaning: str) -> dict[str, Any]:
    return {"name": name, "value": value, "limit": limit, "passed": bool(ok), "meaning": meaning}


def _share(part: int | np.integer[Any], whole: int | np.integer[Any]) -> float:
    return float(part) / float(whole) if whole else 0.0


def _median(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
