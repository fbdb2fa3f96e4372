"""The camera as a scan sees it; all that a vendor has written runs in another process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drivers.clock import ahead_of_monotonic
from drivers.devices import Clock, DeviceState, FrameFormat, FrameStamp, Lifecycle, NoiseModel, Pixels
from drivers.errors import DeviceLostError, DeviceSettingError, FrameLossError, OperatorError
from drivers.genicam.discovery import choose, discover
from drivers.genicam.producers import DeviceReport, producer_files
from drivers.genicam.ring import FrameRing
from drivers.genicam.server import GenICamServer
from drivers.genicam.settings import GenICamSettings
from drivers.process import DeviceProcess


class GenICamCamera:
    """A camera of any vendor by the GenICam standard; satisfies `drivers.Camera`.

    Parameters
    ----------
    settings
        Which camera, and how it is set.
    clock
        The bench's time.

    Notes
    -----
    Frames come through a ring in shared memory: the camera's process copies each out of the vendor's buffer, `fetch`
    copies it to its place. While the ring is full, frames wait in the vendor's buffers. Every arrival is answered by
    exactly one `fetch`, with a good frame or with `FrameLossError`. A fetch that has waited in vain starts the stream
    anew, so that a late frame cannot be taken for the next one.
    """

    def __init__(self, settings: GenICamSettings, clock: Clock) -> None:
        keys = (settings.user_name, settings.serial, settings.model)
        self.name = " ".join(["camera", *[key for key in keys if key][:1]])
        self._settings = settings
        self._clock = clock
        self._life = Lifecycle(self.name)
        self._process = DeviceProcess(self.name, GenICamServer, self.name, settings)
        self._identity: DeviceReport | None = None
        self._format: FrameFormat | None = None
        self._ring: FrameRing | None = None
        self._rounded: dict[str, Any] = {}
        self._features: dict[str, Any] | None = None
        self._counters: dict[str, int] = {}
        self._exposure_us = settings.exposure_us

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def noise(self) -> NoiseModel | None:
        """The noise model, where the settings hold one."""
        if self._settings.read_noise_dn is None:
            return None
        electrons = self._settings.electrons_per_dn
        return NoiseModel(self._settings.read_noise_dn, 0.0 if electrons is None else 1 / electrons)

    @property
    def capacity(self) -> int:
        """How many frames may wait to be fetched before one is lost."""
        return self._settings.ring_frames + self._settings.buffers

    def open(self) -> None:
        """Look for the camera, start its process and connect.

        Raises
        ------
        DeviceNotFoundError
            No camera, or more than one, is meant; the message lists what is there.
        DeviceBusyError
            Another program holds it.
        MissingLibraryError
            harvesters or the GenICam binding is not installed.
        DeviceLostError
            The producer crashed or did not answer.
        """
        self._life.check("open")
        wait_s = self._settings.connect_timeout_s
        producer = self._producer()
        try:
            self._process.start(wait_s)
            self._identity = self._process.call("connect", producer, timeout_s=wait_s)
        except DeviceLostError as error:
            self._process.stop()
            raise DeviceLostError(
                f"{error.message}, while {producer} was looking for it",
                "Check the camera's cable and power; where this is not its vendor's producer, name that as `producer`.",
            ) from None
        except BaseException:
            self._process.stop()
            raise
        self._life.move("open")

    def configure(self) -> FrameFormat:
        """Set the camera and say what frames will look like.

        Raises
        ------
        DeviceSettingError
            The camera does not take a setting; the message quotes its own limits.
        """
        self._life.check("configure")
        self._features = None
        self._exposure_us = self._settings.exposure_us
        frame_format, self._rounded = self._call("configure")
        if frame_format != self._format:
            self._drop_ring()
        self._format = frame_format
        self._life.move("configure")
        return frame_format  # type: ignore[no-any-return]

    def set_exposure(self, exposure_s: float) -> float:
        """Expose so long until the camera is configured again; returns what the camera has made of it, s.

        Raises
        ------
        DeviceSettingError
            The camera does not take it; the message quotes its own limits.
        """
        self._life.require("set_exposure", DeviceState.CONFIGURED)
        made_us: float = self._call("set_exposure", round(1e6 * exposure_s, 3))
        self._exposure_us = made_us
        return made_us * 1e-6

    def arm(self) -> None:
        """Make the ring of frames ready and record the camera's features, once per configuration."""
        self._life.check("arm")
        assert self._format is not None
        if self._ring is None:
            ring = FrameRing(self._format, self._settings.ring_frames)
            try:
                self._call("arm", self._format, ring.name)
            except BaseException:
                ring.close()
                raise
            finally:
                ring.forget_name()
            self._ring = ring
        if self._features is None:
            self._features = self._call("snapshot")
        self._life.move("arm")

    def start(self) -> None:
        """From here on a trigger exposes a frame."""
        self._life.check("start")
        self._call("start")
        self._life.move("start")

    def trigger(self) -> None:
        """Ask for one frame now, or once the frame of the trigger before has come.

        Raises
        ------
        DeviceSettingError
            The camera is triggered by an edge on its input.
        DeviceLostError
            The camera has gone.
        """
        self._life.require("trigger", DeviceState.RUNNING)
        self._call("trigger")

    def fetch(self, out: Pixels, timeout_s: float) -> FrameStamp:
        """Wait for the oldest frame that was asked for and copy it to ``out`` (height, width).

        Raises
        ------
        FrameTimeoutError
            None came within ``timeout_s``; whatever was asked for is forgotten.
        FrameLossError
            Frames were lost, or this one is incomplete or of another shape; the message says which.
        DeviceLostError
            The camera has gone, or its vendor's library has crashed.
        DeviceSettingError
            ``out`` is no place for such a frame.
        """
        self._life.require("fetch", DeviceState.RUNNING)
        assert self._format is not None
        assert self._ring is not None
        if out.shape != self._format.shape or out.dtype != self._format.dtype:
            raise DeviceSettingError(
                f"{self.name}: a frame is {self._format.dtype} {self._format.shape}, its place {out.dtype} {out.shape}",
                "Allocate frames in the format that configure() returned.",
            )
        with self._losing():
            arrival = self._process.next_event(timeout_s)
            if arrival is None:
                self._give_up(timeout_s)
            if isinstance(arrival, OperatorError):
                raise arrival
            if arrival.slot is not None:
                np.copyto(out, self._ring[arrival.slot])
            self._process.post("free", arrival.slot)
        if arrival.fault:
            raise FrameLossError(
                f"{self.name}: {arrival.fault}",
                "The sequence is to be taken again; where this happens often, check the cable, the bandwidth and "
                "`buffers`.",
            )
        t_host_s = arrival.t_host_s + ahead_of_monotonic(self._clock)
        return FrameStamp(arrival.frame_id, arrival.t_device_s, t_host_s)

    def stop(self) -> None:
        """No more triggers; frames that nobody has fetched are dropped."""
        self._life.check("stop")
        self._call("stop")
        with self._losing():
            self._drop_events()
        self._life.move("stop")

    def close(self) -> None:
        """Let go of the camera, its process and the memory."""
        if self._life.state not in (DeviceState.CLOSED, DeviceState.FAULT):
            with contextlib.suppress(OperatorError):
                self._counters = self._process.call("counters", timeout_s=self._settings.answer_timeout_s)
        self._process.stop()
        self._drop_ring()
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready: identity, settings, what the camera rounded, its features when it was armed, and counters."""
        if self._life.state not in (DeviceState.CLOSED, DeviceState.FAULT):
            with contextlib.suppress(DeviceLostError):
                self._counters = self._call("counters")
        identity = {} if self._identity is None else asdict(self._identity) | {"producer": str(self._identity.producer)}
        return {
            "name": self.name,
            "simulated": False,
            "state": self.state.name,
            "identity": {name: value for name, value in identity.items() if name != "access"},
            "settings": self._settings.model_dump(mode="json"),
            "exposure_us": self._exposure_us,
            "rounded": {name: {"asked": asked, "made": made} for name, (asked, made) in self._rounded.items()},
            "features": self._features or {},
            "counters": self._counters,
        }

    def _producer(self) -> Path:
        """The producer to load; of several, each is tried in a process of its own, in case one is broken."""
        files = producer_files(self._settings.producer)
        if len(files) == 1:
            return files[0]
        return choose(discover(files, self._settings.connect_timeout_s), self._settings).producer

    def _give_up(self, waited_s: float) -> None:
        try:
            self._call("give_up", waited_s)
        finally:
            self._drop_events()

    def _call(self, method: str, *args: Any) -> Any:
        with self._losing():
            return self._process.call(method, *args, timeout_s=self._settings.answer_timeout_s)

    @contextlib.contextmanager
    def _losing(self) -> Iterator[None]:
        try:
            yield
        except DeviceLostError:
            self._life.move("fail")
            raise

    def _drop_events(self) -> None:
        while self._process.next_event(0.0) is not None:
            pass

    def _drop_ring(self) -> None:
        ring, self._ring = self._ring, None
        if ring is not None:
            ring.close()
