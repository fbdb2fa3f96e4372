"""Step by step: show a pattern, wait until it is surely on the surface, trigger, fetch."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from drivers.device_bench import DeviceBench
from drivers.devices import FrameStamp, Pixels
from drivers.errors import DeviceSettingError


@dataclass
class SteppedBench(DeviceBench):
    """The sure way: nothing but a latency has to be known, and every pattern may be shown as often as one likes.

    Takes latency, exposure and read-out for each pattern. Parameters as `drivers.device_bench.DeviceBench`.
    """

    _fired: int = field(default=0, init=False)

    def _prepared(self) -> None:
        if self.trigger is not None:
            self.trigger.arm()
        self._fired = 0

    def _expose(self, index: int, out: Pixels) -> FrameStamp:
        if self.settle_s is None:
            raise DeviceSettingError(
                f"{self.name}: it is not known how late {self.projector.name} shows a picture",
                "Measure it once with: scan latency --config FILE; it is kept with the rig.",
            )
        shown = self.projector.show(index)
        self.clock.sleep(shown + self.settle_s - self.clock.now())
        if self.trigger is None:
            self.camera.trigger()
        else:
            self.trigger.fire()
        self._fired += 1
        stamp = self.camera.fetch(out, self.exposure_s + self.timeout_s)
        if index == self._patterns - 1:
            self.check_sequence(self._fired)
        return replace(stamp, t_shown_s=shown)
