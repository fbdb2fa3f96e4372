"""What runs on a LightCrafter's clock: patterns on the mirrors, the light, and pulses at the trigger outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_backend.lightcrafter.video import VideoSource

Picture = NDArray[np.uint8]
Edge = Callable[[int, bool, float], None]
"""Called with (number of the output, True for the beginning of a pulse, moment in s on the bench's clock)."""

_SHORT_PULSE_S = 20e-6
_KEPT_RUNS = 64


@dataclass(frozen=True)
class Step:
    """One pattern of a sequence.

    Parameters
    ----------
    picture
        Gives (height, width) 0..255 for the number of the video frame that it comes from.
    exposure_s, dark_s
        How long it is on, and black after it, s.
    lit
        Some LED lights it.
    pulse_2
        It begins with a pulse at TRIG_OUT_2.
    """

    picture: Callable[[int], Picture]
    exposure_s: float
    dark_s: float
    lit: bool
    pulse_2: bool


@dataclass
class Run:
    """Steps that are shown one after the other.

    Parameters
    ----------
    begin_s
        When the first one begins, s.
    steps
        In order.
    shown
        How many steps are shown; 0 for ever.
    video
        Where each round of steps begins at a refresh; None where it follows the round before.
    """

    begin_s: float
    steps: Sequence[Step]
    shown: int
    video: VideoSource | None = None
    stopped_s: float = math.inf
    told: int = field(default=0, init=False)
    """Steps whose edges were told."""

    def __post_init__(self) -> None:
        self._ends = np.cumsum([step.exposure_s + step.dark_s for step in self.steps])
        self._round_s = float(self._ends[-1])
        if self.video is not None:
            # A round that is not over when a refresh comes misses that one.
            self._round_s = math.ceil(self._round_s / self.video.period_s - 1e-9) * self.video.period_s

    @property
    def end_s(self) -> float:
        """When it ends, s; infinity where it does not."""
        return min(self.stopped_s, self.step_begin(self.shown) if self.shown else math.inf)

    def step_begin(self, number: int) -> float:
        """Give when step ``number`` begins, s, rounds counted on."""
        rounds, index = divmod(number, len(self.steps))
        before = float(self._ends[index - 1]) if index else 0.0
        return self.begin_s + rounds * self._round_s + before

    def at(self, moment: float) -> tuple[int, float]:
        """Give (number of the step, time since it began in s) at ``moment``."""
        since = moment - self.begin_s
        rounds = math.floor(since / self._round_s + 1e-12)
        index = int(np.searchsorted(self._ends, since - rounds * self._round_s + 1e-12, side="right"))
        number = rounds * len(self.steps) + min(index, len(self.steps) - 1)
        return number, moment - self.step_begin(number)

    def picture(self, number: int) -> Picture:
        """Give what step ``number`` shows."""
        frame = 0
        if self.video is not None:
            # A frame is shown one refresh after it was sent (DLPU011E figure 4-4).
            rounds = number // len(self.steps)
            frame = round((self.begin_s + rounds * self._round_s) / self.video.period_s) - 1
        return self.steps[number % len(self.steps)].picture(frame)


class Sequencer:
    """Runs sequences one at a time and knows what was on the surface.

    Parameters
    ----------
    black
        (height, width) of zeros.
    on_edge
        See `Edge`.
    """

    def __init__(self, black: Picture, on_edge: Edge) -> None:
        self._black = black
        self._on_edge = on_edge
        self._runs: list[Run] = []
        self._light: list[tuple[float, bool]] = [(-math.inf, True)]
        self.delays_s = {1: (0.0, 0.0), 2: (0.0, 0.0)}
        self.inverted = {1: False, 2: False}

    def begin(self, run: Run) -> None:
        """Run something else."""
        if self._runs:
            self.stop(run.begin_s)
        self._runs = [*self._runs[1 - _KEPT_RUNS :], run]

    def stop(self, moment: float) -> None:
        """Stop what runs at ``moment``, s; the last pattern stays on the mirrors."""
        if self._runs:
            self.tell(moment)
            self._runs[-1].stopped_s = min(self._runs[-1].stopped_s, moment)

    def running(self, moment: float) -> bool:
        """Say whether a sequence runs at ``moment``."""
        return bool(self._runs) and moment < self._runs[-1].end_s - 1e-9

    def light(self, moment: float, on: bool) -> None:
        """Switch what lights all patterns on or off."""
        self._light.append((moment, on))

    def tell(self, moment: float) -> None:
        """Tell all edges up to ``moment``, s, in order."""
        if not self._runs:
            return
        run = self._runs[-1]
        while True:
            begin = run.step_begin(run.told)
            if begin > min(moment, run.end_s) - 1e-9 or (run.shown and run.told >= run.shown):
                return
            step = run.steps[run.told % len(run.steps)]
            edges = [(1, True, begin), (1, False, begin + step.exposure_s)]
            if step.pulse_2:
                edges += [(2, True, begin), (2, False, begin + _SHORT_PULSE_S)]
            delayed = [(output, rising, at + self.delays_s[output][not rising]) for output, rising, at in edges]
            for output, rising, at in sorted(delayed, key=lambda edge: edge[2]):
                self._on_edge(output, rising, at)
            run.told += 1

    def surface(self, moment: float) -> Picture:
        """Give what is on the surface at ``moment``, s: (height, width), 0..255."""
        if not [on for at, on in self._light if at <= moment][-1]:
            return self._black
        run = next((run for run in reversed(self._runs) if run.begin_s <= moment), None)
        if run is None:
            return self._black
        # Whether the real chip keeps its last pattern is not known; the emulator does, so that nobody relies on black.
        over = moment >= run.end_s
        number, since = run.at(min(moment, run.end_s - 1e-9))
        step = run.steps[number % len(run.steps)]
        if not step.lit or (since >= step.exposure_s and not over):
            return self._black
        return run.picture(number)
