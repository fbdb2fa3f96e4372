"""One scan from configuration to result folder: what `scan` does, as a function."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from drivers import Bench, DisplayLatency, HardwareError, LatencyBound
from scanner.acquisition import Acquisition, Listener
from scanner.config import ConfigError, LoadedConfig, Problem, open_bench
from scanner.decoding import Decoder
from scanner.exposures import ExposureSeries, agree
from scanner.folder import ResultFolder, write_result
from scanner.methods import METHODS
from scanner.quality import summarise
from scanner.response import corrected_for, response_of
from scanner.result import ScanResult
from scanner.rig import Rig
from scanner.take import TakeWriter

if TYPE_CHECKING:
    from scanner.patterns import Plan

DISPLAY_LATENCY = "display_latency"
"""Name of the latency among the notes of a rig."""


def run_scan(
    loaded: LoadedConfig,
    out: Path,
    overwrite: bool,
    listener: Listener,
    ready: Callable[[Bench], None] = lambda bench: None,
) -> tuple[ScanResult, Path]:
    """Scan and write the result folder.

    Parameters
    ----------
    loaded
        A valid configuration.
    out
        The result folder; an existing one is refused unless ``overwrite``.
    listener
        Is told how it goes.
    ready
        Called with the open bench before anything is projected: whatever has to be placed before it.

    Returns
    -------
    result, path
        The result and its folder.

    Raises
    ------
    OperatorError
        Whatever goes wrong; the recording is kept, and the projector is dark.
    """
    config = loaded.config
    method = METHODS[config.scan.method]
    began = time.perf_counter()
    with ResultFolder(out, overwrite=overwrite) as folder:
        with open_bench(loaded) as bench:
            ready(bench)
            opened = time.perf_counter()
            rig = find_rig(loaded, bench)
            if isinstance(bench, LatencyBound):
                bench.use_latency(latency_of(rig))
            response = response_of(rig.metadata) if config.scan.correct_response else None
            light = None if response is None else response.values
            plan = replace(method.first_round(config.scan, bench.projector_size), response=light)
            exposures = agree(bench, config.scan.exposures)
            rounds = config.scan.rounds_to_record(method.rounds)
            with _begin_take(folder.path / "take", loaded, bench, rig, plan, rounds, exposures) as take:
                decoder = Decoder(method, config.scan, bench.noise, rig)
                for warning in decoder.warnings:  # before anything is projected
                    listener.note(warning)
                acquisition = Acquisition(bench, method, config.scan, decoder, take, listener, light, exposures)
                maps = acquisition.run()
            simulated, name = bench.simulated, bench.name
        assert decoder.used_noise is not None
        timings = {"open bench": opened - began, **acquisition.timings_s}
        frames = {f"round {r}": n for r, n in acquisition.frames.items()} | {"repeated": acquisition.repeats}
        result = summarise(
            method.name,
            maps,
            simulated=simulated,
            gates=config.gates,
            noise=decoder.used_noise,
            frames=frames,
            timings_s=timings,
            bench=name,
            projector=corrected_for(plan.response, rig.metadata),
            rounds=decoder.decision,
            exposures=acquisition.exposure_figures,
            warnings=[*loaded.warnings, *acquisition.notes, *decoder.warnings],
        )
        write_result(
            folder.path,
            result,
            rig=rig,
            config_yaml=loaded.effective_yaml("rig.json"),
            ply=config.output.ply,
            report=config.output.report,
        )
        if not config.output.keep_take:
            folder.discard_take()
    for notice in folder.notices:
        listener.note(notice)
    return result, folder.out


def find_rig(loaded: LoadedConfig, bench: Bench) -> Rig:
    """Rig of the configuration or of the bench, checked against the bench's sizes.

    Raises
    ------
    ConfigError
        There is none, or it belongs to another camera or projector.
    """
    if loaded.rig_path is not None:
        rig = Rig.load(loaded.rig_path)
    elif bench.rig is not None:
        rig = Rig.from_json(dict(bench.rig))
    else:
        raise _refused(
            loaded,
            f"found null, expected a rig: bench {bench.name} has none of its own",
            "calibrate, then name its rig.json",
        )
    fmt = bench.frame_format
    for what, found, wanted in (
        ("camera", tuple(rig.camera.size), (fmt.width, fmt.height)),
        ("projector", tuple(rig.projector.size), tuple(bench.projector_size)),
    ):
        if found != wanted:
            raise _refused(
                loaded,
                f"the rig's {what} has {found[0]} × {found[1]} px, the bench's has {wanted[0]} × {wanted[1]} px",
                f"name the rig that was calibrated with this {what} at this resolution",
            )
    return rig


def latency_of(rig: Rig) -> DisplayLatency | None:
    """The display latency that was measured with this rig; None where none was."""
    document = rig.metadata.get(DISPLAY_LATENCY)
    return None if document is None else DisplayLatency.from_json(document)


def measure_latency(loaded: LoadedConfig, progress: Callable[[int, int], None]) -> tuple[DisplayLatency, Path | None]:
    """Measure the display latency of a bench and keep it with the configuration's rig.

    Returns
    -------
    latency, path
        The latency, and the rig file that now holds it; None where the configuration names no rig in our own format.

    Raises
    ------
    HardwareError
        The bench has no display whose latency could be measured, or the measurement failed.
    """
    with open_bench(loaded) as bench:
        if not isinstance(bench, LatencyBound):
            raise HardwareError(
                f"bench {bench.name} knows by itself when a pattern is on the surface",
                "Nothing is to be measured: scan.",
            )
        latency = bench.measure_latency(progress)
    path = loaded.rig_path
    if path is None or path.suffix != ".json":
        return latency, None
    rig = Rig.load(path)
    replace(rig, metadata={**rig.metadata, DISPLAY_LATENCY: latency.to_json()}).save(path)
    return latency, path


def _refused(loaded: LoadedConfig, what: str, remedy: str) -> ConfigError:
    return ConfigError.of([Problem(str(loaded.path), None, None, "rig", what, remedy)])


def _begin_take(
    path: Path,
    loaded: LoadedConfig,
    bench: Bench,
    rig: Rig,
    plan: Plan,
    rounds: int,
    exposures: ExposureSeries | None,
) -> TakeWriter:
    noise = bench.noise
    return TakeWriter.create(
        path,
        frame_format=bench.frame_format,
        slots=rounds * plan.frame_count * (1 if exposures is None else len(exposures)),
        manifest={
            "method": loaded.config.scan.method,
            "bench": dict(bench.describe()),
            "config": loaded.config.model_dump(mode="json"),
            "plans": [plan.to_json() if exposures is None else exposures.recorded(plan)],
            "simulated": bench.simulated,
            "rig": rig.to_json(),
            "noise": None if noise is None else {"read_dn": noise.read_dn, "dn_per_electron": noise.dn_per_electron},
        },
        clock=bench.clock,
    )
