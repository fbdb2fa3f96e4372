"""Frames of one unchanging picture, one after the other, and what each of them tells."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from drivers import Bench, DisplayLatency, HardwareError, LatencyBound, OperatorError, Pixels
from scanner.config import ScanSection
from scanner.preview.measures import Reading, exposure_hint, focus_measure, read_frame

Pattern = Literal["white", "grey", "black", "fringes"]
PATTERNS: tuple[Pattern, ...] = get_args(Pattern)

_WARM_UP_S = 0.5
_WARM_UP_FRAMES = 30
_REPEATS = 3
_SMOOTHING = 0.8


class PreviewError(OperatorError):
    """The preview was asked for something that is not there."""


def pattern_picture(pattern: str, scan: ScanSection, size: tuple[int, int]) -> NDArray[np.uint8]:
    """(height, width) picture to project: a level of the scan's fringes, or its first fringes themselves.

    Parameters
    ----------
    pattern
        ``white`` and ``black`` are the brightest and the darkest level of the scan, ``grey`` lies between.
    scan
        Says how bright fringes are, and which.
    size
        Of the projector, (width, height), px.

    Raises
    ------
    PreviewError
        There is no such pattern.
    """
    if pattern == "fringes":
        from scanner.methods import METHODS

        return METHODS[scan.method].first_round(scan, size).render(0)[0]
    levels = {"white": scan.mean + scan.amplitude, "grey": scan.mean, "black": scan.mean - scan.amplitude}
    if pattern not in levels:
        raise PreviewError(f"there is no pattern {pattern!r}", f"Choose one of {', '.join(PATTERNS)}.")
    return np.full((size[1], size[0]), round(255 * levels[pattern]), np.uint8)


@dataclass
class Live:
    """The newest frame of a bench that projects one picture.

    Parameters
    ----------
    bench
        Open; the caller darkens and closes it.
    pattern
        Name of the picture, see `pattern_picture`.
    scan
        The scan that is being prepared.
    exposure_s, period_s
        Of camera and projector where known, for `hint`.
    centre
        Middle of the part that is magnified and in which focus is measured, as shares of width and height.
    """

    bench: Bench
    pattern: str
    scan: ScanSection
    exposure_s: float | None = None
    period_s: float | None = None
    centre: tuple[float, float] = (0.5, 0.5)
    frame: Pixels = field(init=False)
    reading: Reading = field(init=False)
    best_focus: float = field(default=math.nan, init=False)
    frames_per_s: float = field(default=math.nan, init=False)
    trouble: str = field(default="", init=False)
    """What went wrong with the latest frame; empty where nothing did."""
    _former: Pixels = field(init=False)
    _at: float = field(default=math.nan, init=False)

    def begin(self) -> None:
        """Project the picture, and expose until it is surely on the surface and two frames of it are there."""
        if isinstance(self.bench, LatencyBound) and self.bench.latency is None:
            # One picture stays on, so that no latency matters; and a bench is focused before its latency is measured.
            self.bench.use_latency(DisplayLatency(0.0, 0.0, 0))
        self._picture = pattern_picture(self.pattern, self.scan, self.bench.projector_size)
        fmt = self.bench.frame_format
        self.frame, self._former = np.zeros(fmt.shape, fmt.dtype), np.zeros(fmt.shape, fmt.dtype)
        self._prepare()
        until = self.bench.clock.now() + _WARM_UP_S
        for number in range(_WARM_UP_FRAMES):
            self._expose()
            if number > 0 and self.bench.clock.now() >= until:
                break
        self.take()

    def take(self) -> None:
        """Expose one frame more and read it.

        Raises
        ------
        HardwareError
            A device failed, several times in turn where that may pass.
        """
        self._expose()
        now = time.monotonic()
        if now > self._at:
            rate = 1 / (now - self._at)
            known = math.isfinite(self.frames_per_s)
            self.frames_per_s = _SMOOTHING * self.frames_per_s + (1 - _SMOOTHING) * rate if known else rate
        self._at = now
        zone = self.zone
        full = self.bench.frame_format.saturated_dn
        focus = focus_measure(self._former[zone], self.frame[zone], full)
        self.reading = read_frame(self.frame, self.bench.frame_format, focus)
        self.best_focus = float(np.fmax(self.best_focus, focus))

    def look_at(self, centre: tuple[float, float]) -> None:
        """Move the magnified part to ``centre`` (shares of width and height); the best focus begins anew."""
        self.centre = (min(max(centre[0], 0.0), 1.0), min(max(centre[1], 0.0), 1.0))
        self.best_focus = math.nan

    @property
    def zone(self) -> tuple[slice, slice]:
        """(rows, columns) of the part in which focus is measured: half of each side, all of it inside the picture."""
        height, width = self.frame.shape
        return _half(height, self.centre[1]), _half(width, self.centre[0])

    @property
    def hint(self) -> str:
        """What to do about the exposure; empty for pictures that do not show the brightest level."""
        if self.pattern not in ("white", "fringes"):
            return ""
        return exposure_hint(self.reading, self.scan.max_saturated_share, self.exposure_s, self.period_s)

    def _prepare(self) -> None:
        self.bench.prepare([self._picture])

    def _expose(self) -> None:
        """One frame; what may pass is tried again."""
        self.frame, self._former = self._former, self.frame
        for attempt in range(1, _REPEATS + 1):
            try:
                self.bench.expose(0, self.frame)
            except HardwareError as error:
                if not error.repeatable or attempt == _REPEATS:
                    raise
                self.trouble = error.message
                self._prepare()
            else:
                if attempt == 1:
                    self.trouble = ""
                return


def _half(extent: int, centre: float) -> slice:
    """Half of ``extent`` pixels around the share ``centre`` of them."""
    start = round(min(max(centre - 0.25, 0.0), 0.5) * extent)
    return slice(start, start + extent // 2)
