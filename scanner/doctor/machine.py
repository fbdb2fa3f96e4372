"""The computer itself: disk, memory, processors, clock; measured, not looked up, where it matters."""

from __future__ import annotations

import os
import platform
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drivers.examination import Finding, Verdict

_CHUNK = 4 << 20
_MEASURE_S = 0.4
_MOST_WRITTEN = 512 << 20
_SLEEPS = 25
_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
_SHARED = Path("/dev/shm")
_SLOW_CLOCKS = ("hpet", "acpi_pm")

GB = 1e9


@dataclass(frozen=True)
class Machine:
    """What was measured.

    Parameters
    ----------
    folder
        Where recordings would go; the nearest existing folder above what was asked for.
    free_bytes
        Free on its disk, for this user.
    write_bytes_per_s
        Rate at which data reached the disk (fdatasync included); None where the folder may not be written.
    memory_bytes, available_bytes
        Memory of the machine, and what is available now.
    shared_free_bytes
        Free in /dev/shm, through which frames travel between processes; None where there is no such place.
    processors
        Usable by this process.
    processor_name, system
        For whoever reads the report.
    clock_source
        Of the kernel; empty where it does not say.
    governor
        Frequency governor of the first processor; empty where there is none.
    overslept_s
        By how much a sleep of 1 ms was late, median.
    """

    folder: Path
    free_bytes: int
    write_bytes_per_s: float | None
    memory_bytes: int
    available_bytes: int
    shared_free_bytes: int | None
    processors: int
    processor_name: str
    system: str
    clock_source: str
    governor: str
    overslept_s: float


def measure(folder: Path) -> Iterator[Machine]:
    """Measure the machine; one item, for `scanner.doctor.bounded.bounded`."""
    import psutil

    folder = _existing(folder)
    memory = psutil.virtual_memory()
    yield Machine(
        folder=folder,
        free_bytes=shutil.disk_usage(folder).free,
        write_bytes_per_s=_write_rate(folder),
        memory_bytes=memory.total,
        available_bytes=memory.available,
        shared_free_bytes=shutil.disk_usage(_SHARED).free if _SHARED.is_dir() else None,
        processors=len(psutil.Process().cpu_affinity())
        if hasattr(psutil.Process, "cpu_affinity")
        else os.cpu_count() or 1,
        processor_name=_processor_name(),
        system=f"{platform.system()} {platform.release()}, Python {platform.python_version()}",
        clock_source=_read(_CLOCK_SOURCE),
        governor=_read(_GOVERNOR),
        overslept_s=_overslept(),
    )


def machine_findings(machine: Machine) -> Iterator[Finding]:
    """What the measured figures mean for a scan of any kind."""
    where = str(machine.folder)
    free = machine.free_bytes / GB
    if free < 1:
        text = f"{free:.2f} GB free"
        yield Finding("disk", where, Verdict.FAULT, text, "Free some space, or record to another disk with --out.")
    else:
        yield Finding("disk", where, Verdict.OK, f"{free:,.0f} GB free")
    if machine.write_bytes_per_s is None:
        text = "you may not write here"
        yield Finding("disk", where, Verdict.FAULT, text, "Choose another folder with --out, or ask for permission.")
    else:
        yield Finding("disk", where, Verdict.OK, f"writes {machine.write_bytes_per_s / 1e6:,.0f} MB/s (measured)")
    yield Finding(
        "memory",
        "main memory",
        Verdict.OK,
        f"{machine.available_bytes / GB:.1f} GB available of {machine.memory_bytes / GB:.1f} GB",
    )
    yield from _shared_memory(machine)
    yield _processors(machine)
    yield _clock(machine)
    yield Finding("machine", "system", Verdict.OK, machine.system)


def _shared_memory(machine: Machine) -> Iterator[Finding]:
    if machine.shared_free_bytes is None:
        return
    free = machine.shared_free_bytes
    verdict, remedy = Verdict.OK, ""
    if free < 256 << 20:
        verdict = Verdict.WARNING
        remedy = "Make it larger: sudo mount -o remount,size=2G /dev/shm; in a container: --shm-size=2g."
    text = f"{free / GB:.2f} GB free; frames travel through it from the camera's process"
    yield Finding("memory", str(_SHARED), verdict, text, remedy)


def _processors(machine: Machine) -> Finding:
    text = f"{machine.processors} usable" + (f", {machine.processor_name}" if machine.processor_name else "")
    if machine.processors < 2:
        remedy = "Camera, projector and decoding share it: frames may come late. Give this machine two or more."
        return Finding("machine", "processors", Verdict.WARNING, text, remedy)
    if machine.governor == "powersave":
        remedy = "If flips or frames come late: sudo cpupower frequency-set -g performance."
        return Finding("machine", "processors", Verdict.NOTE, f"{text}, governor powersave", remedy)
    return Finding("machine", "processors", Verdict.OK, text)


def _clock(machine: Machine) -> Finding:
    source = f"{machine.clock_source}, " if machine.clock_source else ""
    text = f"{source}a sleep of 1 ms ends {1e3 * machine.overslept_s:.2f} ms late"
    if machine.clock_source in _SLOW_CLOCKS:
        remedy = "Reading this clock is slow. Boot with clocksource=tsc if the processor has a stable one."
        return Finding("machine", "clock", Verdict.WARNING, text, remedy)
    if machine.overslept_s > 2e-3:
        remedy = "Close other programs; in a virtual machine, give it processors of its own."
        return Finding("machine", "clock", Verdict.WARNING, text, remedy)
    return Finding("machine", "clock", Verdict.OK, text)


def _existing(folder: Path) -> Path:
    folder = folder.absolute()
    return next(p for p in (folder, *folder.parents) if p.is_dir())


def _write_rate(folder: Path) -> float | None:
    """Write like a recording does: chunks that cannot be compressed, each on the disk before the next."""
    chunk = os.urandom(_CHUNK)
    sync = getattr(os, "fdatasync", os.fsync)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            written, began = 0, time.perf_counter()
            while written < _MOST_WRITTEN:
                os.write(file.fileno(), chunk)
                sync(file.fileno())
                written += _CHUNK
                elapsed = time.perf_counter() - began
                if elapsed > _MEASURE_S:
                    break
            return written / elapsed
    except OSError:
        return None


def _overslept() -> float:
    late = []
    for _ in range(_SLEEPS):
        began = time.perf_counter()
        time.sleep(1e-3)
        late.append(time.perf_counter() - began - 1e-3)
    return statistics.median(late)


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""


def _processor_name() -> str:
    names = [
        line.partition(":")[2] for line in _read(Path("/proc/cpuinfo")).splitlines() if line.startswith("model name")
    ]
    return " ".join((names[0] if names else platform.processor()).split())
