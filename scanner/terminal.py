"""What the operator sees in the terminal: progress with an estimate, notes, and the final table."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table

from scanner.acquisition import Progress, ScanState
from scanner.comparison import Row
from scanner.quality import passed
from scanner.result import ScanResult

_PLAIN_EVERY_S = 2.0


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
        table = Table(title="bounce region after a plane fit", title_justify="left", pad_edge=False)
        for name in ("method", "frames", "covered", "std, mm", "median |error|, mm", "> 1 mm", "seconds"):
            table.add_column(name, justify="left" if name == "method" else "right")
        for row in rows:
            table.add_row(
                row.method.upper(),
                str(row.frames),
                f"{100 * row.coverage:.1f} %",
                f"{row.std_mm:.4g}",
                f"{row.median_mm:.4g}",
                f"{100 * row.outliers:.2f} %",
                f"{row.seconds:.1f}",
            )
        self.console.print()
        self.console.print(table)
        self.console.print(f"pictures and figures: {path}", markup=False)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = self._task = None
        sys.stdout.flush()
