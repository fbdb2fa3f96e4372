"""What a device is: protocols, states and the records that devices return.

A device is anything that satisfies a protocol below; nothing has to be inherited. Drivers *have* a `Lifecycle`, which
holds the state and refuses illegal calls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers.errors import IllegalCallError

Pixels = NDArray[np.unsignedinteger[Any]]
"""Grey values, uint8 or uint16."""


class DeviceState(IntEnum):
    """How far a device has come. The states are ordered; `FAULT` stands above all and is left by ``close`` only."""

    CLOSED = 0
    OPEN = 1
    CONFIGURED = 2
    ARMED = 3
    RUNNING = 4
    FAULT = 9


class Lifecycle:
    """The state of one device and the moves it may make.

    ``open`` CLOSED → OPEN; ``configure`` OPEN, CONFIGURED → CONFIGURED; ``arm`` CONFIGURED, ARMED → ARMED;
    ``start`` ARMED → RUNNING; ``stop`` ARMED, RUNNING → CONFIGURED; ``close`` any → CLOSED; ``fail`` any → FAULT.

    Parameters
    ----------
    device
        The name that errors mention.
    """

    _MOVES: Mapping[str, tuple[frozenset[DeviceState], DeviceState]] = {
        "open": (frozenset({DeviceState.CLOSED}), DeviceState.OPEN),
        "configure": (frozenset({DeviceState.OPEN, DeviceState.CONFIGURED}), DeviceState.CONFIGURED),
        "arm": (frozenset({DeviceState.CONFIGURED, DeviceState.ARMED}), DeviceState.ARMED),
        "start": (frozenset({DeviceState.ARMED}), DeviceState.RUNNING),
        "stop": (frozenset({DeviceState.ARMED, DeviceState.RUNNING}), DeviceState.CONFIGURED),
        "close": (frozenset(DeviceState), DeviceState.CLOSED),
        "fail": (frozenset(DeviceState), DeviceState.FAULT),
    }

    def __init__(self, device: str) -> None:
        self.device = device
        self.state = DeviceState.CLOSED

    def check(self, move: str) -> None:
        """Raise `IllegalCallError` unless ``move`` is allowed now; call it before touching the device."""
        allowed, _ = self._MOVES[move]
        if self.state not in allowed:
            raise IllegalCallError(self.device, self.state.name, move, " or ".join(s.name for s in sorted(allowed)))

    def move(self, move: str) -> None:
        """Make the move, after the device has done its part."""
        self.check(move)
        self.state = self._MOVES[move][1]

    def require(self, call: str, *states: DeviceState) -> None:
        """Raise `IllegalCallError` unless the device is in one of ``states``."""
        if self.state not in states:
            raise IllegalCallError(self.device, self.state.name, call, " or ".join(s.name for s in sorted(states)))


@dataclass(frozen=True)
class FrameFormat:
    """What one frame looks like.

    Parameters
    ----------
    width, height
        Size in px.
    bits
        Significant bits of a grey value; 8 bits arrive as uint8, more as uint16. ``2**bits - 1`` is saturated.
    """

    width: int
    height: int
    bits: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """The NumPy type of a pixel."""
        return np.dtype(np.uint8 if self.bits <= 8 else np.uint16)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def saturated_dn(self) -> int:
        """The grey value (DN) at and above which a pixel says nothing."""
        return (1 << self.bits) - 1


@dataclass(frozen=True)
class NoiseModel:
    """Temporal noise of one pixel: var(I) = read_dn² + dn_per_electron · I (DN²), quantisation included in read_dn.

    Parameters
    ----------
    read_dn
        Standard deviation in the dark, DN.
    dn_per_electron
        Conversion gain, DN per electron; 0 for no shot noise.
    """

    read_dn: float
    dn_per_electron: float = 0.0

    def variance(self, mean_dn: NDArray[np.float32] | float) -> Any:
        """Variance (DN²) of a grey value with mean ``mean_dn`` (DN)."""
        return self.read_dn**2 + self.dn_per_electron * np.maximum(mean_dn, 0.0)


@dataclass(frozen=True)
class FrameStamp:
    """What is known of one frame beside its pixels.

    Parameters
    ----------
    frame_id
        The camera's own running number.
    t_device_s
        The camera's time stamp of the exposure, s on the camera's clock.
    t_host_s
        When the frame was in host memory, s on the bench's clock.
    t_shown_s
        When the pattern was handed to the display, s on the bench's clock; NaN where no pattern was asked for.
    """

    frame_id: int
    t_device_s: float
    t_host_s: float
    t_shown_s: float = float("nan")


@dataclass(frozen=True)
class PlayRecord:
    """What is known of a sequence that a projector has played by itself.

    Parameters
    ----------
    shown_s
        When each picture was handed to the display, s on the bench's clock.
    late
        Numbers (from 0) of the pictures that came one or more refreshes too late; empty for a good sequence.
    """

    shown_s: tuple[float, ...]
    late: tuple[int, ...]


@dataclass(frozen=True)
class TriggerCounts:
    """What a trigger box has counted since it was armed.

    Parameters
    ----------
    sent
        Pulses given to the camera.
    exposed
        Exposures that the camera reported back on its "exposure active" line; None where that line is not connected.
    missed
        Edges or requests that came too early to be answered with a pulse.
    """

    sent: int
    exposed: int | None
    missed: int


@runtime_checkable
class Clock(Protocol):
    """Where time comes from. Real benches use `drivers.clock.SystemClock`, simulated ones a virtual clock."""

    def now(self) -> float:
        """Monotonic time, s."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        ...


@runtime_checkable
class Device(Protocol):
    """What all devices share."""

    name: str

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        ...

    def open(self) -> None:
        """Connect. Raises `HardwareError` where the device is not there."""
        ...

    def close(self) -> None:
        """Stop whatever runs and disconnect; allowed in every state, any number of times."""
        ...

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot of identity and settings, for the recording."""
        ...


@runtime_checkable
class Camera(Device, Protocol):
    """A grey camera that exposes one frame per trigger.

    ``open → configure → arm → start → (trigger → fetch)* → stop → close``.
    """

    @property
    def noise(self) -> NoiseModel | None:
        """The noise model where the camera has one; None lets the scan estimate it from the frames."""
        ...

    def configure(self) -> FrameFormat:
        """Apply the settings the camera was made with and say what frames will look like."""
        ...

    def arm(self) -> None:
        """Get buffers ready and drop whatever an earlier run has left."""
        ...

    def start(self) -> None:
        """From here on a trigger exposes a frame."""
        ...

    def trigger(self) -> None:
        """Expose one frame now. Returns without waiting for it."""
        ...

    def fetch(self, out: Pixels, timeout_s: float) -> FrameStamp:
        """Wait for the oldest triggered frame and copy it to ``out`` (height, width).

        Raises
        ------
        FrameTimeoutError
            Nothing came within ``timeout_s``.
        DeviceLostError
            The camera does not answer any more.
        """
        ...

    def stop(self) -> None:
        """No more triggers."""
        ...


@runtime_checkable
class AdjustableCamera(Camera, Protocol):
    """A camera whose exposure can be changed between two sequences."""

    def set_exposure(self, exposure_s: float) -> float:
        """Expose so long from now on; allowed while CONFIGURED, and until the next ``configure``.

        Returns
        -------
        The exposure that the camera has made of it, s.

        Raises
        ------
        DeviceSettingError
            The camera does not take it; the message quotes its own limits.
        """
        ...


@runtime_checkable
class Projector(Device, Protocol):
    """Something that shows 8-bit grey pictures. ``open → configure → load → show* → darken → close``."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        ...

    @property
    def period_s(self) -> float:
        """Time one picture is on at least, s."""
        ...

    def configure(self) -> None:
        """Apply the settings the projector was made with."""
        ...

    def load(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Take over the pictures (height, width) of one sequence; replaces the former ones."""
        ...

    def show(self, index: int) -> float:
        """Show picture ``index`` from the next refresh on; returns when it was handed over, s on the bench's clock."""
        ...

    def darken(self) -> None:
        """Show black. Allowed in every state but CLOSED, and must work when all else has failed."""
        ...


@runtime_checkable
class SequencePlayer(Projector, Protocol):
    """A projector that shows a loaded sequence by itself, one picture per `period_s`: ``load → play → finish``."""

    def play(self) -> None:
        """Begin to show all loaded pictures once, in order, each for one period; returns at once."""
        ...

    def finish(self, timeout_s: float) -> PlayRecord:
        """Wait until the last picture was shown for its period.

        Raises
        ------
        SequenceFaultError
            It was not within ``timeout_s``.
        """
        ...


@runtime_checkable
class WatchedProjector(Projector, Protocol):
    """A projector that notices when its picture is disturbed, such as a window that others can cover."""

    def verify(self) -> None:
        """Say that nothing has disturbed a picture since the sequence was loaded.

        Raises
        ------
        SequenceFaultError
            Something has; the sequence may be repeated.
        DeviceLostError
            The picture is gone.
        """
        ...


@runtime_checkable
class Trigger(Device, Protocol):
    """A box that gives trigger pulses to the camera. ``open → configure → (arm → fire* → counts → stop)* → close``."""

    @property
    def min_period_s(self) -> float:
        """Shortest time between two pulses, s."""
        ...

    def configure(self) -> None:
        """Apply the settings the box was made with."""
        ...

    def arm(self, pulses: int | None = None) -> None:
        """Set the counts to 0 and get ready.

        Parameters
        ----------
        pulses
            None: one pulse for each `fire`. A number: one pulse for each of so many edges at the box's input, which
            the projector or a light sensor makes; further edges are ignored.
        """
        ...

    def fire(self) -> None:
        """Give one pulse; returns when the box has confirmed it."""
        ...

    def counts(self) -> TriggerCounts:
        """What was counted since the box was armed."""
        ...

    def stop(self) -> None:
        """No more pulses. Allowed in every state but CLOSED."""
        ...
