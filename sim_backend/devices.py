"""The simulated projector and camera, as strict about their states as real ones."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    FrameFormat,
    FrameLossError,
    FrameStamp,
    FrameTimeoutError,
    Lifecycle,
    NoiseModel,
    Pixels,
)
from sim_backend.clock import VirtualClock
from sim_backend.faults import Fault, FaultSchedule, WrongExposure
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
    faults
        What goes wrong, and when.

    Attributes
    ----------
    asked
        (height, width) the picture that was asked for last, whether it came on or not.
    """

    def __init__(self, settings: ProjectorSettings, clock: VirtualClock, faults: FaultSettings | None = None) -> None:
        self.name = "simulated projector"
        self._settings = settings
        self._clock = clock
        self._life = Lifecycle(self.name)
        self._pictures: list[Picture] = []
        self._black = np.zeros((settings.height_px, settings.width_px), np.uint8)
        self._surface = Surface(self._black)
        self.asked = self._black
        self._faults = faults or FaultSettings()
        self._schedule = FaultSchedule.of_pictures(self._faults)
        self._shown = 0
        self._failing: tuple[Fault, int] | None = None

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

    @property
    def fault(self) -> Fault | None:
        """What is the matter with the picture that was shown last."""
        return self._failing[0] if self._failing else None

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
        former, self.asked = self.asked, self._pictures[index]
        self._shown, number = self._shown + 1, self._shown
        match self._fault_of(number):
            case Fault.FREEZE:
                return self._clock.now()
            case Fault.LAG:
                return self._hand_over(former)
        return self._hand_over(self.asked)

    def _fault_of(self, number: int) -> Fault | None:
        if self._failing is None or number >= self._failing[1]:
            fault = self._schedule.at(number)
            lasting = self._faults.freeze_pictures if fault is Fault.FREEZE else self._faults.lag_pictures
            self._failing = None if fault is None else (fault, number + lasting)
        return self.fault

    def darken(self) -> None:
        """Show black."""
        self._life.require("darken", *(s for s in DeviceState if s is not DeviceState.CLOSED))
        self.asked = self._black
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


@dataclass(frozen=True)
class _Exposure:
    """One that was triggered: its number, when it begins, its and the projector's fault, and what should be seen."""

    number: int
    begin: float
    fault: Fault | None
    projector_fault: Fault | None
    asked: Picture


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

    Attributes
    ----------
    wrong_exposures
        Those that did not show what the projector was asked for. Tests compare with it; nothing else may.
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
        self._own_exposure_us = settings.exposure_us
        self._sensor = Sensor(settings)
        self._optics = optics
        self._projector = projector
        self._clock = clock
        self._random = random
        self._faults = faults
        self._life = Lifecycle(self.name)
        self._schedule = FaultSchedule.of_exposures(faults)
        self._exposures = self._opened_at = 0
        self._away_until = -math.inf
        self._pending: deque[_Exposure] = deque()
        self._former: Pixels | None = None
        self.wrong_exposures: list[WrongExposure] = []

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

    @property
    def exposures(self) -> int:
        """How many were triggered since the camera was made."""
        return self._exposures

    def look_at(self, optics: Optics) -> None:
        """Have another scene before the lens from now on; noise, faults, counts and the exposure go on."""
        self._optics = replace(optics, camera=self._settings)

    def set_exposure(self, exposure_s: float) -> float:
        """Expose so long until the camera is configured again; returns it, s."""
        self._life.require("set_exposure", DeviceState.CONFIGURED)
        self._expose_for(round(1e6 * exposure_s, 3))
        return self.exposure_s

    def _expose_for(self, exposure_us: float) -> None:
        if exposure_us == self._settings.exposure_us:
            return
        self._settings = self._settings.model_copy(update={"exposure_us": exposure_us})
        self._optics = replace(self._optics, camera=self._settings)

    def open(self) -> None:
        """Connect.

        Raises
        ------
        DeviceNotFoundError
            The camera was unplugged, and is not back yet.
        """
        self._life.check("open")
        if self._clock.now() < self._away_until:
            raise DeviceNotFoundError(f"{self.name} is not there", "Check its cable and power.")
        self._life.move("open")
        self._opened_at = self._exposures

    def configure(self) -> FrameFormat:
        """Say what frames will look like."""
        self._life.move("configure")
        self._expose_for(self._own_exposure_us)
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
        number, begin = self._exposures, self._clock.now()
        self._exposures += 1
        fault = self._schedule.at(number)
        if fault is Fault.LOST:
            back = self._faults.camera_back_after_s
            self._away_until = math.inf if back is None else begin + back
            self._life.move("fail")
            raise DeviceLostError(
                f"{self.name} does not answer any more (exposure {number})",
                "Check its cable and power, then start again.",
            )
        if self._pending:
            begin = max(begin, self._pending[-1].begin + self.exposure_s)
        self._pending.append(_Exposure(number, begin, fault, self._projector.fault, self._projector.asked))

    def fetch(self, out: Pixels, timeout_s: float) -> FrameStamp:
        """Wait for the oldest frame that was triggered and write it to ``out`` (height, width).

        Raises
        ------
        FrameTimeoutError
            It does not come within ``timeout_s``.
        FrameLossError
            It is incomplete, or its number says that others were lost.
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
        exposure = self._pending[0] if self._pending else None
        ready = math.inf if exposure is None else self._ready_at(exposure)
        if exposure is None or ready > deadline:
            if ready == math.inf and self._pending:
                self._pending.popleft()
            self._clock.sleep_until(deadline)
            number = self._exposures if exposure is None else exposure.number
            raise FrameTimeoutError(
                f"{self.name}: no frame within {timeout_s:g} s (exposure {number})",
                "Check that the trigger reaches the camera, and that the timeout exceeds exposure and read-out.",
            )
        self._clock.sleep_until(ready)
        self._pending.popleft()
        if exposure.fault in (Fault.INCOMPLETE, Fault.ID_JUMP):
            what = "is incomplete" if exposure.fault is Fault.INCOMPLETE else "is not the next one: frames were lost"
            raise FrameLossError(
                f"{self.name}: frame {exposure.number} {what}",
                "The sequence is to be taken again; where this happens often, check the cable and the bandwidth.",
            )
        self._photograph(exposure, out)
        return FrameStamp(exposure.number - self._opened_at, exposure.begin, self._clock.now())

    def _ready_at(self, exposure: _Exposure) -> float:
        """When the frame is there, s."""
        if exposure.fault is Fault.DROP:
            return math.inf
        late = self._faults.late_s if exposure.fault is Fault.LATE else 0.0
        return exposure.begin + self.exposure_s + self._settings.readout_s + late

    def _photograph(self, exposure: _Exposure, out: Pixels) -> None:
        """Write what the exposure has seen to ``out``, and what it should have seen into the books."""
        fault, scale = exposure.fault, np.float32(self._sensor.scale)
        shown = self._seen(exposure)
        right = [(1.0, exposure.asked)]
        seen = self._optics.grey(shown)
        if fault is Fault.FLICKER:
            seen = seen + np.float32(self._schedule.between(0, self._faults.flicker_dn))
        expected = seen * scale
        if fault is Fault.REPEAT and self._former is not None:
            out[...] = self._former
            expected = self._former.astype(np.float32)
        else:
            self._sensor.digitise(seen, self._random, out)
        if fault is Fault.CUT:
            first = int(self._schedule.between(0.1, 0.95) * len(out))
            out[first:] = 0
            expected = np.concatenate([expected[:first], np.zeros_like(expected[first:])])
        self._former = out.copy()
        if fault is not None or any(picture is not exposure.asked for _, picture in shown):
            error = np.asarray(expected - self._optics.grey(right) * scale, np.float32)
            if np.any(error):
                faults = tuple(f for f in (fault, exposure.projector_fault) if f is not None)
                self.wrong_exposures.append(WrongExposure(exposure.number, faults, error))

    def _seen(self, exposure: _Exposure) -> list[tuple[float, Picture]]:
        """Shares of the exposure, and the pictures that were on the surface meanwhile."""
        end = exposure.begin + self.exposure_s
        shown = self._projector.on_surface(exposure.begin, end, stale=exposure.fault is Fault.STALE)
        if exposure.fault not in (Fault.TORN, Fault.MIXED, Fault.DARK_FLASH):
            return shown
        before = self._projector.on_surface(exposure.begin, end, stale=True)[-1][1]
        now = shown[-1][1]
        if exposure.fault is Fault.TORN:
            rows = int(self._schedule.between(0.05, 0.95) * len(now))
            return [(1.0, np.concatenate([now[:rows], before[rows:]]))]
        share = self._schedule.between(0.02, 0.7)
        return [(share, before if exposure.fault is Fault.MIXED else np.zeros_like(now)), (1 - share, now)]

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
