"""Where the paper's experiments are kept while they are made: a run that was cut off goes on from here."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import scanner
from scanner.comparison import Trial
from scanner.comparison.running import Planned
from scanner.folder import OutputError, read_result, write_json
from scanner.result import ScanResult

PAPER = "paper.json"
"""What makes a folder one of this kind."""


def open_shelf(out: Path, overwrite: bool) -> Path:
    """Make the folder, or take one that an earlier run left.

    Parameters
    ----------
    out
        Where; its parent is there.
    overwrite
        Begin anew: what an earlier run left is removed.

    Raises
    ------
    OutputError
        There is something else, or the folder cannot be made.
    """
    if out.exists() and not (out.is_dir() and ((out / PAPER).is_file() or not any(out.iterdir()))):
        raise OutputError(
            f"{out} exists and is no folder of the paper's experiments", "Choose another place with --out."
        )
    try:
        if overwrite and out.exists():
            shutil.rmtree(out)
        out.mkdir(exist_ok=True)
        if not (out / PAPER).exists():
            write_json(out / PAPER, {"complete": False})
    except OSError as error:
        raise OutputError(
            f"no folder can be made at {out}: {error.strerror}", "Choose another place with --out."
        ) from None
    return out


class Shelf:
    """Scans and figures of one experiment.

    The first scan of every row stays as a result folder, for its pictures; of the others the figures alone. Each is
    kept with a fingerprint of its settings, so that what was made with others is made again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)

    def scan(self, planned: Planned, make: Callable[[Planned, Path], ScanResult]) -> ScanResult:
        """The result of a scan: the one that is there, or the one that ``make`` leaves at the path it is given."""
        place = self.folder / planned.folder
        if planned.number == 0 and self._entry(planned) is not None:
            try:
                return read_result(place)
            except OutputError:
                pass  # removed or damaged: it is made again
        result = make(planned, place)
        self._write(planned, None)
        for left in self.folder.glob(f"{planned.folder}.incomplete*"):
            shutil.rmtree(left, ignore_errors=True)
        return result

    def find(self, planned: Planned) -> list[Trial] | None:
        """Figures of a scan; None where they are not there."""
        entry = self._entry(planned)
        if entry is None or entry["trials"] is None:
            return None
        return [Trial(t["method"], t["window"], _known(t["values"]), t["number"]) for t in entry["trials"]]

    def keep(self, planned: Planned, trials: Sequence[Trial]) -> None:
        """Keep the figures of a scan; of a repetition they are all that stays."""
        self._write(planned, trials)
        if planned.number:
            shutil.rmtree(self.folder / planned.folder, ignore_errors=True)

    def _path(self, planned: Planned) -> Path:
        return self.folder / f"{planned.folder}.json"

    def _entry(self, planned: Planned) -> Mapping[str, Any] | None:
        try:
            entry: Mapping[str, Any] = json.loads(self._path(planned).read_text("utf-8"))
        except (OSError, ValueError):
            return None
        return entry if entry.get("fingerprint") == fingerprint(planned) else None

    def _write(self, planned: Planned, trials: Sequence[Trial] | None) -> None:
        kept = None if trials is None else [
            {"method": t.method, "window": t.window, "number": t.number, "values": t.values} for t in trials
        ]  # fmt: skip
        path = self._path(planned)
        partial = path.with_suffix(".partial")
        write_json(partial, {"fingerprint": fingerprint(planned), "trials": kept})
        os.replace(partial, path)


def fingerprint(planned: Planned) -> str:
    """SHA-256 of all that a scan and its figures depend on: settings and program."""
    document = planned.loaded.config.model_dump(mode="json")
    document["compare"] = {k: v for k, v in document["compare"].items() if k in ("windows", "least_alpha", "fit")}
    parts = {"name": planned.name, "program": program(), **{k: document[k] for k in ("bench", "scan", "compare")}}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@cache
def program() -> str:
    """SHA-256 of this package's sources: what another state of it has made is made again."""
    digest = hashlib.sha256()
    for file in sorted(Path(scanner.__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _known(values: Mapping[str, float | None]) -> dict[str, float]:
    return {k: float("nan") if v is None else v for k, v in values.items()}
