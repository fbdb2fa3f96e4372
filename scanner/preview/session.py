"""`scan preview` as a function: open the bench, show what its camera sees, leave it dark."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from rich.console import Console

from drivers import HardwareError
from scanner.config import LoadedConfig, open_bench
from scanner.preview.canvas import draw
from scanner.preview.lines import reading_line, run_lines
from scanner.preview.live import Live
from scanner.preview.window import PreviewWindow, operator_area, projected_areas, save

SAVED_SIZE = (1280, 800)
"""(width, height) of a saved picture, px, where no window gives another."""


def run_preview(
    loaded: LoadedConfig,
    pattern: str,
    console: Console,
    *,
    coloured: bool = True,
    once: bool = False,
    path: Path | None = None,
) -> None:
    """Show what the camera of a bench sees, until the operator quits.

    Parameters
    ----------
    loaded
        A valid configuration.
    pattern
        What is projected meanwhile; see `scanner.preview.live.pattern_picture`.
    console
        Where figures go when there is no screen but the projector's.
    coloured
        Mark saturated and too dark pixels.
    once
        Print one reading and end.
    path
        With ``once``: a PNG file for the picture; the frame itself goes beside it.

    Raises
    ------
    OperatorError
        The bench cannot be opened, or a device fails.
    """
    with ExitStack() as stack:
        bench = stack.enter_context(open_bench(loaded))
        stack.callback(_darken, bench)
        live = Live(bench, pattern, loaded.config.scan, *_timing(loaded, bench))
        live.begin()
        if once:
            console.print(reading_line(live), markup=False)
            if live.hint:
                console.print(live.hint, markup=False)
            if path is not None:
                frame = save(live, draw(live, SAVED_SIZE, coloured=coloured), path)
                console.print(f"saved {path} and {frame}", markup=False)
            return
        place = operator_area(projected_areas(bench.describe()))
        if place is None:
            console.print("no screen is free of the projector's picture: figures only", style="dim")
            run_lines(live, console)
        else:
            PreviewWindow(live, *place, coloured=coloured).run()


def _darken(bench: Any) -> None:
    # On the way out of trouble a projector that fails as well must not hide why.
    with suppress(HardwareError):
        bench.darken()


def _timing(loaded: LoadedConfig, bench: Any) -> tuple[float | None, float | None]:
    """Exposure of the camera and period of the projector, s, where settings and bench tell them."""
    exposure_us = getattr(getattr(loaded.bench_settings, "camera", None), "exposure_us", None)
    period_s = getattr(getattr(bench, "projector", None), "period_s", None)
    return (
        exposure_us * 1e-6 if isinstance(exposure_us, int | float) else None,
        float(period_s) if isinstance(period_s, int | float) and period_s > 0 else None,
    )
