"""What a device could have left behind."""

from __future__ import annotations

import os
from pathlib import Path

import psutil

_SHARED = Path("/dev/shm")


def shared_memory() -> set[str]:
    """Names of shared memory, but for what tests hold that run beside this one.

    Semaphores are none of the drivers', and other programs' come and go.
    """
    if not _SHARED.exists():
        return set()
    names = {name for name in os.listdir(_SHARED) if not name.startswith("sem.")}
    return names.difference(*map(_held, _beside())) if names else names


def _beside() -> set[int]:
    """Processes of the other workers that this one's parent has started."""
    this = psutil.Process()
    parent = this.parent()
    family = {this.pid, *(child.pid for child in this.children(recursive=True))}
    return set() if parent is None else {child.pid for child in parent.children(recursive=True)} - family


def _held(pid: int) -> set[str]:
    try:
        maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace")
    except OSError:  # it has just gone
        return set()
    places = (line.split(maxsplit=5)[-1] for line in maps.splitlines() if f"{_SHARED}/" in line)
    return {Path(place).name for place in places}
