"""A display that is not there: scans a frame buffer out at its refreshes and has the pictures come on a surface."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import xxhash
from numpy.typing import NDArray

from sim_backend.surface import Picture, Surface

_WHILE_COPIED_S = 0.0005
_COPY_LASTS_AT_MOST_S = 0.010
_KNOWN_PICTURES = 64
_REMEMBERED_S = 12.0
"""Longer than the longest exposure, after whose end the pictures during it are asked for."""


class Display:
    """Scans a frame buffer out, picture by picture, in a thread of its own.

    A display swaps whole pictures between two refreshes; an X server without a screen copies them in at any time. So
    the scan-out waits until nothing is being written any more, as for the swap.

    Parameters
    ----------
    frame_buffer
        (height, width) view of what others write to.
    surface
        Where the pictures come on.
    refresh_hz
        Refreshes per second; they happen at multiples of the period on the machine's monotonic clock.
    phase
        When within the period from one multiple to the next the frame buffer is scanned out, 0..1.
    latency_s
        From the scan-out until the picture is on the surface, s.
    on_change
        Called with (moment, picture) at each scan-out of a new picture, ``moment`` (s) when it comes on the surface.
    """

    def __init__(
        self,
        frame_buffer: NDArray[np.uint8],
        surface: Surface,
        refresh_hz: float,
        phase: float,
        latency_s: float,
        on_change: Callable[[float, Picture], None],
    ) -> None:
        self.latency_s = latency_s
        self._frame_buffer = frame_buffer
        self._surface = surface
        self._period = 1 / refresh_hz
        self._phase = phase
        self._on_change = on_change
        self._black = self._picture = self._shown = np.zeros(frame_buffer.shape, np.uint8)
        self._read = self._black.copy()
        self._known: OrderedDict[int, Picture] = OrderedDict({_digest(self._black): self._black})
        self._frozen_until = -math.inf
        self._drop = 0
        self._dark = False
        self.scan_outs = self.changes = self.dropped = self.skipped = 0
        self._known_until = -math.inf
        self._progress = threading.Condition()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="display", daemon=True)

    def start(self) -> None:
        """Begin to scan out."""
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._end.set()
        if self._thread.ident is not None:
            self._thread.join()

    def catch_up(self, moment: float) -> None:
        """Wait until it is known what is on the surface up to ``moment``, s; at most for a second."""
        with self._progress:
            self._progress.wait_for(lambda: self._known_until >= moment, 1.0)

    def freeze(self, seconds: float) -> None:
        """Show the present picture for ``seconds``, whatever the frame buffer holds."""
        self._frozen_until = time.monotonic() + seconds

    def drop(self, changes: int) -> None:
        """Show the old picture one refresh longer at each of the next ``changes`` new pictures."""
        self._drop = changes

    def black_out(self, dark: bool) -> None:
        """Switch the lamp off or on again."""
        self._dark = dark

    def _run(self) -> None:
        _go_before_others()
        refresh = math.floor(time.monotonic() / self._period - self._phase)
        while True:
            refresh += 1
            moment = (refresh + self._phase) * self._period
            if self._end.wait(max(0.0, moment - time.monotonic())):
                return
            late = math.floor((time.monotonic() - moment) / self._period)
            if late > 0:  # this thread was not let in; what was to be seen then is gone
                self.skipped += late
                refresh += late
                moment += late * self._period
            self._scan_out(moment)

    def _scan_out(self, moment: float) -> None:
        self.scan_outs += 1
        if moment >= self._frozen_until and self._changed(self._picture):
            if self._drop:
                self._drop -= 1
                self.dropped += 1
            else:
                self._picture = self._latch()
        shown = self._black if self._dark else self._picture
        if shown is not self._shown:
            self._shown = shown
            self.changes += 1
            self._surface.appear(moment + self.latency_s, shown)
            self._on_change(moment + self.latency_s, shown)
        self._surface.forget(moment - _REMEMBERED_S)
        with self._progress:
            self._known_until = moment + self._period + self.latency_s
            self._progress.notify_all()

    def _changed(self, picture: Picture) -> bool:
        # Read first: comparing a view of one channel in four takes twice as long.
        self._read[...] = self._frame_buffer
        return not np.array_equal(self._read, picture)

    def _latch(self) -> Picture:
        """What was just read, once it is whole; equal pictures are one and the same array."""
        give_up = time.monotonic() + _COPY_LASTS_AT_MOST_S
        while True:
            picture = self._read.copy()
            time.sleep(_WHILE_COPIED_S)
            if not self._changed(picture) or time.monotonic() > give_up:
                break
        digest = _digest(picture)
        known = self._known.pop(digest, picture)
        self._known[digest] = known
        if len(self._known) > _KNOWN_PICTURES:
            self._known.popitem(last=False)
        return known


def _go_before_others() -> None:
    """Have the calling thread keep its time however busy the machine is, as a display does, where that is allowed."""
    if sys.platform == "linux":
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def _digest(picture: Picture) -> int:
    return xxhash.xxh3_64_intdigest(picture.data)
