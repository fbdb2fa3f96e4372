"""What a device is, and the real ones. Knows nobody else."""

from drivers.bench import Bench, BenchKind, SteppedBench
from drivers.clock import SystemClock
from drivers.devices import (
    Camera,
    Clock,
    Device,
    DeviceState,
    FrameFormat,
    FrameStamp,
    Lifecycle,
    NoiseModel,
    Pixels,
    Projector,
    Trigger,
)
from drivers.errors import (
    DeviceLostError,
    DeviceSettingError,
    FrameTimeoutError,
    HardwareError,
    IllegalCallError,
    OperatorError,
)

__all__ = [
    "Bench",
    "BenchKind",
    "Camera",
    "Clock",
    "Device",
    "DeviceLostError",
    "DeviceSettingError",
    "DeviceState",
    "FrameFormat",
    "FrameStamp",
    "FrameTimeoutError",
    "HardwareError",
    "IllegalCallError",
    "Lifecycle",
    "NoiseModel",
    "OperatorError",
    "Pixels",
    "Projector",
    "SteppedBench",
    "SystemClock",
    "Trigger",
]
