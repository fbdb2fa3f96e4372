"""Acceptance: scans of calibrated artefacts with the rig that was found, their figures, and the certificate."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.acceptance.artefacts import PlaneBesideMirror, SphereBesideMirror
from calibration.acceptance.evaluation import Evaluation, evaluate
from calibration.acceptance.figures import Figure, Verdict
from calibration.acceptance.interreflection import evaluate_beside_mirror
from calibration.certificate import Certificate
from calibration.folder import CERTIFICATE, CERTIFICATE_DATA
from calibration.guide.guidance import Bar, Step
from calibration.operators import Answer, stopped, whereabouts
from calibration.settings import PlacedArtefact
from calibration.work import Work
from drivers import Bench
from scanner.folder import read_result
from scanner.result import Maps, ScanResult
from scanner.rig import Rig
from scanner.session import run_scan

STEP: Step = "acceptance"

_PLACED = "placed.json"


def run(work: Work, rig_path: Path) -> Verdict:
    """Scan every artefact of the bench file with the rig at ``rig_path`` and write the certificate.

    A scan that is there already is not made again where rig, scene, bench and method are the same.

    Raises
    ------
    StoppedError
        The operator has left.
    """
    rig = Rig.load(rig_path)
    rng = np.random.default_rng(0)
    evaluations, simulated, versions = [], False, {}
    wanted = work.settings.acceptance.artefacts
    for number, placed in enumerate(wanted, 1):
        title = f"{number:02d}-{placed.artefact.kind}"
        work.terminal.say([f"{STEP}: artefact {number} of {len(wanted)}, {placed.artefact.title}"])
        scans = _scans(work, title, placed, rig, rig_path)
        evaluations.append(_evaluated(placed, [scan.maps for scan in scans], rig, rng))
        simulated |= any(scan.simulated for scan in scans)
        versions = scans[0].summary["versions"]
    certificate = Certificate(
        # A simulated bench is called after what stands before it, which is another thing with each artefact.
        bench=getattr(work.loaded.bench_settings, "name", f"{work.loaded.config.bench.kind} bench"),
        simulated=simulated,
        evaluations=evaluations,
        limits=work.settings.acceptance.limits,
        rig=rig,
        calibration=rig.metadata.get("calibration", {}),
        conditions={
            "method": work.loaded.config.scan.method,
            "temperature, °C": work.settings.temperature_celsius,
            "notes": work.settings.notes,
        },
        versions=versions,
    )
    page = work.folder.path / CERTIFICATE
    certificate.write(work.folder.path / CERTIFICATE_DATA, page)
    verdict = certificate.verdict
    figures = [
        f"{f.artefact}, {f.quantity.label}: "
        + ("not measured" if f.value_mm is None else f"{f.value_mm:.4f} ± {f.expanded_mm:.4f} mm")
        + ("" if f.limit_mm is None else f", limit {f.limit_mm:g} mm: {f.verdict}")
        for f in certificate.figures
    ]
    conclusion = f"{verdict}; the certificate is {page}"
    bars = tuple(_bar(figure) for figure in certificate.figures)
    work.report(STEP, {"verdict": str(verdict)}, [], [*figures, conclusion], bars=bars, large=conclusion)
    return verdict


def _bar(figure: Figure) -> Bar:
    label = f"{figure.artefact}, {figure.quantity.label}"
    if figure.value_mm is None:
        return Bar(label, math.nan, figure.verdict is not Verdict.MISSING, "not measured")
    text = f"{figure.value_mm:.4f} ± {figure.expanded_mm:.4f} mm"
    if figure.limit_mm is None:
        return Bar(label, math.nan, True, text)
    share = figure.limit_mm / max(abs(figure.value_mm), 1e-9)
    return Bar(label, share, figure.verdict is Verdict.PASS, f"{text}, limit {figure.limit_mm:g}")


def _scans(work: Work, title: str, placed: PlacedArtefact, rig: Rig, rig_path: Path) -> list[ScanResult]:
    artefact, pose = placed.artefact, placed.pose
    where = f"Place it ({artefact.title}) {whereabouts(pose)}. Nothing may move until the scan is done."
    if isinstance(artefact, PlaneBesideMirror | SphereBesideMirror):
        scenes = {
            f"{title}-mirror": (where, artefact.scene(pose)),
            f"{title}-removed": (
                f"Take the mirror away ({artefact.title}), and touch nothing else.",
                artefact.scene(pose, with_mirror=False),
            ),
        }
    else:
        stays = f"Leave it ({artefact.title}) where it stands: it is scanned once more."
        scenes = {f"{title}-{i + 1}": (stays if i else where, artefact.scene(pose)) for i in range(placed.repeats)}
    return [
        _scan(work, name, what, scene, rig, rig_path, repeat)
        for repeat, (name, (what, scene)) in enumerate(scenes.items())
    ]


def _scan(
    work: Work, name: str, what: str, scene: Mapping[str, Any], rig: Rig, rig_path: Path, repeat: int
) -> ScanResult:
    out = work.folder.path / "acceptance" / name
    changes: dict[str, Any] = {"rig": str(rig_path.resolve())}
    if repeat and hasattr(work.loaded.bench_settings, "seed"):
        # A simulated bench that is opened again has the same noise again, unless it is told otherwise.
        changes["bench__seed"] = work.loaded.bench_settings.seed + repeat
    loaded = work.configured(**changes)
    config = loaded.config.model_dump(mode="json")
    placed = json.loads(
        json.dumps({"scene": dict(scene), "rig": rig.to_json(), "bench": config["bench"], "scan": config["scan"]})
    )
    if (out / _PLACED).is_file() and json.loads((out / _PLACED).read_bytes()) == placed:
        work.terminal.say([f"  {name} is there already"])
        return read_result(out)

    def ready(bench: Bench) -> None:
        if work.operator.place(bench, what, scene) is Answer.STOP:
            raise stopped()

    with work.listening(name) as listener:
        result, _ = run_scan(loaded, work.folder.new_scan(name), False, listener, ready)
    # Written last: a scan without it is made again.
    (out / _PLACED).write_text(json.dumps(placed), encoding="utf-8")
    work.operator.tell(True, "scanned")
    return result


def _evaluated(placed: PlacedArtefact, maps: list[Maps], rig: Rig, rng: np.random.Generator) -> Evaluation:
    artefact = placed.artefact
    if isinstance(artefact, PlaneBesideMirror | SphereBesideMirror):
        return evaluate_beside_mirror(artefact, maps[0], maps[1], rig, rng)
    return evaluate(artefact, maps, rig, rng, temperature_C=placed.temperature_celsius)
