"""Everything after acquisition, on recorded frames: a take, as far as it goes, or a folder of images."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

from drivers import NoiseModel, Pixels
from scanner.config import GatesSection, ScanSection
from scanner.decoding import Decoder
from scanner.exposures import ExposurePass, fuse, read_plan
from scanner.images import ImagesError, RecordedFrames
from scanner.integrity import check_sequence
from scanner.methods import METHODS, Method, RoundFrames
from scanner.quality import summarise
from scanner.response import corrected_for
from scanner.result import ScanResult
from scanner.rig import Rig
from scanner.take import Take, TakeError

Report = Callable[[str], None]
"""Is told in words how far the processing is."""


def process_take(
    take: Take, scan: ScanSection, gates: GatesSection, rig: Rig | None, report: Report = lambda _: None
) -> ScanResult:
    """Decode a take as far as it goes.

    Damaged sequences are left out and said so; an axis whose frequencies no longer reach over the projector is left
    out; without a complete round two the bounce region holds what round one tells.

    Raises
    ------
    TakeError
        Round one holds nothing that can be decoded.
    PlanError
        No axis can be told from the sequences that are there.
    """
    method = METHODS[str(take.manifest["method"])]
    # What was recorded is planned again, whatever is allowed today.
    allowed = take.manifest.get("config", {}).get("scan", {}).get("max_regional_sequences", scan.max_regional_sequences)
    scan = scan.model_copy(update={"max_regional_sequences": max(allowed, len(take.rounds) - 1)})
    began = time.perf_counter()
    decoder = Decoder(method, scan, take.noise, rig)
    warnings = list(take.problems)
    if take.status != "completed":
        warnings.append(f"the recording is {take.status}" + (f": {take.reason}" if take.reason else ""))
    if 1 not in take.rounds:
        raise TakeError(f"{take.path}: round one was not begun", "There is nothing to process; scan again.")
    first, noise, exposures = _collect(take, 1, method, decoder, warnings, report)
    timings = {"read and demodulate round 1": time.perf_counter() - began}
    began = time.perf_counter()
    report("decoding round 1")
    planned = decoder.first(first, noise)
    timings["decode round 1"] = time.perf_counter() - began
    frames = {"round 1": sum(len(s.frames) for s in take.sequences(1).values())}
    for number in sorted(take.rounds)[1:] if scan.rounds != 1 else []:
        began = time.perf_counter()
        again, noise, _ = _collect(take, number, method, decoder, warnings, report)
        report(f"decoding round {number}")
        planned = decoder.regional(again, noise)
        timings[f"decode round {number}"] = time.perf_counter() - began
        frames[f"round {number}"] = sum(len(s.frames) for s in take.sequences(number).values())
    if planned is not None and (take.status != "completed" or 2 not in take.rounds):
        decoder.give_up_regional(replace(planned, mask=None))
    assert decoder.used_noise is not None
    return summarise(
        method.name,
        decoder.maps,
        simulated=take.simulated,
        gates=gates,
        noise=decoder.used_noise,
        frames=frames,
        timings_s=timings,
        bench=f"{take.manifest['bench'].get('name', 'unknown bench')}, take {take.manifest['uid']}",
        exposures=exposures,
        projector=corrected_for(take.rounds[1].get("response"), (take.manifest.get("rig") or {}).get("metadata", {})),
        rounds=decoder.decision,
        warnings=[*warnings, *decoder.warnings],
    )


def process_images(
    recorded: RecordedFrames,
    scan: ScanSection,
    gates: GatesSection,
    rig: Rig | None,
    report: Report = lambda _: None,
) -> ScanResult:
    """Decode a folder of images; one round, by the method that ``scan`` names.

    Raises
    ------
    ImagesError
        The images do not hold what their plan says.
    """
    method = METHODS[scan.method]
    began = time.perf_counter()
    decoder = Decoder(method, scan, recorded.noise, rig)
    frames = method.collect(recorded.plan, recorded.frame_format)
    for number, pixels in recorded.sequences():
        fringes = recorded.plan.sequences[number]
        report(f"sequence {number + 1} of {len(recorded.plan.sequences)}: {fringes.label}")
        found = check_sequence(pixels, fringes, recorded.frame_format.saturated_dn)
        if not found.good:
            names = [p.name for p in recorded.files[number]]
            raise ImagesError(
                f"{recorded.folder}: the images {names[0]} to {names[-1]} do not show sequence "
                f"{number + 1} ({fringes.label}): "
                + "; ".join(f.message if f.frame < 0 else f"{names[f.frame]}: {f.message}" for f in found.findings),
                "Correct the order of `files` or of `sequences`, or the phase convention, in the plan file.",
            )
        frames.add(number, pixels)
    timings = {"read and demodulate": time.perf_counter() - began}
    began = time.perf_counter()
    report("decoding")
    decoder.first(frames)
    timings["decode"] = time.perf_counter() - began
    assert decoder.used_noise is not None
    return summarise(
        method.name,
        decoder.maps,
        simulated=False,
        gates=gates,
        noise=decoder.used_noise,
        frames={"images": recorded.plan.frame_count},
        timings_s=timings,
        bench=f"images of {recorded.folder.name}",
        warnings=decoder.warnings,
    )


def _collect(
    take: Take, number: int, method: Method, decoder: Decoder, warnings: list[str], report: Report
) -> tuple[RoundFrames, NoiseModel | None, list[dict[str, Any]]]:
    """Frames of a round, the exposures fused where there are several; then their noise and figures as well."""
    plan, series = read_plan(take.rounds[number])
    count = len(plan.sequences)
    passes: list[RoundFrames] = (
        [method.collect(plan, take.frame_format)]
        if series is None
        else [ExposurePass(plan, take.frame_format, method) for _ in series.made_s]
    )
    for recorded in take.sequences(number):
        exposure, sequence = divmod(recorded, count)
        which = plan.sequences[sequence].label + ("" if series is None else f", {series.label(exposure)}")
        report(f"round {number}, sequence {recorded + 1} of {count * len(passes)}: {which}")
        try:
            pixels = take.frames(number, recorded)
        except TakeError as error:
            warnings.append(f"left out: {error.message}")
            continue
        passes[exposure].add(sequence, pixels)
    if series is None:
        return passes[0], None, []
    report(f"fusing the exposures of round {number}")

    def read(exposure: int, sequence: int) -> Pixels:
        return take.frames(number, exposure * count + sequence, verify=False)

    fused = fuse(method, plan, series, cast("list[ExposurePass]", passes), read, decoder.noise_at)
    warnings += fused.warnings
    return fused.frames, fused.noise, fused.figures
