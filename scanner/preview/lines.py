"""The live picture where there is no screen for it: its figures in the terminal."""

from __future__ import annotations

import math
import os
import re
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group, RenderableType
from rich.live import Live as Redrawn
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from scanner.preview.canvas import focus_line, percent
from scanner.preview.live import Live

_PLAIN_EVERY_S = 1.0
_HISTOGRAM_COLUMNS = 32
_BLOCKS = " ▁▂▃▄▅▆▇█"
_KEYS_SENT = re.compile(rb"\x1b\[[0-9;]*[A-Za-z~]|\x1bO[A-Za-z]|[\x00-\x7f]")
_KEY_NAMES = {
    b" ": "space",
    b"\r": "enter",
    b"\n": "enter",
    b"\x1b": "escape",
    b"\x7f": "backspace",
    b"\t": "tab",
    b"\x1b[A": "up",
    b"\x1b[B": "down",
    b"\x1b[C": "right",
    b"\x1b[D": "left",
    b"\x1b[5~": "pageup",
    b"\x1b[6~": "pagedown",
}


def reading_line(live: Live) -> str:
    """One reading in one line."""
    reading = live.reading
    parts = [
        f"mean {100 * reading.mean:.0f} %",
        f"brightest {100 * reading.brightest:.0f} %",
        f"saturated {percent(reading.saturated_share)} ({reading.saturated} px)",
        f"too dark {percent(reading.dark_share)}",
        focus_line(live),
    ]
    if math.isfinite(live.frames_per_s):
        parts.append(f"{live.frames_per_s:.1f} frames/s")
    if live.trouble:
        parts.append(live.trouble)
    return " · ".join(parts)


def histogram_line(shares: NDArray[np.float64], columns: int = _HISTOGRAM_COLUMNS) -> str:
    """The histogram as blocks of eight heights on a root scale; what is not empty shows at least the lowest."""
    height = np.sqrt(shares.reshape(columns, -1).sum(axis=1))
    eighths = np.ceil(8 * height / max(float(height.max()), 1e-9)).astype(int)
    return "".join(_BLOCKS[e] for e in eighths)


def figures(live: Live) -> RenderableType:
    """All figures, for a terminal that is drawn anew with each frame."""
    reading = live.reading
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(width=32)
    too_much = reading.saturated_share > live.scan.max_saturated_share
    ratio = reading.focus / live.best_focus if live.best_focus > 0 else 0.0
    table.add_row("brightest 99.5 %", f"{100 * reading.brightest:.0f} %", _bar(reading.brightest))
    table.add_row("mean", f"{100 * reading.mean:.0f} %", _bar(reading.mean))
    table.add_row(
        "saturated",
        Text(f"{percent(reading.saturated_share)} ({reading.saturated:,} px)", "bold red" if too_much else ""),
        _bar(reading.saturated_share, "red"),
    )
    table.add_row("too dark", percent(reading.dark_share), _bar(reading.dark_share, "blue"))
    table.add_row("focus", focus_line(live).removeprefix("focus").lstrip(": "), _bar(ratio, "green"))
    table.add_row("grey values", "black to full scale", histogram_line(reading.histogram))
    fmt = live.bench.frame_format
    stamp = "SIMULATED DATA · " if live.bench.simulated else ""
    about = f"{stamp}{live.bench.name} · {live.pattern} · {fmt.width} × {fmt.height} px, {fmt.bits} bit"
    rows: list[RenderableType] = [Text(f"{about} · {live.frames_per_s:.1f} frames/s", "dim"), table]
    if live.hint:
        rows.append(Text(live.hint, "green" if live.hint.endswith("good") else "yellow"))
    if live.trouble:
        rows.append(Text(live.trouble, "red"))
    rows.append(Text("q quit · b best focus anew", "dim"))
    return Group(*rows)


def _bar(share: float, colour: str = "white") -> ProgressBar:
    known = min(max(share, 0.0), 1.0) if math.isfinite(share) else 0.0
    return ProgressBar(total=1.0, completed=known, width=32, complete_style=colour, finished_style=colour)


def run_lines(live: Live, console: Console) -> None:
    """Take frames and show their figures until the operator presses q or interrupts."""
    if not console.is_terminal:
        shown = -math.inf
        while True:
            live.take()
            if time.monotonic() - shown >= _PLAIN_EVERY_S:
                shown = time.monotonic()
                console.print(reading_line(live), markup=False)
    with read_keys() as typed, Redrawn(console=console, auto_refresh=False) as redrawn:
        while True:
            live.take()
            redrawn.update(figures(live), refresh=True)
            keys = typed()
            if "q" in keys:
                return
            if "b" in keys:
                live.look_at(live.centre)


@contextmanager
def read_keys() -> Iterator[Callable[[], list[str]]]:
    """Read single keys of the terminal without waiting; gives a function that returns those typed since its last call.

    Letters and figures are themselves, others have the names that windows give them, such as ``space`` and ``left``.
    Where the standard input is no terminal there are none.
    """
    if not sys.stdin.isatty():
        yield list
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)

    def typed() -> list[str]:
        ready, _, _ = select.select([sys.stdin], [], [], 0)
        return named_keys(os.read(sys.stdin.fileno(), 1024)) if ready else []

    try:
        tty.setcbreak(sys.stdin)
        yield typed
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def named_keys(read: bytes) -> list[str]:
    """Names of the keys for which a terminal sent some bytes; a key of several bytes that has no name is left out."""
    found = [_KEY_NAMES.get(sent, sent.decode("latin-1")) for sent in _KEYS_SENT.findall(read)]
    return [key.lower() for key in found if not key.startswith("\x1b")]
