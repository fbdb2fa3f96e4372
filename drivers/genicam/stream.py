"""From the vendor's buffers to the shared ring: each frame looked at, copied once, and none lost unseen."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from drivers.genicam.camera_time import CameraTime
from drivers.genicam.continuity import Continuity
from drivers.genicam.library import is_genicam_error
from drivers.genicam.pixels import PIXEL_FORMATS, PixelFormat
from drivers.genicam.ring import FrameRing
from drivers.genicam.triggering import Gate

_FETCH_S = 0.002
"""How long a frame that is announced as waiting is waited for; longer than one poll of harvesters (1 ms)."""
_SINGLE_PICTURE = (1, 4)
"""GenTL payload types that hold one picture: image, chunk data."""


class Arrival(NamedTuple):
    """A frame that was asked for, as the camera's process tells the scan's.

    Parameters
    ----------
    slot
        Where in the ring it lies; None where it is not usable.
    frame_id
        The camera's number, or a running one where it gives none; -1 where not known.
    t_device_s
        The camera's time stamp, s; NaN where it gives none.
    t_host_s
        When it was in host memory, s of `time.monotonic`, which all processes share.
    fault
        What was lost before it or with it; empty for a good frame.
    """

    slot: int | None
    frame_id: int
    t_device_s: float
    t_host_s: float
    fault: str


@dataclass
class Counters:
    """What a stream has seen since the camera was opened.

    Parameters
    ----------
    delivered
        Good frames handed to the scan.
    unasked
        Frames that nobody had asked for, dropped.
    incomplete
        Frames of which a part was missing.
    malformed
        Frames of another size or format than was set.
    lost
        Missing frame numbers.
    underrun
        Frames for which the vendor's library had no free buffer.
    ring_high_water
        The most frames that have waited in the ring.
    restarts
        How often the stream was started anew because a frame had not come.
    """

    delivered: int = 0
    unasked: int = 0
    incomplete: int = 0
    malformed: int = 0
    lost: int = 0
    underrun: int = 0
    ring_high_water: int = 0
    restarts: int = 0

    def __str__(self) -> str:
        return ", ".join(f"{count} {name}" for name, count in asdict(self).items() if name != "ring_high_water")


class Stream:
    """The running acquisition of one camera.

    Parameters
    ----------
    acquirer
        A ``harvesters.core.ImageAcquirer`` that is not acquiring.
    pixel_format
        What frames are sent in.
    ring
        Where they go.
    gate
        Says which were asked for.
    fire
        Executes the camera's software trigger; returns the camera's time just before, ns, or None.
    counters
        Counted on.
    tell
        Takes each `Arrival`.

    Notes
    -----
    When the ring is full, or a fault has not been read yet, frames are left in the vendor's buffers.
    """

    def __init__(
        self,
        acquirer: Any,
        pixel_format: PixelFormat,
        ring: FrameRing,
        gate: Gate,
        fire: Callable[[], int | None],
        counters: Counters,
        tell: Callable[[Arrival], None],
    ) -> None:
        from harvesters.core import Callback

        self._acquirer = acquirer
        self._pixel_format = pixel_format
        self._ring = ring
        self._gate = gate
        self._fire = fire
        self._fired_ns: int | None = None
        self._counters = counters
        self._tell = tell
        self._continuity = Continuity()
        self._free = deque(range(ring.slots))
        self._fault_unread = False
        self._arrivals = 0
        self._incomplete = False
        self._source = acquirer.data_streams[0]
        self._ticks_per_s = _optional(lambda: acquirer.device.module.timestamp_frequency)

        class Incomplete(Callback):  # type: ignore[misc]
            def emit(_, context: Any = None) -> None:  # noqa: N805
                self._incomplete = True

        acquirer.add_callback(acquirer.Events.INCOMPLETE_BUFFER, Incomplete())
        # In the foreground: with harvesters' own thread fetch ignores its timeout, and keeps one frame of all.
        acquirer.start(run_as_thread=False)
        self._underruns = _optional(lambda: self._source.num_underrun)
        self._can_peek = _optional(lambda: self._source.num_awaiting_delivery) is not None

    def stop(self) -> None:
        """End the acquisition and forget all frames. Raises what the binding raises."""
        self._acquirer.stop()

    def free(self, slot: int | None) -> None:
        """Take note that an arrival was read and its slot can be used again."""
        if slot is None:
            self._fault_unread = False
        else:
            self._free.append(slot)

    def ask(self) -> None:
        """Ask for a frame; what is there by now is not it."""
        for _ in range(self._acquirer.num_buffers):
            if not self._take():
                break
        self._gate.request()
        self._fire_if_due()

    def poll(self) -> bool:
        """Take the next frame out of the vendor's buffers; False where there is none, or no place for it."""
        taken = self._take()
        self._fire_if_due()
        return taken

    def _fire_if_due(self) -> None:
        if self._gate.fire():
            self._fired_ns = self._fire()

    def _take(self) -> bool:
        if self._fault_unread or (self._gate.open and not self._free):
            return False
        if self._can_peek and not self._source.num_awaiting_delivery:
            return False
        # Not fetch(): its timeout begins anew with each incomplete frame.
        buffer = self._acquirer.try_fetch(timeout=_FETCH_S, is_raw=True)
        if buffer is None:
            if not self._incomplete:
                return False
            self._incomplete = False
            self._counters.incomplete += 1
            where = self._continuity.last
            self._continuity.excuse()
            self._pass_or_refuse(-1, float("nan"), f"a frame {where} was incomplete")
            return True
        try:
            self._examine(buffer)
        finally:
            # Nothing may refer to the buffer from here on: the vendor's library writes the next frame into it.
            buffer.parent.queue_buffer(buffer)
        return True

    def _examine(self, buffer: Any) -> None:
        self._arrivals += 1
        frame_id = _optional(lambda: buffer.frame_id)
        t_ns = self._time_stamp(buffer)
        missing = self._missing(frame_id, t_ns)
        if CameraTime.is_before(t_ns, self._fired_ns):
            self._counters.unasked += 1
            return
        number = self._arrivals if frame_id is None else frame_id
        t_s = float("nan") if t_ns is None else t_ns * 1e-9
        if missing and self._gate.misses_matter:
            self._pass_or_refuse(number, t_s, missing)
            return
        fault = self._misfit(buffer, number) or (self._copy(buffer, number) if self._gate.open else "")
        if fault or not self._gate.open:
            self._pass_or_refuse(number, t_s, fault)
            return
        self._gate.arrive()
        slot = self._free.popleft()
        self._counters.delivered += 1
        self._counters.ring_high_water = max(self._counters.ring_high_water, self._ring.slots - len(self._free))
        self._tell(Arrival(slot, number, t_s, time.monotonic(), ""))

    def _pass_or_refuse(self, number: int, t_s: float, fault: str) -> None:
        """Let a frame pass that nobody has asked for; tell of the fault of one that somebody has."""
        if not self._gate.open:
            self._gate.arrive()
            self._counters.unasked += 1
        elif self._gate.misses_matter:
            self._gate.arrive()
            self._fault_unread = True
            self._tell(Arrival(None, number, t_s, time.monotonic(), fault))

    def _missing(self, frame_id: int | None, t_ns: int | None) -> str:
        """What is missing before this frame, empty where nothing is."""
        where = self._continuity.last
        lost, fault = self._continuity.judge(frame_id, t_ns)
        self._counters.lost += lost
        faults = [fault] if fault else []
        underruns = _optional(lambda: self._source.num_underrun)
        if underruns is not None and self._underruns is not None and underruns > self._underruns:
            more, self._underruns = underruns - self._underruns, underruns
            self._counters.underrun += more
            faults.append(f"{more} found no free buffer {where} (underrun)")
        return "; ".join(faults)

    def _copy(self, buffer: Any, number: int) -> str:
        """Copy a frame to the next free slot; returns what is wrong with it, empty where nothing is."""
        offset = _optional(lambda: buffer.image_offset) or 0
        padding = _optional(lambda: buffer.padding_x) or 0
        filled = _optional(lambda: buffer.size_filled)
        memory = memoryview(buffer.raw_buffer)
        try:
            self._pixel_format.read(memory[:filled] if filled else memory, offset, padding, self._ring[self._free[0]])
        except ValueError as error:
            self._counters.incomplete += 1
            return f"frame {number} was incomplete ({error})"
        return ""

    def _misfit(self, buffer: Any, number: int) -> str:
        """What is wrong with the shape of a frame, empty where nothing is."""
        expected = self._ring.frame_format
        kind = _optional(lambda: int(buffer.payload_type))
        width = _optional(lambda: buffer.width) or expected.width
        height = _optional(lambda: buffer.height) or expected.height
        code = _optional(lambda: buffer.pixel_format) or self._pixel_format.code
        if kind is not None and kind not in _SINGLE_PICTURE:
            fault = f"frame {number} is no single picture (GenTL payload type {kind})"
        elif (width, height, code) != (expected.width, expected.height, self._pixel_format.code):
            name = next((f.name for f in PIXEL_FORMATS.values() if f.code == code), f"format 0x{code:08X}")
            fault = (
                f"frame {number} is {width} × {height} px {name}, not {expected.width} × {expected.height} px "
                f"{self._pixel_format.name}"
            )
        elif _optional(buffer.has_received_larger_payload):
            fault = f"frame {number} is larger than its buffer"
        else:
            return ""
        self._counters.malformed += 1
        return fault

    def _time_stamp(self, buffer: Any) -> int | None:
        """Ns on the camera's clock."""
        t_ns = _optional(lambda: buffer.timestamp_ns)
        if t_ns is None and self._ticks_per_s:
            ticks = _optional(lambda: buffer.timestamp)
            t_ns = None if ticks is None else ticks * 1_000_000_000 // self._ticks_per_s
        return t_ns or None


def _optional(ask: Callable[[], Any]) -> Any:
    """What ``ask`` says, None where the producer does not."""
    try:
        return ask()
    except Exception as error:
        if is_genicam_error(error):
            return None
        raise
