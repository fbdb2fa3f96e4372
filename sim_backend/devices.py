"""The simulated projector and camera, as strict about their states as real ones."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivers import (
    DeviceLostError,
    DeviceSettingError,
    DeviceState,
    FrameFormat,
    FrameStamp,
    FrameTimeoutError,
    Lifecycle,
    NoiseModel,
    Pixels,
)
from sim_backend.clock import VirtualClock
from sim_backend.optics import Optics, Sensor
from sim_backend.settings import CameraSettings, FaultSettings, ProjectorSettings
from sim_backend.surface import Picture, Surface

_ROUNDING_S = 1e-9


class SimulatedProjector:
    """Shows pictures on a surface: each appears at the first refresh after the latency has passed.

    Parameters
    ----------
    settings
        Of the projector.
    clock
        The bench's time; refreshes happen at its multiples of the period.
    """

    def __init__(self, settings: ProjectorSettings, clock: VirtualClock) -> None:
        self.name = "simulated projector"
        self._settings = settings
        self._clock = clock
        self._life = Lifecycle(self.name)
        self._pictures: list[Picture] = []
        self._black = np.zeros((settings.height_px, settings.width_px), np.uint8)
        self._surface = Surface(self._black)

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self._settings.width_px, self._settings.height_px

    @property
    def period_s(self) -> float:
        """Time one picture is on at least, s."""
        return 1 / self._settings.refresh_hz

    def open(self) -> None:
        """Switch on."""
        self._life.move("open")

    def configure(self) -> None:
        """Nothing to set."""
        self._life.move("configure")

    def load(self, patterns: Sequence[Picture]) -> None:
        """Take over the pictures of one sequence.

        Raises
        ------
        DeviceSettingError
            A picture is not 8-bit grey or not of the projector's size.
        """
        self._life.check("arm")
        for number, picture in enumerate(patterns):
            if picture.dtype != np.uint8 or picture.shape != self._black.shape:
                raise DeviceSettingError(
                    f"{self.name}: picture {number} is {picture.dtype} {picture.shape}, not uint8 {self._black.shape}",
                    f"Project pictures of {self.size[0]} × {self.size[1]} px, 8-bit grey.",
                )
        self._pictures = [picture.copy() for picture in patterns]
        self._life.move("arm")

    def show(self, index: int) -> float:
        """Show picture ``index``; returns when it was handed over, s."""
        self._life.require("show", DeviceState.ARMED)
        if not 0 <= index < len(self._pictures):
            raise DeviceSettingError(
                f"{self.name}: there is no picture {index} among the {len(self._pictures)} loaded ones",
                "Load the sequence again before it is shown.",
            )
        return self._hand_over(self._pictures[index])

    def darken(self) -> None:
        """Show black."""
        self._life.require("darken", *(s for s in DeviceState if s is not DeviceState.CLOSED))
        self._hand_over(self._black)

    def close(self) -> None:
        """Switch off; the surface is dark at once."""
        self._surface.appear(self._clock.now(), self._black)
        self._pictures = []
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot."""
        return {
            "name": self.name,
            "simulated": True,
            "state": self.state.name,
            **self._settings.model_dump(mode="json"),
        }

    def _hand_over(self, picture: Picture) -> float:
        now = self._clock.now()
        refresh = math.ceil((now + self._settings.latency_s) / self.period_s - _ROUNDING_S) * self.period_s
        self._surface.appear(refresh, picture)
        return now

    def on_surface(self, begin: float, end: float, *, stale: bool = False) -> list[tuple[float, Picture]]:
        """Shares of the time from ``begin`` to ``end`` (s) and the pictures that were on; earlier ones are forgotten.

        Parameters
        ----------
        begin, end
            s, ``begin`` never before that of an earlier call.
        stale
            Pretend that the latest change has not come about.
        """
        self._surface.forget(begin)
        return self._surface.during(begin, end, stale=stale)


class SimulatedCamera:
    """Photographs what the projector has on the surface.

    Parameters
    ----------
    settings
        Of the camera.
    optics
        From the projector's picture to grey values.
    projector
        The one whose light it sees.
    clock
        The bench's time.
    random
        Makes the noise.
    faults
        What goes wrong, and when.
    """

    def __init__(
        self,
        settings: CameraSettings,
        optics: Optics,
        projector: SimulatedProjector,
        clock: VirtualClock,
        random: np.random.Generator,
        faults: FaultSettings,
    ) -> None:
        self.name = "simulated camera"
        self._settings = settings
        self._sensor = Sensor(settings)
        self._optics = optics
        self._projector = projector
        self._clock = clock
        self._random = random
        self._faults = faults
        self._life = Lifecycle(self.name)
        self._exposures = 0
        self._pending: deque[tuple[int, float]] = deque()
        self._former: Pixels | None = None

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def noise(self) -> NoiseModel:
        """The true noise of a frame."""
        return self._sensor.noise

    @property
    def exposure_s(self) -> float:
        """Exposure time, s."""
        return self._settings.exposure_us * 1e-6

    def open(self) -> None:
        """Connect."""
        self._life.move("open")
        self._exposures = 0

    def configure(self) -> FrameFormat:
        """Say what frames will look like."""
        self._life.move("configure")
        return self._sensor.frame_format

    def arm(self) -> None:
        """Forget exposures that nobody has fetched."""
        self._life.move("arm")
        self._pending.clear()

    def start(self) -> None:
        """From here on a trigger exposes a frame."""
        self._life.move("start")

    def trigger(self) -> None:
        """Begin an exposure now, or when the one before has ended.

        Raises
        ------
        DeviceLostError
            The camera is set to be lost at this exposure.
        """
        self._life.require("trigger", DeviceState.RUNNING)
        number = self._exposures
        if number == self._faults.lose_camera_at:
            self._life.move("fail")
            raise DeviceLostError(
                f"{self.name} does not answer any more (exposure {number})",
                "Check its cable and power, then start again.",
            )
        begin = self._clock.now()
        if self._pending:
            begin = max(begin, self._pending[-1][1] + self.exposure_s)
        self._pending.append((number, begin))
        self._exposures += 1

    def fetch(self, out: Pixels, timeout_s: float) -> FrameStamp:
        """Wait for the oldest frame that was triggered and write it to ``out`` (height, width).

        Raises
        ------
        FrameTimeoutError
            It does not come within ``timeout_s``.
        DeviceSettingError
            ``out`` is no place for such a frame.
        """
        self._life.require("fetch", DeviceState.RUNNING)
        expected = self._sensor.frame_format
        if out.shape != expected.shape or out.dtype != expected.dtype:
            raise DeviceSettingError(
                f"{self.name}: a frame is {expected.dtype} {expected.shape}, its buffer {out.dtype} {out.shape}",
                "Allocate frames in the format that configure() returned.",
            )
        deadline = self._clock.now() + timeout_s
        number, begin = self._pending[0] if self._pending else (self._exposures, math.inf)
        ready = begin + self.exposure_s + self._settings.readout_s
        dropped = bool(self._pending) and number in self._faults.drop_at
        if dropped or ready > deadline:
            if dropped:
                self._pending.popleft()
            self._clock.sleep_until(deadline)
            raise FrameTimeoutError(
                f"{self.name}: no frame within {timeout_s:g} s (exposure {number})",
                "Check that the trigger reaches the camera, and that the timeout exceeds exposure and read-out.",
            )
        self._clock.sleep_until(ready)
        self._pending.popleft()
        if number in self._faults.repeat_frame_at and self._former is not None:
            out[...] = self._former
        else:
            shown = self._projector.on_surface(begin, begin + self.exposure_s, stale=number in self._faults.stale_at)
            self._sensor.digitise(self._optics.grey(shown), self._random, out)
            self._former = out.copy()
        return FrameStamp(frame_id=number, t_device_s=begin, t_host_s=self._clock.now())

    def stop(self) -> None:
        """No more triggers."""
        self._life.move("stop")

    def close(self) -> None:
        """Disconnect."""
        self._pending.clear()
        self._former = None
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot."""
        return {
            "name": self.name,
            "simulated": True,
            "state": self.state.name,
            **self._settings.model_dump(mode="json"),
        }
