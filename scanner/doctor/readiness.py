"""Whether a scan with one configuration could start: plan, rig, latency, disk and memory, judged before anything runs.

The devices are judged by the bench kind itself; see `scanner.doctor.examinations`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from drivers.errors import OperatorError
from drivers.examination import Finding, Verdict
from scanner.config import LoadedConfig
from scanner.doctor.machine import GB, Machine
from scanner.methods import METHODS
from scanner.patterns import Plan
from scanner.rig import Rig
from scanner.rig_uncertainty import covariance_fault
from scanner.session import latency_of

RESERVE = 1.2
"""Free disk space must be so many times what the planned frames fill: sequences are taken again, results are added."""

NEEDS_LATENCY = ("rig", "display latency")
"""Topic and item of a finding by which a bench kind says that it waits by the latency measured with the rig."""

_FASTEST_HZ = 60.0
_FRAMES_ON_THEIR_WAY = 16
# Measured peak of decoding 18 sequences of 12 frames: 535 bytes for each camera pixel.
_BYTES_PER_PIXEL, _BYTES_PER_PIXEL_AND_SEQUENCE = 100, 30
# Mean, gain and what saturates; the fused frames of a sequence come to them.
_BYTES_PER_PIXEL_AND_EXPOSURE = 12


@dataclass(frozen=True)
class Planned:
    """What a scan will record.

    Parameters
    ----------
    plan, rounds
        First round, and how many rounds there are at most.
    size
        (width, height) of a frame, px.
    pixel_bytes
        1 or 2.
    exposures
        How many a round has.
    """

    plan: Plan
    rounds: int
    size: tuple[int, int]
    pixel_bytes: int
    exposures: int = 1

    @property
    def frames(self) -> int:
        """Frames of all rounds."""
        return self.rounds * self.plan.frame_count * self.exposures

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame."""
        return self.size[0] * self.size[1] * self.pixel_bytes

    @property
    def memory_bytes(self) -> int:
        """About the largest memory of the scan: two sequences of frames, and what decoding keeps of every sequence."""
        longest = max(len(s) for s in self.plan.sequences)
        kept = _BYTES_PER_PIXEL + _BYTES_PER_PIXEL_AND_SEQUENCE * len(self.plan.sequences)
        if self.exposures > 1:
            kept += 4 * longest + _BYTES_PER_PIXEL_AND_EXPOSURE * self.exposures
        return 2 * longest * self.frame_bytes + kept * self.size[0] * self.size[1]


def judge(loaded: LoadedConfig, machine: Machine | None, of_bench: Sequence[Finding] | None) -> Iterator[Finding]:
    """Judge everything that a scan needs beside its devices.

    Parameters
    ----------
    loaded
        A valid configuration.
    machine
        What was measured; None where that failed.
    of_bench
        What the bench kind found of itself; None where it does not examine itself.
    """
    settings = loaded.bench_settings
    kind = loaded.config.bench.kind
    yield Finding("configuration", str(loaded.path), Verdict.OK, f"valid; bench {kind}")
    for warning in loaded.warnings:
        yield Finding("configuration", str(loaded.path), Verdict.WARNING, warning)
    if of_bench is None:
        text = f"benches of the kind {kind} do not examine themselves: whether their devices are there is not known"
        yield Finding("configuration", "devices", Verdict.NOTE, text)
    rig, findings = _rig(loaded, of_bench)
    yield from findings
    if rig is not None:
        yield from _covariance(rig)
        yield from _sizes(rig, settings)
        yield from _latency(rig, of_bench or ())
    planned = _planned(loaded, rig)
    if isinstance(planned, Finding):
        yield planned
    elif machine is not None:
        yield from storage(planned, machine, exposure_s_of(settings))


def storage(planned: Planned, machine: Machine, exposure_s: float | None) -> Iterator[Finding]:
    """Judge disk and memory for the planned frames.

    Parameters
    ----------
    planned
        What will be recorded.
    machine
        What was measured.
    exposure_s
        Of the camera, s; None where not known. No frame comes faster.
    """
    width, height = planned.size
    total = planned.frames * planned.frame_bytes
    what = f"{planned.frames} frames of {width} × {height} px are {total / GB:.2f} GB"
    if machine.free_bytes < RESERVE * total:
        text = f"{what}; {RESERVE:g} × as much must be free, {machine.free_bytes / GB:.2f} GB are"
        yield Finding("disk", "space", Verdict.FAULT, text, "Free some space, or record to another disk with --out.")
    else:
        yield Finding("disk", "space", Verdict.OK, f"{what}; {machine.free_bytes / GB:,.0f} GB are free")
    rate = machine.write_bytes_per_s
    if rate is not None:
        fastest = _FASTEST_HZ if exposure_s is None else min(_FASTEST_HZ, 1 / exposure_s)
        needed = fastest * planned.frame_bytes
        text = f"writes {rate / 1e6:,.0f} MB/s; at most {fastest:.3g} frames/s make {needed / 1e6:,.0f} MB/s"
        if rate < needed:
            yield Finding("disk", "rate", Verdict.WARNING, text, "The scan will wait for it; a faster disk would not.")
        else:
            yield Finding("disk", "rate", Verdict.OK, text)
    need, there = planned.memory_bytes, machine.available_bytes
    text = f"the scan takes about {need / GB:.2g} GB, {there / GB:.1f} GB are available"
    if there >= need:
        yield Finding("memory", "for this scan", Verdict.OK, text)
    else:
        # The estimate is rough: only what is far off is sure to fail.
        verdict = Verdict.FAULT if there < need / 2 else Verdict.WARNING
        yield Finding("memory", "for this scan", verdict, text, "Close other programs, or use fewer camera pixels.")
    on_their_way, shared = _FRAMES_ON_THEIR_WAY * planned.frame_bytes, machine.shared_free_bytes
    if shared is not None and shared < on_their_way:
        text = f"{shared / GB:.2f} GB free; frames on their way fill {on_their_way / GB:.2f} GB"
        remedy = "Make it larger: sudo mount -o remount,size=2G /dev/shm; in a container: --shm-size=2g."
        yield Finding("memory", "/dev/shm", Verdict.WARNING, text, remedy)


def _rig(loaded: LoadedConfig, of_bench: Sequence[Finding] | None) -> tuple[Rig | None, list[Finding]]:
    """The rig as far as it can be known without opening the bench, and what there is to say of it.

    Settings of a bench that knows its own rig have a method ``rig``.
    """
    own = getattr(loaded.bench_settings, "rig", None)
    item = "own" if loaded.rig_path is None else str(loaded.rig_path)
    try:
        if loaded.rig_path is not None:
            return (rig := Rig.load(loaded.rig_path)), [Finding("rig", item, Verdict.OK, _about(rig))]
        if callable(own):
            return own(), [Finding("rig", item, Verdict.OK, "the bench knows its own")]
    except OperatorError as error:
        return None, [Finding("rig", item, Verdict.FAULT, error.message, error.remedy)]
    if of_bench is None:
        text = "the configuration names none; whether the bench has its own is known when it is open"
        return None, [Finding("rig", item, Verdict.WARNING, text, "Where it has none: calibrate, and name rig.json.")]
    text = "the configuration names none, and this bench has none of its own"
    return None, [Finding("rig", item, Verdict.FAULT, text, "Calibrate, then write `rig: rig.json` into the file.")]


def _about(rig: Rig) -> str:
    camera, projector = rig.camera.size, rig.projector.size
    source = f"; {rig.metadata['source']}" if isinstance(rig.metadata.get("source"), str) else ""
    return f"camera {camera[0]} × {camera[1]} px, projector {projector[0]} × {projector[1]} px{source}"


def _covariance(rig: Rig) -> Iterator[Finding]:
    fault = covariance_fault(rig)
    if fault is not None:
        yield Finding("rig", "covariance", Verdict.WARNING, fault)


def _sizes(rig: Rig, settings: Any) -> Iterator[Finding]:
    for name, lens in (("camera", rig.camera), ("projector", rig.projector)):
        wanted = _size_of(getattr(settings, name, None))
        if wanted is not None and wanted != tuple(lens.size):
            yield Finding(
                "rig",
                name,
                Verdict.FAULT,
                f"calibrated with {lens.size[0]} × {lens.size[1]} px, the bench's {name} has {wanted[0]} × {wanted[1]}",
                f"Name the rig of this {name} at this resolution, or calibrate again.",
            )


def _latency(rig: Rig, of_bench: Sequence[Finding]) -> Iterator[Finding]:
    """What is known of the display latency; a fault where the bench has said that it needs it and nothing is."""
    try:
        latency = latency_of(rig)
    except OperatorError as error:
        yield Finding("rig", "display latency", Verdict.FAULT, error.message, error.remedy)
        return
    if latency is not None:
        text = f"median {1e3 * latency.median_s:.0f} ms, p99 {1e3 * latency.p99_s:.0f} ms, {latency.samples} steps"
        yield Finding(
            "rig", "display latency", Verdict.OK, text + (f", {latency.measured}" if latency.measured else "")
        )
    elif any((f.topic, f.item) == NEEDS_LATENCY for f in of_bench):
        text = "not measured: nobody knows how late the projector shows a picture"
        remedy = "Measure it once: scan latency --config FILE; or set bench.settle_s."
        yield Finding("rig", "display latency", Verdict.FAULT, text, remedy)


def _planned(loaded: LoadedConfig, rig: Rig | None) -> Planned | Finding:
    settings, scan = loaded.bench_settings, loaded.config.scan
    camera, projector = (getattr(settings, name, None) for name in ("camera", "projector"))
    frame = _size_of(camera) or (None if rig is None else rig.camera.size)
    pattern = _size_of(projector) or (None if rig is None else rig.projector.size)
    if frame is None or pattern is None:
        text = "not known before the bench is open: frames, disk space and memory are not judged"
        return Finding("configuration", "plan", Verdict.NOTE, text)
    method = METHODS[scan.method]
    try:
        plan = method.first_round(scan, (pattern[0], pattern[1]))
    except OperatorError as error:
        return Finding("configuration", "plan", Verdict.FAULT, error.message, error.remedy)
    rounds = scan.rounds_to_record(method.rounds)
    return Planned(plan, rounds, (frame[0], frame[1]), 1 if _bits(camera) <= 8 else 2, len(scan.exposures))


def _size_of(section: Any) -> tuple[int, int] | None:
    """(width, height) that the settings of a device name, or that its model always has; None where they do not say."""
    width, height = getattr(section, "width_px", None), getattr(section, "height_px", None)
    if isinstance(width, int) and isinstance(height, int):
        return width, height
    size = getattr(section, "size", None)
    return size if isinstance(size, tuple) else None


def _bits(camera: Any) -> int:
    """Bits of a grey value: the setting, or what the name of a pixel format says; 16 where neither is there."""
    bits = getattr(camera, "bits", None)
    named = re.search(r"\d+", str(getattr(camera, "pixel_format", "")))
    return bits if isinstance(bits, int) else int(named[0]) if named else 16


def exposure_s_of(settings: Any) -> float | None:
    """Exposure of the camera, s, where the settings of a bench say it."""
    exposure_us = getattr(getattr(settings, "camera", None), "exposure_us", None)
    return exposure_us * 1e-6 if isinstance(exposure_us, int | float) else None
