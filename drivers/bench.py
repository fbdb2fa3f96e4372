"""A bench: devices that work together, and the one thing a scan asks of them: "this pattern, exposed".

A *bench kind* is what the entry-point group ``scanner.benches`` names: an object with a pydantic model of its settings
and an ``open(settings)`` context manager that gives a `Bench`. `drivers.SteppedBench` and `drivers.StreamedBench` make
one of any camera and projector.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from drivers.devices import Clock, FrameFormat, FrameStamp, NoiseModel, Pixels
from drivers.latency import DisplayLatency, KeepStep


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
        """Load the patterns (height, width) of one sequence and get ready to expose them in order.

        After a `HardwareError` that is ``repeatable`` this is also what brings lost devices back and drops whatever the
        broken sequence has left behind.
        """
        ...

    def expose(self, index: int, out: Pixels) -> FrameStamp:
        """Photograph pattern ``index`` of the prepared sequence into ``out`` (height, width).

        The bench answers for it that this very pattern was on the surface during the whole exposure. With the last
        pattern it has compared what its devices have counted.

        Raises
        ------
        HardwareError
            A device failed; where the error is ``repeatable``, the sequence may be prepared and taken again.
        """
        ...

    def darken(self) -> None:
        """Project black. Must work in every state."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of all devices, for the recording."""
        ...


@runtime_checkable
class ExposureControl(Protocol):
    """A bench whose camera's exposure can be changed between two sequences."""

    @property
    def exposure_s(self) -> float:
        """The exposure that is set, s; on an open bench at first the one of its settings."""
        ...

    def check_exposure(self, exposure_s: float) -> None:
        """Refuse an exposure (s) with which the bench could not answer for its frames; touches no device.

        Raises
        ------
        DeviceSettingError
            Such as one that cuts a refresh of the projector.
        """
        ...

    def set_exposure(self, exposure_s: float) -> float:
        """Have the sequences prepared from now on exposed so long; returns the exposure that was made of it, s.

        Raises
        ------
        DeviceSettingError
            The bench or its camera refuses it.
        HardwareError
            A device failed; where the error is ``repeatable``, it may be asked for again.
        """
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


@runtime_checkable
class Presenter(Protocol):
    """A bench before which something other than a person puts objects: a robot, or the simulation."""

    def present(self, thing: Mapping[str, Any]) -> None:
        """Put an object before the camera in place of what was there; it stands still when this returns.

        Parameters
        ----------
        thing
            JSON document of the object and its pose; which ones there are is the bench's matter.

        Raises
        ------
        DeviceSettingError
            The bench has no such object, or cannot hold it so.
        """
        ...


class SceneTruth(Protocol):
    """What really is before a bench, all (height, width) of its camera; NaN is "none"."""

    @property
    def x_p(self) -> NDArray[np.floating[Any]]:
        """Projector column, px, that directly lights what the pixel's centre sees."""
        ...

    @property
    def y_p(self) -> NDArray[np.floating[Any]]:
        """Projector row, px, as `x_p`."""
        ...

    @property
    def points(self) -> NDArray[np.floating[Any]]:
        """(height, width, 3) mm in the camera frame."""
        ...

    @property
    def alpha(self) -> NDArray[np.floating[Any]]:
        """Amplitude of the bounced fringes over that of the direct ones."""
        ...

    @property
    def edge(self) -> NDArray[np.bool_]:
        """Pixels that mix two surfaces, or light and shadow."""
        ...

    @property
    def places(self) -> Mapping[str, NDArray[np.bool_]]:
        """Masks of what can be told apart by name: parts, and windows that results are judged in."""
        ...

    @property
    def bounce_x(self) -> NDArray[np.floating[Any]]:
        """Mean projector column, px, of the light that a pixel sees over mirrors and lobes."""
        ...

    @property
    def bounce_y(self) -> NDArray[np.floating[Any]]:
        """Mean projector row, px, as `bounce_x`."""
        ...


@runtime_checkable
class TruthTeller(Protocol):
    """A bench kind that knows what is really there: a simulation, or a bench with a measured artefact.

    Nothing that computes a result asks it; `scan compare` does, to judge results.
    """

    def truth(self, settings: Any) -> SceneTruth:
        """Truth of the bench that ``settings`` (an instance of the kind's model) describes."""
        ...


@runtime_checkable
class LatencyBound(Protocol):
    """A bench that has to know how much later than handed over a picture is on the surface."""

    @property
    def latency(self) -> DisplayLatency | None:
        """What it was told, None before."""
        ...

    def use_latency(self, latency: DisplayLatency | None) -> None:
        """Wait for pictures by this measured latency.

        Raises
        ------
        DeviceSettingError
            None is known, and the bench cannot do without.
        """
        ...

    def measure_latency(
        self, progress: Callable[[int, int], None], keep: KeepStep = lambda level, frames: None
    ) -> DisplayLatency:
        """Measure it with the bench's own camera; see `drivers.latency.measure_latency`."""
        ...
