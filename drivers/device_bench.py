"""What all benches of a camera and a projector share: open in order, bring back what was lost, close in reverse."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from drivers.devices import (
    AdjustableCamera,
    Camera,
    Clock,
    Device,
    DeviceState,
    FrameFormat,
    FrameStamp,
    NoiseModel,
    Pixels,
    Projector,
    Trigger,
    WatchedProjector,
)
from drivers.errors import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    HardwareError,
    IllegalCallError,
    OperatorError,
    SequenceFaultError,
)
from drivers.latency import DisplayLatency, KeepStep, measure_latency
from drivers.refreshes import whole_refreshes

_RETRY_S = 0.5


@dataclass
class DeviceBench:
    """Camera and projector, perhaps with a trigger box; base of `SteppedBench` and `StreamedBench`.

    Parameters
    ----------
    name, simulated, rig
        See `drivers.Bench`.
    camera, projector, clock, trigger
        The devices; with no ``trigger`` box the camera is triggered by software or by the projector itself.
    settle_s
        From the hand-over of a pattern until it is surely on the surface, s. None: from the measured latency that
        `use_latency` brings.
    exposure_s
        Of the camera, s.
    timeout_s
        From the end of an exposure until its frame must have come, s.
    reconnect_s
        How long a device that was lost is waited for, s.
    whole_refreshes
        Whether another exposure than ``exposure_s`` must last a whole number of the projector's refreshes.

    Notes
    -----
    Entering opens and readies the devices in the order projector, camera, trigger box; leaving darkens the projector,
    stops the triggers and closes in reverse, whatever happened.
    """

    name: str
    camera: Camera
    projector: Projector
    clock: Clock
    settle_s: float | None = None
    exposure_s: float = 0.0
    timeout_s: float = 2.0
    simulated: bool = False
    rig: Mapping[str, Any] | None = None
    trigger: Trigger | None = None
    reconnect_s: float = 0.0
    whole_refreshes: bool = False
    latency: DisplayLatency | None = field(default=None, init=False)
    _format: FrameFormat | None = field(default=None, init=False)
    _patterns: int = field(default=0, init=False)
    _disturbed: bool = field(default=False, init=False)
    _own_exposure_s: float = field(default=0.0, init=False)
    _wanted_exposure_s: float | None = field(default=None, init=False)
    _stack: ExitStack = field(default_factory=ExitStack, init=False)

    def __enter__(self) -> Self:
        self._own_exposure_s = self.exposure_s
        with ExitStack() as stack:
            for device in self._devices:
                stack.callback(device.close)
                self._ready(device)
                if device is self.projector:
                    stack.callback(self._darken_if_open)
            if self.trigger is not None:
                stack.callback(self._stop_trigger)
            # Last in, first out: whatever else happens on the way down, the projector goes dark first.
            stack.callback(self._darken_if_open)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    @property
    def _devices(self) -> list[Device]:
        devices: list[Device] = [self.projector, self.camera]
        return devices if self.trigger is None else [*devices, self.trigger]

    @property
    def projector_size(self) -> tuple[int, int]:
        """(width, height) of a pattern, px."""
        return self.projector.size

    @property
    def frame_format(self) -> FrameFormat:
        """What frames look like; known once the bench is open."""
        if self._format is None:
            raise IllegalCallError(self.name, "CLOSED", "frame_format", "OPEN")
        return self._format

    @property
    def noise(self) -> NoiseModel | None:
        """The camera's noise model."""
        return self.camera.noise

    def use_latency(self, latency: DisplayLatency | None) -> None:
        """Take over the measured latency; see `drivers.bench.LatencyBound`."""
        self.latency = latency
        if self.settle_s is None:
            if latency is None:
                raise DeviceSettingError(
                    f"{self.name}: it is not known how late {self.projector.name} shows a picture",
                    "Measure it once with: scan latency --config FILE; it is kept with the rig.",
                )
            self.settle_s = latency.settle_s(self.projector.period_s)

    def measure_latency(
        self, progress: Callable[[int, int], None], keep: KeepStep = lambda level, frames: None
    ) -> DisplayLatency:
        """Measure the display's latency with this bench's camera; see `drivers.latency.measure_latency`."""
        return measure_latency(
            self.camera,
            self.projector,
            self.clock,
            np.random.default_rng(),
            trigger=self.trigger,
            frame_format=self.frame_format,
            exposure_s=self.exposure_s,
            progress=progress,
            keep=keep,
        )

    def check_exposure(self, exposure_s: float) -> None:
        """Refuse an exposure that is not this bench's; see `drivers.bench.ExposureControl`."""
        if not isinstance(self.camera, AdjustableCamera):
            raise DeviceSettingError(
                f"{self.name}: the exposure of {self.camera.name} cannot be changed in a scan",
                "Scan with one exposure: leave scan.exposures out.",
            )
        if self._own_exposure_s <= 0:
            raise DeviceSettingError(
                f"{self.name}: the exposure of {self.camera.name} is not known, so no other can be told from it",
                "Write bench.camera.exposure_us.",
            )
        if not self.whole_refreshes or exposure_s == self._own_exposure_s:
            return
        # A window that holds a picture for several refreshes still refreshes it.
        refresh_s = getattr(self.projector, "refresh_s", self.projector.period_s)
        if whole_refreshes(exposure_s, refresh_s) is None:
            own = self._own_exposure_s / refresh_s
            raise DeviceSettingError(
                f"{self.name}: an exposure of {1e6 * exposure_s:.0f} µs is {exposure_s / refresh_s:.3f} refreshes of "
                f"the projector ({1e3 * refresh_s:.3f} ms), not a whole number",
                f"bench.camera.exposure_us is {own:.4g} refreshes: choose scan.exposures whose product with that is "
                "whole, and make exposure_us longer where there is none; or set bench.whole_refreshes to false for a "
                "projector whose light is steady within a refresh.",
            )

    def set_exposure(self, exposure_s: float) -> float:
        """Expose so long from the next sequence on; see `drivers.bench.ExposureControl`."""
        self.check_exposure(exposure_s)
        self._recover()
        former_s, self._wanted_exposure_s = self._wanted_exposure_s, exposure_s
        try:
            self.camera.stop()
            try:
                self._apply_exposure()
            except DeviceSettingError:
                # Refused: the camera goes on as it was.
                self._wanted_exposure_s = former_s
                raise
            finally:
                if self.camera.state is DeviceState.CONFIGURED:
                    self.camera.arm()
                    self.camera.start()
        except BaseException:
            self._disturbed = True
            raise
        return self.exposure_s

    def _apply_exposure(self) -> None:
        """Set what `set_exposure` has asked for, also on a camera that was lost and has come back."""
        if self._wanted_exposure_s is not None:
            assert isinstance(self.camera, AdjustableCamera)
            self.exposure_s = self.camera.set_exposure(self._wanted_exposure_s)

    def prepare(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Bring back what was lost, forget what a broken sequence has left, and load the patterns."""
        self._recover()
        if self.projector.state is DeviceState.RUNNING:
            self.projector.darken()  # a sequence that was not photographed to its end
        self.projector.load(patterns)
        self._patterns = len(patterns)
        self._prepared()

    def _prepared(self) -> None:
        """What else is to be done before the first pattern."""

    def expose(self, index: int, out: Pixels) -> FrameStamp:
        """Photograph pattern ``index`` into ``out``; see `drivers.Bench`."""
        try:
            return self._expose(index, out)
        except BaseException:
            self._disturbed = True
            raise

    def _expose(self, index: int, out: Pixels) -> FrameStamp:
        raise NotImplementedError

    def darken(self) -> None:
        """Project black."""
        self._darken_if_open()

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of all devices."""
        devices: dict[str, Any] = {"camera": self.camera.describe(), "projector": self.projector.describe()}
        if self.trigger is not None:
            devices["trigger"] = self.trigger.describe()
        return {
            "name": self.name,
            "simulated": self.simulated,
            "synchronisation": type(self).__name__.removesuffix("Bench").lower(),
            "settle_s": self.settle_s,
            "display_latency": None if self.latency is None else self.latency.to_json(),
            **devices,
        }

    def check_sequence(self, sent: int) -> None:
        """Refuse a sequence that was disturbed, or of which other pulses and exposures were counted than frames came.

        Parameters
        ----------
        sent
            Pulses asked for since the box was armed; each has given one frame.

        Raises
        ------
        SequenceFaultError
            The box has counted something else, or something came before a picture.
        """
        if isinstance(self.projector, WatchedProjector):
            self.projector.verify()
        if self.trigger is None:
            return
        counts = self.trigger.counts()
        exposed = sent if counts.exposed is None else counts.exposed
        if counts.missed:
            remedy = "Pulses were asked for too fast: make min_period_us of the box as short as the camera allows."
        elif counts.sent != sent:
            remedy = "Check the wire and the light sensor at the box's input: it has not seen each pattern once."
        elif exposed != sent:
            remedy = (
                "Check the wires between box and camera; exposure and read-out must be shorter than the time between "
                "two pulses."
            )
        else:
            return
        back = "not counted" if counts.exposed is None else str(counts.exposed)
        raise SequenceFaultError(
            f"{self.trigger.name}: {counts.sent} pulses sent, {counts.missed} missed, exposures counted back: {back}; "
            f"{sent} frames came for {sent} patterns",
            remedy,
        )

    def _recover(self) -> None:
        deadline = self.clock.now() + self.reconnect_s
        for device in self._devices:
            while device.state in (DeviceState.FAULT, DeviceState.CLOSED) or self._disturbed:
                try:
                    self._ready(device)
                    break
                except (DeviceLostError, DeviceNotFoundError) as error:
                    if self.clock.now() >= deadline:
                        # It has been waited for: to take the sequence again would only wait once more.
                        raise _given_up(device, self.reconnect_s, error) from error
                    self.clock.sleep(_RETRY_S)
        self._disturbed = False

    def _ready(self, device: Device) -> None:
        """Bring one device to where a sequence can begin, from whatever state it is in."""
        if device.state is DeviceState.FAULT:
            device.close()
        fresh = device.state is DeviceState.CLOSED
        if fresh:
            device.open()
        if device is self.projector:
            if fresh:
                self.projector.configure()
        elif device is self.camera:
            if fresh:
                self._configure_camera()
                self._apply_exposure()
            elif self.camera.state is not DeviceState.CONFIGURED:
                self.camera.stop()
            self.camera.arm()
            self.camera.start()
        elif self.trigger is not None:
            if fresh:
                self.trigger.configure()
            else:
                self.trigger.stop()

    def _configure_camera(self) -> None:
        found = self.camera.configure()
        if self._format is not None and found != self._format:
            raise DeviceSettingError(
                f"{self.camera.name}: frames are now {found.width} × {found.height} px of {found.bits} bits, "
                f"they were {self._format.width} × {self._format.height} px of {self._format.bits} bits",
                "Connect the camera that the scan was begun with.",
            )
        self._format = found

    def _darken_if_open(self) -> None:
        if self.projector.state is not DeviceState.CLOSED:
            self.projector.darken()

    def _stop_trigger(self) -> None:
        if self.trigger is not None and self.trigger.state not in (DeviceState.CLOSED, DeviceState.FAULT):
            # A box that does not answer has no more pulses to give; closing it comes next.
            with suppress(OperatorError):
                self.trigger.stop()


def _given_up(device: Device, waited_s: float, error: HardwareError) -> DeviceLostError:
    lost = DeviceLostError(
        f"{device.name} was lost in mid-scan and is not back after {waited_s:g} s: {error.message}",
        error.remedy,
    )
    lost.repeatable = False
    return lost
