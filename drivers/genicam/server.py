"""What runs in the camera's own process: all of harvesters, called by one thread."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivers.devices import FrameFormat
from drivers.errors import (
    DeviceBusyError,
    DeviceLostError,
    DeviceSettingError,
    FrameTimeoutError,
    HardwareError,
)
from drivers.genicam.camera_time import CameraTime
from drivers.genicam.configuration import set_exposure, set_up
from drivers.genicam.discovery import ProducerReport, choose
from drivers.genicam.features import Features, Value
from drivers.genicam.library import is_genicam_error, kept_interrupt_handler, load_harvesters, reason, silence_output
from drivers.genicam.pixels import PIXEL_FORMATS
from drivers.genicam.producers import DeviceReport, load
from drivers.genicam.ring import FrameRing
from drivers.genicam.settings import GenICamSettings
from drivers.genicam.stream import Counters, Stream
from drivers.genicam.triggering import FreeRunGate, Gate, LineGate, SoftwareGate
from drivers.process import Emit

_POLL_S = 0.0005
"""How often the vendor's library is asked for frames while none come."""
_PRESENCE_S = 0.25
"""How often it is asked whether the camera is still there."""
_REACHABLE = (1, 2, 5, 6)  # DEVICE_ACCESS_STATUS: read and write, read only, and the same once open


class GenICamServer:
    """One camera: ``connect → configure → arm → start → … → stop``.

    Parameters
    ----------
    emit
        Takes each `Arrival`, and a `DeviceLostError` when the camera is gone.
    device
        The name that errors mention.
    settings
        Of the camera.
    """

    def __init__(self, emit: Emit, device: str, settings: GenICamSettings) -> None:
        silence_output()
        self._core = load_harvesters()
        self._emit = emit
        self._device = device
        self._settings = settings
        self._harvester: Any = None
        self._acquirer: Any = None
        self._features: Features | None = None
        self._time: CameraTime | None = None
        self._ring: FrameRing | None = None
        self._stream: Stream | None = None
        self._counters = Counters()
        self._buffers = _WarmBuffers()
        self._tells_presence = False
        self._looked_s = 0.0
        self._lost = ""

    def connect(self, producer: Path) -> DeviceReport:
        """Open the one camera of ``producer`` that the settings mean.

        Raises
        ------
        DeviceBusyError
            Another program holds it.
        DeviceNotFoundError
            It is not there, or more than one is meant.
        MissingLibraryError
            The producer cannot be used.
        """
        from genicam import gentl

        self._harvester, devices = load(producer)
        found = choose([ProducerReport(producer, None, tuple(devices))], self._settings)
        parameters, names = self._core.ParameterSet, self._core.ParameterKey
        wanted = parameters(
            {
                names.ENABLE_AUTO_CHUNK_DATA_UPDATE: False,
                names.NUM_BUFFERS_FOR_FETCH_CALL: self._settings.buffers,
                # The binding does not let go of the interpreter's lock for so long.
                names.TIMEOUT_PERIOD_ON_UPDATE_EVENT_DATA_CALL: 1,
            }
        )
        try:
            with kept_interrupt_handler():
                self._acquirer = self._harvester.create(devices.index(found), config=wanted)
        except (gentl.ResourceInUseException, gentl.AccessDeniedException, gentl.BusyException) as error:
            raise self._busy(found, error) from None
        except gentl.GenericException as error:
            raise DeviceLostError(
                f"{self._device} cannot be opened: {reason(error)}", "Switch the camera off and on again."
            ) from None
        self._acquirer._create_raw_buffers = self._buffers
        self._features = Features(self._device, self._acquirer.remote_device.node_map)
        self._tells_presence = self._access_status() in _REACHABLE
        return found

    def configure(self) -> tuple[FrameFormat, dict[str, tuple[Value, Value]]]:
        """Set the camera; returns what frames look like and what the camera has rounded."""
        assert self._features is not None
        with self._talking("configure"):
            frame_format = set_up(self._features, self._settings)
            self._time = CameraTime(self._features)
        return frame_format, dict(self._features.rounded)

    def set_exposure(self, exposure_us: float) -> float:
        """Set the exposure; returns what the camera has made of it, µs."""
        assert self._features is not None
        with self._talking("setting the exposure"):
            return set_exposure(self._features, exposure_us)

    def snapshot(self) -> dict[str, Value]:
        """All features that can be read."""
        assert self._features is not None
        with self._talking("reading the features"):
            return self._features.snapshot()

    def arm(self, frame_format: FrameFormat, ring: str) -> None:
        """Share the ring of that name, and have memory for the vendor's library."""
        if self._ring is not None:
            self._ring.close()
        self._ring = FrameRing(frame_format, self._settings.ring_frames, ring)
        with self._talking("arm"):
            source = self._acquirer.data_streams[0]
            remote = self._acquirer.remote_device.node_map
            size = source.payload_size if source.defines_payload_size() else remote.PayloadSize.value
        self._buffers(self._acquirer.num_buffers, size)

    def start(self) -> None:
        """Begin to acquire."""
        assert self._ring is not None
        with self._talking("start"):
            self._stream = Stream(
                self._acquirer,
                PIXEL_FORMATS[self._settings.pixel_format],
                self._ring,
                self._gate(),
                self._fire,
                self._counters,
                self._emit,
            )

    def trigger(self) -> None:
        """Ask for a frame."""
        assert self._stream is not None
        with self._talking("trigger"):
            self._stream.ask()

    def free(self, slot: int | None) -> None:
        """Take note that the scan has read an arrival."""
        if self._stream is not None:
            self._stream.free(slot)

    def give_up(self, waited_s: float) -> None:
        """Start the stream anew because a frame did not come, so that it cannot come later in another's place.

        Raises
        ------
        FrameTimeoutError
            Always, and says what the camera has delivered.
        DeviceLostError
            The camera is gone.
        """
        self._look(at_once=True)
        self.stop()
        self._counters.restarts += 1
        self.start()
        asked = "Check that the trigger reaches the camera" if self._settings.trigger == "line" else "Check the camera"
        raise FrameTimeoutError(
            f"{self._device}: no frame within {waited_s:g} s ({self._counters})",
            f"{asked}, and that the time allowed exceeds exposure and read-out.",
        )

    def stop(self) -> None:
        """End the acquisition."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with self._talking("stop"):
                stream.stop()

    def counters(self) -> dict[str, int]:
        """What was seen since the camera was opened."""
        return asdict(self._counters)

    def idle(self) -> float:
        """Take frames and look whether the camera is still there."""
        if self._acquirer is None or self._lost:
            return 1.0
        try:
            self._look()
            if self._stream is None:
                return _PRESENCE_S
            with self._talking("acquisition"):
                taken = self._stream.poll()
        except HardwareError as error:
            self._emit(error)
            return 0.0
        return 0.0 if taken else _POLL_S

    def close(self) -> None:
        """Let go of the camera and the memory, whatever state they are in."""
        for let_go in (
            # On a lost camera stop() fails, and only after that destroy() does not.
            lambda: self._acquirer and self._acquirer.stop(),
            lambda: self._acquirer and self._acquirer.destroy(),
            lambda: self._harvester and self._harvester.reset(),
            lambda: self._ring.close() if self._ring else None,
        ):
            with contextlib.suppress(Exception):
                let_go()

    def _gate(self) -> Gate:
        if self._settings.trigger == "line":
            return LineGate(self._device)
        if self._settings.trigger == "free_run":
            return FreeRunGate(self._settings.free_run_skip_frames)
        return SoftwareGate()

    def _fire(self) -> int | None:
        assert self._features is not None
        assert self._time is not None
        now_ns = self._time.now_ns()
        self._features.execute("TriggerSoftware")
        return now_ns

    def _look(self, *, at_once: bool = False) -> None:
        """Raise `DeviceLostError` where the camera has gone; nobody else tells."""
        now = time.monotonic()
        if not self._tells_presence or (now - self._looked_s < _PRESENCE_S and not at_once):
            return
        self._looked_s = now
        status = self._access_status()
        if status not in _REACHABLE:
            raise self._gone(f"it cannot be reached any more (access status {status})")

    def _access_status(self) -> int | None:
        try:
            return int(self._acquirer.device.module.access_status)
        except Exception as error:
            if is_genicam_error(error):
                return None
            raise

    @contextlib.contextmanager
    def _talking(self, what: str) -> Iterator[None]:
        """Turn what the binding raises into an error an operator can act on."""
        from genicam import genapi, gentl

        if self._lost:
            raise self._gone(self._lost)
        try:
            yield
        except gentl.GenericException as error:
            raise self._gone(f"{what} failed: {reason(error)}") from None
        except genapi.GenericException as error:
            self._look(at_once=True)
            raise DeviceSettingError(
                f"{self._device}: {what} failed: {reason(error)}",
                "Check the features in the bench file with the camera's manual, or switch the camera off and on.",
            ) from None

    def _gone(self, why: str) -> DeviceLostError:
        self._lost = why
        return DeviceLostError(
            f"{self._device}: {why}",
            "Check the camera's cable and power; the scan goes on by itself where the bench waits for it, else start "
            "again.",
        )

    def _busy(self, device: DeviceReport, error: Exception) -> DeviceBusyError:
        return DeviceBusyError(
            f"{self._device} is held by another program ({device}): {reason(error)}",
            "Close the vendor's viewer or the other scan; a camera that a crashed program has held is free again "
            "after a few seconds.",
        )


class _WarmBuffers:
    """Memory for the vendor's library to write frames into, kept from one start to the next.

    harvesters would take fresh memory each time, whose first touch costs more time than there is between two frames.
    """

    def __init__(self) -> None:
        self._memory: list[bytes] = []

    def __call__(self, number: int, size: int) -> list[bytes]:
        if len(self._memory) != number or any(len(buffer) != size for buffer in self._memory):
            self._memory = []
            # Repeating a byte writes it; bytes(size) would only promise zeros.
            self._memory = [b"\0" * size for _ in range(number)]
        return self._memory
