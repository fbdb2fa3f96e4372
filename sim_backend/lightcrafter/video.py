"""The video cable: what a screen sends, refresh by refresh, and a screen to send it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import DeviceSettingError, DeviceState, Lifecycle, PlayRecord, SequenceFaultError
from sim_backend.clock import VirtualClock

Frame = NDArray[np.uint8]
_ROUNDING_S = 1e-9
_LOCK_S = 0.2


class VideoSource:
    """Frames on the cable; refreshes happen at multiples of the period.

    Parameters
    ----------
    size
        (width, height), px.
    refresh_hz
        Refreshes per second.
    clock
        Time.
    """

    def __init__(self, size: tuple[int, int], refresh_hz: float, clock: VirtualClock) -> None:
        self.size = size
        self.period_s = 1 / refresh_hz
        self._clock = clock
        black = np.zeros((size[1], size[0], 3), np.uint8)
        self._changes: list[tuple[float, Frame]] = [(-math.inf, black)]
        self._there: list[tuple[float, bool]] = [(-math.inf, False)]

    def connect(self, there: bool) -> None:
        """Plug the cable in or pull it, now."""
        self._there.append((self._clock.now(), there))

    def locked(self, moment: float) -> bool:
        """Say whether a projector has locked to the signal by ``moment``, s: it takes 0.2 s."""
        since, there = [change for change in self._there if change[0] <= moment][-1]
        return there and moment - since >= _LOCK_S

    def lost_after(self, moment: float) -> float:
        """Give when the cable was pulled for the first time after ``moment``; infinity where it was not."""
        return min((at for at, there in self._there if at > moment and not there), default=math.inf)

    def send(self, moment: float, frame: Frame) -> None:
        """Have ``frame`` (height, width, RGB) sent from the first refresh after ``moment`` on."""
        refresh = self.refresh_after(moment)
        self._changes = [change for change in self._changes if change[0] < refresh - _ROUNDING_S]
        self._changes.append((refresh, frame))

    def refresh_after(self, moment: float) -> float:
        """Give the first refresh at or after ``moment``, s."""
        return math.ceil(moment / self.period_s - _ROUNDING_S) * self.period_s

    def frame(self, number: int) -> Frame:
        """Give the frame (height, width, RGB) that is sent from refresh ``number`` to the next."""
        middle = (number + 0.5) * self.period_s
        return next(frame for begin, frame in reversed(self._changes) if begin <= middle)


class SimulatedScreen:
    """A screen whose pictures go down the video cable; a `drivers.SequencePlayer`.

    Parameters
    ----------
    source
        The cable.
    clock
        Time.
    """

    def __init__(self, source: VideoSource, clock: VirtualClock) -> None:
        self.name = "simulated screen"
        self._source = source
        self._clock = clock
        self._life = Lifecycle(self.name)
        self._frames: list[Frame] = []
        self._played: tuple[float, ...] = ()

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self._source.size

    @property
    def period_s(self) -> float:
        """Time one picture is on at least, s."""
        return self._source.period_s

    def open(self) -> None:
        """Begin to send, black."""
        self._life.move("open")
        self._source.connect(True)
        self._blacken()

    def configure(self) -> None:
        """Nothing to set."""
        self._life.move("configure")

    def load(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Take over pictures (height, width) or (height, width, RGB)."""
        self._life.check("arm")
        width, height = self.size
        for picture in patterns:
            if picture.dtype != np.uint8 or picture.shape not in {(height, width), (height, width, 3)}:
                raise DeviceSettingError(f"{self.name}: picture of shape {picture.shape}", "Project others.")
        self._frames = [
            picture.copy() if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=-1) for picture in patterns
        ]
        self._life.move("arm")

    def show(self, index: int) -> float:
        """Show picture ``index``."""
        self._life.require("show", DeviceState.ARMED)
        now = self._clock.now()
        self._source.send(now, self._frames[index])
        return now

    def play(self) -> None:
        """Send all pictures, one per refresh."""
        self._life.move("start")
        first = self._source.refresh_after(self._clock.now())
        self._played = tuple(first + number * self.period_s for number in range(len(self._frames)))
        for moment, frame in zip(self._played, self._frames, strict=True):
            self._source.send(moment, frame)

    def finish(self, timeout_s: float) -> PlayRecord:
        """Wait for the end of the last picture."""
        self._life.require("finish", DeviceState.RUNNING)
        deadline = self._clock.now() + timeout_s
        end = self._played[-1] + self.period_s
        self._clock.sleep_until(min(end, deadline))
        if end > deadline:
            self.darken()
            raise SequenceFaultError(f"{self.name}: not shown within {timeout_s:g} s", "Wait longer.")
        self._rest()
        return PlayRecord(self._played, ())

    def darken(self) -> None:
        """Send black."""
        self._life.require("darken", *(s for s in DeviceState if s is not DeviceState.CLOSED))
        self._blacken()
        if self.state is DeviceState.RUNNING:
            self._rest()

    def close(self) -> None:
        """Stop sending."""
        if self.state is not DeviceState.CLOSED:
            self._source.connect(False)
        self._frames = []
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot."""
        return {"name": self.name, "simulated": True, "state": self.state.name}

    def _rest(self) -> None:
        self._life.move("stop")
        self._life.move("arm")

    def _blacken(self) -> None:
        self._source.send(self._clock.now(), np.zeros((self.size[1], self.size[0], 3), np.uint8))
