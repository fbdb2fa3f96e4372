"""What the operator sees in the terminal: progress with an estimate, notes, and the final table."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from scanner.acquisition import Progress, ScanState
from scanner.quality import exposures_said, passed
from scanner.result import ScanResult

if TYPE_CHECKING:
    from scanner.comparison import Row
    from scanner.design import DesignedPlan

_PLAIN_EVERY_S = 2.0


def plan_table(chosen: DesignedPlan, usual: DesignedPlan, plans: Sequence[DesignedPlan], alpha: float) -> Table:
    """Show what frames buy: designed plans of several budgets, and the paper's."""
    title = (
        f"what frames buy: bounds of one pixel; power: bounces of α = {alpha:g} that χ² finds, mean and worst over Δu"
    )
    table = Table(title=title, title_justify="left", pad_edge=False)
    for name in ("plan", "frames", "f", "steps", "σ_u, px", "wrong order", "power", "worst", "α₅₀", "worst α₅₀"):
        table.add_column(name, justify="left" if name == "plan" else "right", no_wrap=True)
    for name, plan in (("paper", usual), *(("designed", p) for p in plans)):
        mean, worst = plan.power(alpha)
        table.add_row(
            "chosen" if plan.frame_count == chosen.frame_count and name == "designed" else name,
            str(plan.frame_count),
            "+".join(str(len(f)) for f in plan.frequencies.values()),
            str(plan.steps),
            f"{plan.sigma_px:.4f}",
            f"{plan.wrong_orders:.0e}" if plan.wrong_orders > 1e-9 else "<1e-9",
            f"{mean:.3f}",
            f"{worst:.3f}",
            f"{plan.typical_bounce:.3f}",
            f"{plan.worst_bounce:.3f}",
        )
    table.caption = (
        "f: frequencies by axis; α₅₀: the bounce that is found every other time, by its part of the direct light"
    )
    table.caption_justify = "left"
    return table


_LEFT_TO_THE_REPORT = ("<0.1px %", "med mm", "AUC", "s", "prec", "recall", "rmse mm")
"""Columns of a comparison that a narrow terminal goes without, the first first."""


class Terminal:
    """Listens to a scan and shows it.

    Parameters
    ----------
    quiet
        Plain lines even on a terminal; they are used anyway where the output is no terminal.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.console = Console(stderr=False, highlight=False, soft_wrap=True)
        self._plain = quiet or not self.console.is_terminal
        self._bar: Bar | None = None
        self._task: TaskID | None = None
        self._began = self._last = time.monotonic()

    def state(self, state: ScanState, what: str) -> None:
        """Show a new state."""
        if state is ScanState.PREFLIGHT:
            self._began = time.monotonic()
        if state in (ScanState.COMPLETED, ScanState.CANCELLED, ScanState.FAILED):
            self._close()
        elif self._plain and state is not ScanState.REPEATING:
            self.console.print(what, style=None)
        if self._bar is not None and self._task is not None and state is ScanState.DECODING:
            self._bar.update(self._task, description=what)

    def frame(self, progress: Progress) -> None:
        """Show how far it is."""
        where = (
            f"round {progress.round}/{progress.rounds} · sequence {progress.sequence}/{progress.sequences} "
            f"{progress.label} · frame {progress.frame}/{progress.frames}"
        ) + (f" · attempt {progress.attempt}" if progress.attempt > 1 else "")
        if self._plain:
            now = time.monotonic()
            if now - self._last >= _PLAIN_EVERY_S or progress.done == progress.total:
                left = (now - self._began) / progress.done * (progress.total - progress.done)
                self._last = now
                self.console.print(f"  {where} · {progress.done}/{progress.total} frames, {left:.0f} s left")
            return
        if self._bar is None:
            self._bar = Bar(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(bar_width=28),
                TextColumn("{task.completed:.0f}/{task.total:.0f} frames"),
                TimeRemainingColumn(compact=True),
                console=self.console,
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task(where, total=progress.total)
        assert self._task is not None
        self._bar.update(self._task, completed=progress.done, total=progress.total, description=where)

    def note(self, text: str) -> None:
        """Show a note."""
        self.console.print(f"note: {text}", style="yellow", markup=False)

    def say(self, lines: Iterable[str]) -> None:
        """Print lines."""
        for line in lines:
            self.console.print(line, markup=False)

    @contextmanager
    def working(self) -> Iterator[Callable[[str], None]]:
        """Show what is being done; gives the function to be told of it."""
        if self._plain:
            yield lambda what: self.console.print(what, markup=False)
            return
        with self.console.status("…") as status:
            yield lambda what: status.update(what)

    @contextmanager
    def counting(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """Show how many of a number of things are done; gives the function to be told of (done, total)."""
        told = time.monotonic()

        def count(done: int, total: int) -> None:
            nonlocal told
            now = time.monotonic()
            if self._plain and (now - told >= _PLAIN_EVERY_S or done == total):
                told = now
                self.console.print(f"{what} {done} of {total}", markup=False)
            elif status is not None:
                status.update(f"{what} {done} of {total}")

        if self._plain:
            status = None
            yield count
            return
        with self.console.status(what) as status:
            yield count

    def table(self, result: ScanResult, path: Path) -> None:
        """Print the figures of a result and where it lies."""
        counts, quality = result.summary["counts"], result.summary["quality"]
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column(style="dim")
        table.add_column()
        frames = ", ".join(f"{n} in {name}" for name, n in result.summary["frames"].items() if n)
        rows: list[tuple[str, str]] = [
            ("method", result.method.upper() + ("   SIMULATED DATA" if result.simulated else "")),
            ("frames", frames),
            *([("exposures", f"{said} of the pixels")] if (said := exposures_said(result)) else []),
            *([("rounds", str(result.summary["rounds"]))] if "rounds" in result.summary else []),
            ("points", f"{counts['points']:,} of {counts['pixels']:,} pixels"),
        ]
        if counts["region"]:
            rows.append(
                ("bounce region", f"{counts['region']:,} pixels, {100 * quality['region coverage']:.1f} % measured")
            )
        if "median sigma x px" in quality:
            rows.append(("σ of x_p", f"{quality['median sigma x px']:.4f} px (median)"))
        if "median sigma point mm" in quality:
            rows.append(("σ of a point", f"{1000 * quality['median sigma point mm']:.1f} µm (median)"))
        rows.append(("time", "   ".join(f"{what} {s:.1f} s" for what, s in result.summary["timings_s"].items())))
        for gate in result.summary["gates"]:
            verdict = "passed" if gate["passed"] else "FAILED"
            rows.append((f"gate {gate['name']}", f"{verdict}: {gate['value']:.3f}, limit {gate['limit']:g}"))
        rows.append(("result", str(path)))
        for name, value in rows:
            table.add_row(name, value)
        self.console.print()
        self.console.print(table)
        for warning in result.warnings:
            self.console.print(f"warning: {warning}", style="yellow", markup=False)
        if not passed(result):
            self.console.print("the result fails its quality gates (exit code 4)", style="bold red")

    def comparison(self, rows: Sequence[Row], path: Path) -> None:
        """Print the table of a comparison."""
        columns = {
            "coverage": ("cov %", 100, "{:.1f}"),
            "std_mm": ("std mm", 1, "{:.4g}"),
            "std_ratio": ("÷ ref", 1, "{:.3g}"),
            "median_mm": ("med mm", 1, "{:.3g}"),
            "rmse_mm": ("rmse mm", 1, "{:.4g}"),
            "wrong_fringes": ("wrong %", 100, "{:.2f}"),
            "close": ("<0.1px %", 100, "{:.2f}"),
            "precision": ("prec", 1, "{:.3f}"),
            "recall": ("recall", 1, "{:.3f}"),
            "auc": ("AUC", 1, "{:.3f}"),
            "frames": ("frames", 1, "{:.0f}"),
            "seconds": ("s", 1, "{:.0f}"),
        }
        for window in dict.fromkeys(row.window for row in rows):
            mine = [row for row in rows if row.window == window]
            shown = {k: c for k, c in columns.items() if any(math.isfinite(row.mean[k]) for row in mine)}
            seeds = f", means of {mine[0].seeds} scans" if mine[0].seeds > 1 else ""
            cells = {
                name: [written.format(factor * row.mean[k]) if math.isfinite(row.mean[k]) else "–" for row in mine]
                for k, (name, factor, written) in shown.items()
            }
            methods = [row.method.upper() for row in mine]

            for name in _LEFT_TO_THE_REPORT:
                if _width([methods, *cells.values()], ["method", *cells]) > self.console.width:
                    cells.pop(name, None)
            table = Table(title=f"{window} after a fit{seeds}", title_justify="left", box=None, pad_edge=False)
            table.add_column("method", no_wrap=True)
            for name in cells:
                table.add_column(name, justify="right", no_wrap=True)
            for number, method in enumerate(methods):
                table.add_row(method, *(column[number] for column in cells.values()))
            self.console.print()
            self.console.print(table)
        self.console.print(f"report, with all columns, intervals and figures: {path / 'report.html'}", markup=False)

    def paper(self, document: Mapping[str, Any], path: Path) -> None:
        """Print what the paper's experiments reach, and where the report is."""
        table = Table(title="the paper's experiments", title_justify="left", box=None, pad_edge=False)
        for name in ("experiment", "where", "what", "found", "limit", ""):
            table.add_column(name, justify="right" if name in ("found", "limit") else "left")
        for name, experiment in document["experiments"].items():
            for limit in experiment["limits"]:
                verdict = "met" if limit["met"] else "missed"
                cells = (limit["window"], limit["what"], f"{limit['found']:.4g}", f"{limit['limit']:g}", verdict)
                table.add_row(name, *cells)
        self.console.print()
        self.console.print(table)
        self.console.print(f"report, with tables and figures: {path / 'report.html'}", markup=False)

    def detection_study(self, document: Mapping[str, Any], path: Path) -> None:
        """Print the tables of a detection study."""
        table = Table(title="detection at the limit, means over the seeds", title_justify="left", pad_edge=False)
        names = ("α", "σ, DN", "detector", "IoU (95 %)", "false alarms", "border, 95 % within", "AUC", "best IoU")
        for name in names:
            table.add_column(name, justify="left" if name == "detector" else "right")
        for row in document["pairs"]:
            iou = row["iou"]
            table.add_row(
                f"{row['alpha']:g}",
                f"{row['sigma_dn']:g}",
                row["detector"],
                f"{iou['mean']:.3f} ({iou['low']:.3f}..{iou['high']:.3f})",
                f"{100 * row['false_alarms']['mean']:.2f} %",
                f"{row['border_95_px']['mean']:.1f} px",
                f"{row['auc']['mean']:.3f}",
                f"{row['best_iou']['mean']:.3f}",
            )
        self.console.print()
        self.console.print(table)
        self.console.print(f"tables and figures: {path}", markup=False)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = self._task = None
        sys.stdout.flush()


def _width(columns: Sequence[Sequence[str]], heads: Sequence[str]) -> int:
    """Characters of a table without a box."""
    return sum(2 + max(map(len, [head, *cells])) for head, cells in zip(heads, columns, strict=True)) - 2
