"""`scan doctor` as a function."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from drivers.errors import OperatorError
from drivers.examination import Finding, Verdict
from scanner.config import LoadedConfig
from scanner.doctor.bounded import CutShortError, bounded
from scanner.doctor.examinations import examine_bench, examine_devices
from scanner.doctor.machine import Machine, machine_findings, measure

_MACHINE_S = 10.0


def run_doctor(
    loaded: LoadedConfig | None, folder: Path, report: Callable[[str], None] = lambda what: None
) -> list[Finding]:
    """Look at machine and devices, and judge a configuration.

    Parameters
    ----------
    loaded
        The configuration, or None to look at the machine alone.
    folder
        Where the recording would go.
    report
        Is told what is being looked at.

    Returns
    -------
    Findings, in the order they are to be read; a scan cannot start where one is a `Verdict.FAULT`.
    """
    return list(_findings(loaded, folder, report))


def _findings(loaded: LoadedConfig | None, folder: Path, report: Callable[[str], None]) -> Iterator[Finding]:
    report("looking at the machine")
    machine: Machine | None = None
    try:
        (machine,) = bounded(_MACHINE_S, measure, folder)
        yield from machine_findings(machine)
    except (OperatorError, CutShortError) as error:
        remedy = "Check the disk that holds this folder (dmesg), or record to another one with --out."
        yield Finding("disk", str(folder), Verdict.FAULT, f"looking at this machine {error}", remedy)
    report("looking for devices")
    yield from examine_devices(loaded)
    if loaded is None:
        return
    report("looking at the bench's own devices")
    examination = examine_bench(loaded)
    of_bench = None if examination is None else list(examination)
    # What it needs of the rig is answered below.
    yield from (finding for finding in of_bench or () if finding.topic != "rig")
    report("judging the configuration")
    from scanner.doctor.readiness import judge

    yield from judge(loaded, machine, of_bench)
