"""Run all scans of a comparison and judge them: what `scan compare` does, as a function."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from drivers import SceneTruth, TruthTeller
from scanner.comparison.judging import Row, Trial, distances, judge, rows_of
from scanner.comparison.page import Comparison, render
from scanner.comparison.picture import picture
from scanner.comparison.windows import Window, windows_of
from scanner.config import CompareSection, LoadedConfig
from scanner.folder import REPORT, ComparisonFolder
from scanner.methods import METHODS
from scanner.result import ScanResult


@dataclass(frozen=True)
class Planned:
    """One scan of a comparison: its method, its number from 0, where it goes, and its configuration."""

    method: str
    number: int
    folder: str
    loaded: LoadedConfig


def plan_scans(
    load: Callable[[Mapping[str, object]], LoadedConfig], methods: Sequence[str], seeds: int
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
    """
    scans = []
    for number in range(seeds):
        for method in methods:
            changes: dict[str, object] = {"scan.method": method}
            first = getattr(load(changes).bench_settings, "seed", None)
            if number:
                # Of the repetitions only the figures are kept.
                changes |= {"output.keep_take": False, "output.report": False, "output.ply": False}
                if isinstance(first, int):
                    changes["bench.seed"] = first + number
            folder = method if number == 0 else f"{method}-{number + 1}"
            scans.append(Planned(method, number, folder, load(changes)))
    return scans


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
    scans
        As `plan_scans` gives them.
    scan
        Makes one of them; with 0 as its number, its maps are shown.
    section
        How is judged.
    folder
        Open.
    command
        The words of the command that makes it all again.

    Returns
    -------
    list
        The rows of the table, window by window.
    """
    shown = {p.method: scan(p) for p in scans if p.number == 0}
    loaded = scans[0].loaded
    truth = _truth_of(loaded)
    windows = windows_of(section, [r.maps for r in shown.values()])
    trials: list[Trial] = []
    for name, result in shown.items():
        trials += judge(name, result, windows, truth, section.least_alpha)
    for p in scans:
        if p.number:
            trials += judge(p.method, scan(p), windows, truth, section.least_alpha)
    rows = rows_of(trials)
    comparison = Comparison(
        title="Comparison of methods",
        facts=_facts(loaded, shown, max(p.number for p in scans) + 1),
        command=shlex.join(command),
        methods={name: METHODS[name].title for name in shown},
        results=shown,
        windows=windows,
        rows=rows,
        truth=truth,
        least_alpha=section.least_alpha,
    )
    (folder.path / REPORT).write_text(render(comparison), encoding="utf-8")
    first = windows[0]
    maps = {name: distances(result, first) for name, result in shown.items()}
    mine = [r for r in rows if r.window == first.name]
    picture(maps, mine, folder.path / "comparison.png", comparison.simulated)
    document = {
        "simulated": comparison.simulated,
        "command": comparison.command,
        "windows": [_described(w) for w in windows],
        "rows": [row.to_json() for row in rows],
        "trials": [{"method": t.method, "window": t.window, **t.values} for t in trials],
    }
    folder.write_json("comparison.json", document)
    return rows


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
