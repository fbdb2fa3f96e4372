"""A projector that is a screen of this computer."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.shared_memory import SharedMemory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.clock import ahead_of_monotonic
from drivers.devices import Clock, DeviceState, Lifecycle, PlayRecord
from drivers.errors import (
    DeviceLostError,
    DeviceSettingError,
    HardwareError,
    SequenceFaultError,
)
from drivers.process import DeviceProcess, Emit, Server
from drivers.window.disturbance import WindowLostError
from drivers.window.screens import x11_libraries
from drivers.window.settings import WindowSettings

if TYPE_CHECKING:
    from drivers.window.timing import FlipTiming

_STAGED_BYTES = 32 << 20
_MIB = 1 << 20
_ANY_STATE = tuple(state for state in DeviceState if state is not DeviceState.CLOSED)


def serve_window(emit: Emit, settings: WindowSettings) -> Server:
    """Make the `drivers.window.server.WindowServer`; runs in the window's own process."""
    with x11_libraries():
        import pyglet

        # A second, hidden window is of no use here; nor is asking for errors after every call.
        pyglet.options.shadow_window = False
        pyglet.options.debug_gl = False
        from drivers.window.server import WindowServer
    return WindowServer(emit, settings)


class WindowProjector:
    """Shows pictures in a window that fills a screen; a `drivers.devices.SequencePlayer`.

    Parameters
    ----------
    settings
        Which screen, and how.
    clock
        What time stamps are on.
    server
        Makes what runs in the window's process.

    Notes
    -----
    A window that was closed, minimised, moved or lost its screen is lost: `DeviceLostError`, and `close` and `open`
    make a new one. One that is covered is not: `SequenceFaultError`, and the sequence can be repeated. Either is seen
    at once by a playing sequence, and at the latest by the next `show`, `load`, `play` or `verify` otherwise.
    """

    def __init__(
        self,
        settings: WindowSettings,
        clock: Clock,
        *,
        server: Callable[[Emit, WindowSettings], Server] = serve_window,
    ) -> None:
        self.name = "projector window"
        self._settings = settings
        self._clock = clock
        self._life = Lifecycle(self.name)
        self._process = DeviceProcess(self.name, server, settings)
        self._staging: SharedMemory | None = None
        self._refresh_s = 0.0 if settings.refresh_hz is None else 1 / settings.refresh_hz
        self._timing: FlipTiming | None = None
        self._unlocked = ""
        self._facts: dict[str, Any] = {}
        self._loaded = 0
        self._plays = 0
        self._counts = {"shown": 0, "played": 0, "late": 0}

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self._settings.width_px, self._settings.height_px

    @property
    def refresh_s(self) -> float:
        """Time of one refresh of the screen, s: measured where flips keep step with it; known once configured."""
        return self._refresh_s

    @property
    def period_s(self) -> float:
        """Time one picture of a played sequence is on, s: `refresh_s` times the setting ``hold``."""
        return self._refresh_s * self._settings.hold

    @property
    def pid(self) -> int | None:
        """Number of the window's process, None where there is none."""
        return self._process.pid

    def open(self) -> None:
        """Open the window, dark.

        Raises
        ------
        DeviceNotFoundError
            There is no such screen, or no display at all.
        DeviceSettingError
            The screen is in another mode or rate, is scaled, or the window does not get there.
        MissingLibraryError
            X or OpenGL is missing.
        """
        self._life.check("open")
        self._process.start()
        try:
            self._facts = self._process.call("facts")
            self._staging = SharedMemory(create=True, size=max(_STAGED_BYTES, 3 * self.size[0] * self.size[1]))
            try:
                self._process.call("stage", self._staging.name)
            finally:
                # It lives on in the two processes, and in none of them longer than that process.
                self._staging.unlink()
        except BaseException:
            self._let_go()
            raise
        self._counts = dict.fromkeys(self._counts, 0)
        self._life.move("open")

    def configure(self) -> None:
        """Measure how the screen refreshes.

        Raises
        ------
        DeviceSettingError
            Its rate is neither measured nor told nor set, or a flip takes longer than a refresh.
        """
        self._life.check("configure")
        timing: FlipTiming = self._call("measure", timeout_s=60.0)
        told_hz = self._settings.refresh_hz or self._facts["screen"]["mode_hz"]
        self._timing = timing
        if self._settings.pacing == "timer":
            assert self._settings.refresh_hz is not None
            self._unlocked = ""
            self._refresh_s = 1 / self._settings.refresh_hz
            if timing.period_s > 0.8 * self._refresh_s:
                raise DeviceSettingError(
                    f"{self.name}: a flip takes {timing.period_s * 1e3:.1f} ms, too long for {told_hz:g} Hz",
                    "Lower refresh_hz, or let the machine do less beside.",
                )
        else:
            self._unlocked = timing.unlocked(told_hz, self._settings.max_jitter_ms * 1e-3)
            if not self._unlocked:
                self._refresh_s = timing.period_s
            elif told_hz:
                self._refresh_s = 1 / told_hz
            else:
                raise DeviceSettingError(
                    f"{self.name}: the screen does not tell its refresh rate, and {self._unlocked}",
                    "Set refresh_hz; on an X server without a refresh set pacing: timer as well.",
                )
        self._call("configure", self._refresh_s)
        self._life.move("configure")

    def load(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Take over the pictures of one sequence; the former ones are forgotten.

        Parameters
        ----------
        patterns
            uint8; grey (height, width), or (height, width, 3) red, green, blue as packed bit planes for a projector's
            video pattern mode are, these only with the setting ``channels: grey``.

        Raises
        ------
        DeviceSettingError
            A picture is no such picture, or there are too many.
        """
        self._life.check("arm")
        self._check_pictures(patterns)
        self._call("clear")
        self._loaded = 0
        room = 0 if self._staging is None else self._staging.size
        for batch in _batches(patterns, room):
            self._send(batch)
        self._loaded = len(patterns)
        self._life.move("arm")

    def show(self, index: int) -> float:
        """Show picture ``index``; returns when the flip to it was complete, s on the bench's clock.

        Raises
        ------
        DeviceSettingError
            There is no such picture.
        DeviceLostError, SequenceFaultError
            The picture, or one before it, does not reach the surface; see the notes.
        """
        self._life.require("show", DeviceState.ARMED)
        if not 0 <= index < self._loaded:
            raise DeviceSettingError(
                f"{self.name}: there is no picture {index} among the {self._loaded} loaded ones",
                "Load the sequence again before it is shown.",
            )
        flipped, late = self._call("show", index)
        self._counts["shown"] += 1
        self._counts["late"] += late
        return float(flipped) + ahead_of_monotonic(self._clock)

    def verify(self) -> None:
        """Raise whatever has kept a picture off the surface up to now; worth a call after the last exposure.

        Raises
        ------
        DeviceLostError, SequenceFaultError
            See the notes.
        """
        self._life.require("verify", DeviceState.CONFIGURED, DeviceState.ARMED)
        self._call("verify")

    def play(self) -> None:
        """Begin to show all loaded pictures, each for ``hold`` refreshes; returns at once.

        Raises
        ------
        DeviceSettingError
            Flips do not keep step with the screen.
        """
        self._life.check("start")
        if self._unlocked:
            raise DeviceSettingError(
                f"{self.name}: a sequence cannot be played: {self._unlocked}",
                "Switch the compositor off, use an X11 session, enable vsync in the graphics driver "
                "(__GL_SYNC_TO_VBLANK=1, vblank_mode=1); or take patterns step by step.",
            )
        self._plays += 1
        self._call("play", self._plays)
        self._life.move("start")

    def finish(self, timeout_s: float) -> PlayRecord:
        """Wait until the last picture was on for its period; the pictures stay loaded, the last one stays on.

        Raises
        ------
        SequenceFaultError
            It was not within ``timeout_s``, or the window was covered.
        DeviceLostError
            The window is lost.
        """
        self._life.require("finish", DeviceState.RUNNING)
        deadline = time.monotonic() + timeout_s
        while True:
            event = self._next_event(deadline - time.monotonic())
            if event is None:
                self.darken()
                kind = DeviceLostError if self.state is DeviceState.FAULT else SequenceFaultError
                raise kind(
                    f"{self.name}: {self._loaded} pictures were not played within {timeout_s:g} s",
                    f"Allow {self._loaded * self.period_s:.2f} s and more; see what else keeps the machine busy.",
                )
            what, number, *rest = event
            if number != self._plays:
                continue  # of a sequence that was cut short
            self._rest()
            if what == "broken":
                raise self._lost(rest[0])
            shown, late = rest
            self._counts["played"] += len(shown)
            self._counts["late"] += len(late)
            ahead_s = ahead_of_monotonic(self._clock)
            return PlayRecord(tuple(t + ahead_s for t in shown), late)

    def darken(self) -> None:
        """Show black and end a playing sequence; where the window is gone, there is nothing left to light."""
        self._life.require("darken", *_ANY_STATE)
        if self._process.alive:
            try:
                self._process.call("darken", timeout_s=2.0)
            except HardwareError:
                self._life.move("fail")
        if self.state is DeviceState.RUNNING:
            self._rest()

    def close(self) -> None:
        """Close the window; allowed in every state, any number of times."""
        self._let_go()
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot: settings, screen, timing, counts, and ``warnings`` of what cannot be ruled out."""
        if self.state in (DeviceState.OPEN, DeviceState.CONFIGURED, DeviceState.ARMED):
            # A window that is lost just now is for the next call to report; this one records what was known.
            with contextlib.suppress(HardwareError):
                self._facts = self._call("facts")
        warnings = list(self._facts.get("warnings", []))
        if self._unlocked:
            warnings.append(f"sequences cannot be played: {self._unlocked}")
        timing = {
            "refresh_s": self._refresh_s,
            "flip_s": None if self._timing is None else self._timing.period_s,
            "jitter_s": None if self._timing is None else self._timing.jitter_s,
            "locked": self._timing is not None and self._settings.pacing == "vsync" and not self._unlocked,
        }
        return {
            "name": self.name,
            "simulated": False,
            "state": self.state.name,
            "settings": self._settings.model_dump(mode="json"),
            **self._facts,
            "timing": timing,
            "counts": dict(self._counts),
            "warnings": warnings,
        }

    def _rest(self) -> None:
        self._life.move("stop")
        self._life.move("arm")

    def _let_go(self) -> None:
        self._process.stop()
        staging, self._staging = self._staging, None
        if staging is not None:
            staging.close()
        self._loaded = 0

    def _check_pictures(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        width, height = self.size
        shapes = {(height, width)} | ({(height, width, 3)} if self._settings.channels == "grey" else set())
        for number, picture in enumerate(patterns):
            if picture.dtype != np.uint8 or picture.shape not in shapes:
                raise DeviceSettingError(
                    f"{self.name}: picture {number} is {picture.dtype} {picture.shape}, not uint8 "
                    f"{' or '.join(map(str, sorted(shapes)))}",
                    f"Project pictures of {width} × {height} px, 8-bit grey.",
                )
        total = sum(picture.nbytes for picture in patterns)
        if total > self._settings.memory_limit_mib * _MIB:
            raise DeviceSettingError(
                f"{self.name}: {len(patterns)} pictures fill {total / _MIB:.0f} MiB, allowed are "
                f"{self._settings.memory_limit_mib}",
                "Load shorter sequences, or raise memory_limit_mib where the graphics card has the room.",
            )

    def _send(self, batch: Sequence[NDArray[np.uint8]]) -> None:
        assert self._staging is not None
        begin = 0
        for picture in batch:
            np.ndarray(picture.shape, np.uint8, self._staging.buf, begin)[...] = picture
            begin += picture.nbytes
        self._call("load", [picture.shape for picture in batch], timeout_s=30.0)

    def _call(self, method: str, *args: Any, timeout_s: float = 5.0) -> Any:
        try:
            return self._process.call(method, *args, timeout_s=timeout_s)
        except HardwareError as error:
            raise self._lost(error) from None

    def _next_event(self, timeout_s: float) -> Any:
        try:
            event = self._process.next_event(timeout_s)
        except DeviceLostError as error:
            raise self._lost(error) from None
        if event is not None and event[0] == "lost":
            self._life.move("fail")
            raise event[1]
        return event

    def _lost(self, error: HardwareError) -> HardwareError:
        """Go to FAULT for an error that says the window is gone, and give the reason where its process left one."""
        if not isinstance(error, DeviceLostError):
            return error
        self._life.move("fail")
        if isinstance(error, WindowLostError):
            return error
        with contextlib.suppress(DeviceLostError):
            while (event := self._process.next_event(0.0)) is not None:
                if event[0] == "lost":
                    reason: HardwareError = event[1]
                    return reason
        return DeviceLostError(
            error.message,
            "Start the scan again; if this comes back, check the graphics driver (glxinfo -B) and the X server's log.",
        )


def _batches(patterns: Sequence[NDArray[np.uint8]], room: int) -> list[list[NDArray[np.uint8]]]:
    """Cut ``patterns`` into rows that fit ``room`` bytes each."""
    batches: list[list[NDArray[np.uint8]]] = []
    filled = room
    for picture in patterns:
        if filled + picture.nbytes > room:
            batches.append([])
            filled = 0
        batches[-1].append(picture)
        filled += picture.nbytes
    return batches
