"""The camera's own time, to tell frames that began before they were asked for."""

from __future__ import annotations

import time

from drivers.genicam.features import Features

_LATCH = ("TimestampLatch", "TimestampLatchValue")
_TRIAL_S = 0.02
_OTHER_CLOCK_NS = 60_000_000_000
"""Frames that seem to be as much too old are stamped by another clock than the one that is read."""


class CameraTime:
    """Reads the clock of a camera that lets it be read, in the unit and from the beginning of its frames' time stamps.

    Parameters
    ----------
    features
        Of the camera.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        self._readable = features.first(*_LATCH[:1]) is not None and features.first(*_LATCH[1:]) is not None
        if self._readable:
            # Older cameras count ticks of their own, frames come in ns.
            host, camera = time.monotonic_ns(), self._read()
            time.sleep(_TRIAL_S)
            host, camera = time.monotonic_ns() - host, self._read() - camera
            self._readable = abs(camera - host) < 0.2 * host

    def now_ns(self) -> int | None:
        """The present time; None where it cannot be read."""
        return self._read() if self._readable else None

    @staticmethod
    def is_before(t_ns: int | None, moment_ns: int | None) -> bool:
        """Whether a frame with time stamp ``t_ns`` began before ``moment_ns``; False where that is not known."""
        return t_ns is not None and moment_ns is not None and 0 < moment_ns - t_ns < _OTHER_CLOCK_NS

    def _read(self) -> int:
        self._features.execute(_LATCH[0])
        return int(self._features.read(_LATCH[1]))
