"""Hardware-triggered: the projector plays a sequence by itself, and its own signal exposes the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.device_bench import DeviceBench
from drivers.devices import FrameStamp, Pixels, SequencePlayer
from drivers.errors import DeviceSettingError, FrameLossError, SequenceFaultError

_LONG_LATENCY_S = 0.3
"""Longer than displays are late; taken where nobody has measured."""


@dataclass
class StreamedBench(DeviceBench):
    """The fast way: one pattern per refresh, each exposure started by the light or the signal of its own pattern.

    Either the projector's trigger output goes to the camera, or a light sensor on the projector's synchronisation
    patch, or the projector's output, goes to the trigger box, which gives the camera one pulse per pattern and counts
    its exposures back. Parameters as `drivers.device_bench.DeviceBench`; ``projector`` is a `SequencePlayer`.
    """

    _next: int = field(default=0, init=False)
    _last_id: int | None = field(default=None, init=False)
    _changed_s: float = field(default=float("-inf"), init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.projector, SequencePlayer):
            raise TypeError(f"{self.projector.name} cannot play a sequence")
        self._player: SequencePlayer = self.projector

    def prepare(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Load the patterns; after a broken sequence the camera may count its frames anew."""
        if self._disturbed:
            self._last_id = None
        super().prepare(patterns)
        self._next = 0

    def _expose(self, index: int, out: Pixels) -> FrameStamp:
        if index not in (0, self._next):
            raise SequenceFaultError(
                f"{self.name}: pattern {index} was asked for, but {self._next} is the next that the projector plays",
                "A streamed sequence is photographed in order; this is a fault of the calling program, please report.",
            )
        if index == 0:
            self._begin()
        stamp = self.camera.fetch(out, self._wait_s if index == 0 else self.exposure_s + self.timeout_s)
        if self._last_id is not None and stamp.frame_id != self._last_id + 1:
            raise FrameLossError(
                f"{self.camera.name}: frame {stamp.frame_id} came where {self._last_id + 1} was due, at pattern "
                f"{index + 1} of {self._patterns}",
                "Something else triggers the camera, or frames were lost: check the trigger line and the camera's "
                "bandwidth.",
            )
        self._last_id = stamp.frame_id
        self._next = index + 1
        if self._next == self._patterns:
            self._check_played()
        return stamp

    def check_exposure(self, exposure_s: float) -> None:
        """Refuse also what is longer than the bench's own exposure, which is made for the time that a pattern is on."""
        super().check_exposure(exposure_s)
        if exposure_s > self._own_exposure_s:
            raise DeviceSettingError(
                f"{self.name}: an exposure of {1e6 * exposure_s:.0f} µs is longer than bench.camera.exposure_us, and "
                "streamed patterns follow one another at a fixed pace",
                "Make bench.camera.exposure_us the longest and all scan.exposures 1 or less, or set synchronisation: "
                "step.",
            )

    def set_exposure(self, exposure_s: float) -> float:
        """Expose so long from the next sequence on; the camera may count its frames anew."""
        self._last_id = None
        return super().set_exposure(exposure_s)

    @property
    def _settled_after_s(self) -> float:
        if self.settle_s is not None:
            return self.settle_s
        return _LONG_LATENCY_S if self.latency is None else self.latency.settle_s(self.projector.period_s)

    @property
    def _wait_s(self) -> float:
        """From play to the first frame, s."""
        return self.exposure_s + self.timeout_s + (1.0 if self.latency is None else self.latency.p99_s)

    def darken(self) -> None:
        """Project black."""
        super().darken()
        self._changed_s = self.clock.now()

    def _begin(self) -> None:
        # What was handed over last may still be on its way to the light sensor, and would give the first edge.
        self.clock.sleep(self._changed_s + self._settled_after_s - self.clock.now())
        if self.trigger is not None:
            self.trigger.arm(self._patterns)
        self._player.play()

    def _check_played(self) -> None:
        record = self._player.finish(self.timeout_s)
        self._changed_s = self.clock.now()
        if record.late:
            numbers = ", ".join(str(n + 1) for n in record.late[:8])
            raise SequenceFaultError(
                f"{self.projector.name}: {len(record.late)} of {self._patterns} patterns came a refresh or more too "
                f"late ({numbers}{', …' if len(record.late) > 8 else ''})",
                "Close other programs, switch off the compositor, or scan step by step.",
            )
        self.check_sequence(self._patterns)
