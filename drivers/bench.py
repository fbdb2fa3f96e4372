"""A bench: devices that work together, and the one thing a scan asks of them: "this pattern, exposed".

A *bench kind* is what the entry-point group ``scanner.benches`` names: an object with a pydantic model of its settings
and an ``open(settings)`` context manager that gives a `Bench`. `SteppedBench` makes one of any camera and projector.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from drivers.devices import (
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
)
from drivers.errors import IllegalCallError


@runtime_checkable
class Bench(Protocol):
    """What a scan runs on. It is open when a scan gets it, and its kind's context manager closes it."""

    name: str
    simulated: bool
    """True where no light was involved; everything recorded is stamped with it."""
    rig: Mapping[str, Any] | None
    """The calibrated rig as the JSON document that `scanner.rig.Rig.from_json` reads; None where not known."""

    @property
    def clock(self) -> Clock:
        """The time that all stamps of this bench are on."""
        ...

    @property
    def projector_size(self) -> tuple[int, int]:
        """(width, height) of a pattern, px."""
        ...

    @property
    def frame_format(self) -> FrameFormat:
        """What frames look like."""
        ...

    @property
    def noise(self) -> NoiseModel | None:
        """Noise model of a frame, or None to have it estimated from the frames."""
        ...

    def prepare(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Load the patterns (height, width) of one sequence and get ready to expose them in order."""
        ...

    def expose(self, index: int, out: Pixels) -> FrameStamp:
        """Photograph pattern ``index`` of the prepared sequence into ``out`` (height, width).

        The bench answers for it that this very pattern was on the surface during the whole exposure.
        """
        ...

    def darken(self) -> None:
        """Project black. Must work in every state."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of all devices, for the recording."""
        ...


class BenchKind(Protocol):
    """What an entry point of the group ``scanner.benches`` loads.

    ``settings`` is the pydantic model of the ``bench:`` section of a configuration without its key ``kind``;
    ``open`` gives an open bench and, whatever happens inside, leaves a dark projector and closed devices behind.
    """

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the bench's section in the configuration."""
        ...

    def open(self, settings: Any) -> AbstractContextManager[Bench]:
        """Open the devices that ``settings`` (an instance of the model) describes."""
        ...


@dataclass
class SteppedBench:
    """Camera and projector, step by step: show, wait until it is surely on the surface, trigger, fetch.

    Parameters
    ----------
    name, simulated, rig
        See `Bench`.
    camera, projector, clock, trigger
        The devices; with no ``trigger`` box the camera is triggered by software.
    settle_s
        From the hand-over of a pattern until it is surely on the surface, s: the calibrated latency and its spread.
    timeout_s
        From a trigger until the frame must have come, s.

    Notes
    -----
    Entering opens and readies the devices in the order projector, camera, trigger box; leaving darkens the projector,
    stops the triggers and closes in reverse, whatever happened.
    """

    name: str
    camera: Camera
    projector: Projector
    clock: Clock
    settle_s: float
    timeout_s: float = 2.0
    simulated: bool = False
    rig: Mapping[str, Any] | None = None
    trigger: Trigger | None = None
    _format: FrameFormat | None = field(default=None, init=False)
    _stack: ExitStack = field(default_factory=ExitStack, init=False)

    def __enter__(self) -> Self:
        devices: list[Device] = [self.projector, self.camera]
        if self.trigger is not None:
            devices.append(self.trigger)
        with ExitStack() as stack:
            for device in devices:
                stack.callback(device.close)
                device.open()
                if device is self.projector:
                    stack.callback(self._darken_if_open)
            self.projector.configure()
            self._format = self.camera.configure()
            self.camera.arm()
            self.camera.start()
            if self.trigger is not None:
                stack.callback(self.trigger.stop)
                self.trigger.configure()
                self.trigger.arm()
            # Last in, first out: whatever else happens on the way down, the projector goes dark first.
            stack.callback(self._darken_if_open)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def _darken_if_open(self) -> None:
        if self.projector.state is not DeviceState.CLOSED:
            self.projector.darken()

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

    def prepare(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Hand the patterns of one sequence to the projector."""
        self.projector.load(patterns)

    def expose(self, index: int, out: Pixels) -> FrameStamp:
        """Show, settle, trigger, fetch."""
        shown = self.projector.show(index)
        self.clock.sleep(self.settle_s)
        if self.trigger is None:
            self.camera.trigger()
        else:
            self.trigger.fire()
        return replace(self.camera.fetch(out, self.timeout_s), t_shown_s=shown)

    def darken(self) -> None:
        """Project black."""
        self._darken_if_open()

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of all devices."""
        devices: dict[str, Any] = {"camera": self.camera.describe(), "projector": self.projector.describe()}
        if self.trigger is not None:
            devices["trigger"] = self.trigger.describe()
        return {"name": self.name, "simulated": self.simulated, "settle_s": self.settle_s, **devices}
