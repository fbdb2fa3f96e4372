"""What a device is, and the real ones. Knows nobody else."""

from drivers.bench import Bench, BenchKind, LatencyBound
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
    PlayRecord,
    Projector,
    SequencePlayer,
    Trigger,
    TriggerCounts,
)
from drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    FrameLossError,
    FrameTimeoutError,
    HardwareError,
    IllegalCallError,
    MissingLibraryError,
    OperatorError,
    ProtocolError,
    SequenceFaultError,
)
from drivers.latency import DisplayLatency
from drivers.stepped import SteppedBench
from drivers.streamed import StreamedBench

__all__ = [
    "Bench",
    "BenchKind",
    "Camera",
    "Clock",
    "Device",
    "DeviceBusyError",
    "DeviceLostError",
    "DeviceNotFoundError",
    "DeviceSettingError",
    "DeviceState",
    "DisplayLatency",
    "FrameFormat",
    "FrameLossError",
    "FrameStamp",
    "FrameTimeoutError",
    "HardwareError",
    "IllegalCallError",
    "LatencyBound",
    "Lifecycle",
    "MissingLibraryError",
    "NoiseModel",
    "OperatorError",
    "Pixels",
    "PlayRecord",
    "Projector",
    "ProtocolError",
    "SequenceFaultError",
    "SequencePlayer",
    "SteppedBench",
    "StreamedBench",
    "SystemClock",
    "Trigger",
    "TriggerCounts",
]
