"""Run all scans of a comparison and judge them: what `scan compare` does, as a function."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

from drivers import SceneTruth, TruthTeller
from scanner.comparison.judging import Row, Trial, beside_reference, distances, judge, rows_of
from scanner.comparison.page import Comparison, render
from scanner.comparison.picture import picture
from scanner.comparison.windows import Window, windows_of
from scanner.config import CompareSection, LoadedConfig
from scanner.folder import REPORT, ComparisonFolder
from scanner.methods import METHODS
from scanner.result import ScanResult

REFERENCE = "no bounces"
"""What the row of `CompareSection.reference` is called, behind the method's name."""


@dataclass(frozen=True)
class Planned:
    """One scan of a comparison: its row, method and number from 0, where it goes, and its configuration."""

    name: str
    method: str
    number: int
    folder: str
    loaded: LoadedConfig

    @property
    def reference(self) -> bool:
        """Whether it is made without bounces."""
        return self.name != self.method


class Ledger(Protocol):
    """Remembers the figures of scans that were made before."""

    def find(self, planned: Planned) -> list[Trial] | None:
        """Figures of a scan; None where it was not made."""
        ...

    def keep(self, planned: Planned, trials: Sequence[Trial]) -> None:
        """Remember the figures of a scan."""
        ...


class EmptyLedger:
    """Remembers nothing."""

    def find(self, planned: Planned) -> list[Trial] | None:
        """Nothing was made before."""
        return None

    def keep(self, planned: Planned, trials: Sequence[Trial]) -> None:
        """Nothing is kept."""


def plan_scans(
    load: Callable[[Mapping[str, object]], LoadedConfig],
    methods: Sequence[str],
    seeds: int,
    reference: Mapping[str, object] | None = None,
) -> list[Planned]:
    """All scans, the first of every method first; every configuration is checked before anything is projected.

    Parameters
    ----------
    load
        Gives the configuration with these values replaced.
    methods
        Names.
    seeds
        Scans of each method. Where the bench has a ``seed``, they count up from it; otherwise the scan is repeated.
    reference
        Values that take the bounces away: the first method scans with them as well.
    """
    rows: list[tuple[str, str, Mapping[str, object]]] = [(method, method, {}) for method in methods]
    if reference:
        rows.append((f"{methods[0]}, {REFERENCE}", methods[0], reference))
    scans = []
    for number in range(seeds):
        for name, method, more in rows:
            changes: dict[str, object] = {"scan.method": method, **more}
            first = getattr(load(changes).bench_settings, "seed", None)
            if number:
                # Of the repetitions only the figures are kept.
                changes |= {"output.keep_take": False, "output.report": False, "output.ply": False}
                if isinstance(first, int):
                    changes["bench.seed"] = first + number
            stem = method if name == method else f"{method}-reference"
            folder = stem if number == 0 else f"{stem}-{number + 1}"
            scans.append(Planned(name, method, number, folder, load(changes)))
    return scans


@dataclass(frozen=True)
class Compared:
    """What the scans of one comparison came to; ``shown`` are the first scans by row."""

    shown: Mapping[str, ScanResult]
    windows: list[Window]
    truth: SceneTruth | None
    trials: list[Trial]
    rows: list[Row]


def compare_scans(
    scans: Sequence[Planned],
    scan: Callable[[Planned], ScanResult],
    section: CompareSection,
    ledger: Ledger | None = None,
) -> Compared:
    """Make all scans and judge each.

    Parameters
    ----------
    scans
        As `plan_scans` gives them.
    scan
        Makes one of them; with 0 as its number, its maps are shown.
    section
        How is judged.
    ledger
        Where figures of scans are kept; what it knows is not scanned again, but for the scans that are shown.
    """
    ledger = EmptyLedger() if ledger is None else ledger
    shown = {p.name: scan(p) for p in scans if p.number == 0}
    truths = {p.name: _truth_of(p.loaded) for p in scans if p.number == 0 and p.reference}
    truth = _truth_of(scans[0].loaded)
    windows = windows_of(section, [r.maps for r in shown.values()], truth)
    trials: list[Trial] = []
    for p in scans:
        found = ledger.find(p)
        if found is None:
            result = scan(p) if p.number else shown[p.name]
            found = judge(p.name, result, windows, truths.get(p.name, truth), section.least_alpha, p.number)
            ledger.keep(p, found)
        trials += found
    reference = next((p.name for p in scans if p.reference), None)
    if reference is not None:
        trials = beside_reference(trials, reference)
    return Compared(shown, windows, truth, trials, rows_of(trials))


def described(
    compared: Compared, scans: Sequence[Planned], section: CompareSection, title: str, key: str = ""
) -> Comparison:
    """Put what was found into what the page shows; ``key`` tells its figures from those of others on one page."""
    return Comparison(
        title=title,
        facts=_facts(scans[0].loaded, compared.shown, max(p.number for p in scans) + 1),
        methods={p.name: _title(p) for p in scans if p.number == 0},
        results=compared.shown,
        windows=compared.windows,
        rows=compared.rows,
        truth=compared.truth,
        least_alpha=section.least_alpha,
        key=key,
    )


def document_of(compared: Compared) -> dict[str, object]:
    """JSON-ready: windows, rows, and every single scan's figures."""
    return {
        "simulated": any(r.simulated for r in compared.shown.values()),
        "windows": [_described(w) for w in compared.windows],
        "rows": [row.to_json() for row in compared.rows],
        "trials": [{"method": t.method, "window": t.window, "number": t.number, **t.values} for t in compared.trials],
    }


def run_comparison(
    scans: Sequence[Planned],
    scan: Callable[[Planned], ScanResult],
    section: CompareSection,
    folder: ComparisonFolder,
    command: Sequence[str],
) -> list[Row]:
    """Make all scans, judge each, and write report, picture and figures into ``folder``.

    Parameters
    ----------
    scans, scan, section
        As for `compare_scans`.
    folder
        Open.
    command
        The words of the command that makes it all again.

    Returns
    -------
    list
        The rows of the table, window by window.
    """
    compared = compare_scans(scans, scan, section)
    comparison, words = described(compared, scans, section, "Comparison of methods"), shlex.join(command)
    (folder.path / REPORT).write_text(render(comparison, words), encoding="utf-8")
    first = compared.windows[0]
    maps = {name: distances(result, first) for name, result in compared.shown.items()}
    mine = [r for r in compared.rows if r.window == first.name]
    picture(maps, mine, folder.path / "comparison.png", comparison.simulated)
    folder.write_json("comparison.json", {"command": words, **document_of(compared)})
    return compared.rows


def _title(p: Planned) -> str:
    title = METHODS[p.method].title
    return f"{title}; what throws bounces is black" if p.reference else title


def _truth_of(loaded: LoadedConfig) -> SceneTruth | None:
    kind = loaded.bench_kind
    return kind.truth(loaded.bench_settings) if isinstance(kind, TruthTeller) else None


def _facts(loaded: LoadedConfig, shown: Mapping[str, ScanResult], seeds: int) -> dict[str, str]:
    result = next(iter(shown.values()))
    height, width = result.maps.flags.shape
    first = getattr(loaded.bench_settings, "seed", None)
    counted = ""
    if isinstance(first, int):
        counted = f", seed {first}" if seeds == 1 else f", seeds {first} to {first + seeds - 1}"
    return {
        "Bench": str(result.summary.get("bench", "")),
        "Configuration": loaded.path.name,
        "Date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "Camera": f"{width} × {height} px",
        "Scans of each": f"{seeds}{counted}",
        "Version": str(result.summary.get("versions", {}).get("mfs-scanner", "")),
    }


def _described(window: Window) -> dict[str, object]:
    return {"name": window.name, "fit": window.fit, "pixels": int(window.mask.sum())}
