"""The projector's window in a process of its own: its events, its pictures, its flips."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import time
from dataclasses import dataclass, field
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np
from pyglet import gl
from pyglet.libs.x11 import xlib

from drivers.errors import DeviceSettingError, HardwareError
from drivers.process import Emit
from drivers.window.canvas import Canvas, Picture
from drivers.window.disturbance import CLOSED, SERVER_GONE, Disturbance
from drivers.window.placement import open_window
from drivers.window.screens import choose_screen
from drivers.window.settings import WindowSettings
from drivers.window.timing import FlipTiming, late_pictures
from drivers.window.watch import WindowWatch
from drivers.window.x11 import XConnection

_PATIENCE_S = 0.01
_PRIORITY = -10
_EXAMINE_EVERY_S = 0.5
_AWAKE_EVERY_S = 20.0


@dataclass
class _Sequence:
    """A sequence that is being played."""

    number: int
    pictures: int
    hold: int
    refresh_s: float
    refreshes: int = 0
    shown_s: list[float] = field(default_factory=list)
    delayed: set[int] = field(default_factory=set)

    @property
    def over(self) -> bool:
        """True when every picture has had its refreshes."""
        return self.refreshes == self.pictures * self.hold

    def late(self) -> tuple[int, ...]:
        """Numbers of the pictures that came too late."""
        return tuple(sorted({*late_pictures(self.shown_s, self.hold, self.refresh_s), *self.delayed}))


class WindowServer:
    """Opens the window and shows what it is told to; see `drivers.process.Server`.

    Parameters
    ----------
    emit
        Takes ``("played", number, shown_s, late)``, ``("broken", number, error)`` and ``("lost", error)``.
    settings
        Of the projector.
    """

    def __init__(self, emit: Emit, settings: WindowSettings) -> None:
        self._emit = emit
        self._settings = settings
        self._staging: SharedMemory | None = None
        self._sequence: _Sequence | None = None
        self._disturbance: Disturbance | None = None
        self._troubled = False
        self._refresh_s = 0.0
        self._content: tuple[int | None, bool] = None, False
        self._exposed = False
        self._flipped_s = 0.0
        self._unfocused = 0
        self._next_examination = 0.0
        self._next_key = 0.0
        self._keep_the_handler = xlib.XIOErrorHandler(self._server_gone)
        xlib.XSetIOErrorHandler(self._keep_the_handler)
        self._connection = XConnection(settings.display)
        size = settings.width_px, settings.height_px
        self._screen = choose_screen(self._connection.screens(), settings.screen, size)
        self._check_rate()
        vsync = settings.pacing == "vsync"
        self._window: Any = open_window(
            self._connection, settings.display, self._screen, fullscreen=settings.fullscreen, vsync=vsync
        )
        self._window.push_handlers(
            on_close=self._on_close, on_expose=self._on_expose, on_deactivate=self._on_deactivate
        )
        self._canvas = Canvas(*size, settings.channels, settings.sync_patch)
        self._saver_suspended = self._connection.suspend_screen_saver()
        self._watch = WindowWatch(self._connection, self._window._window, self._screen)
        self._flip_now()
        # Flips should not wait for what the scan computes; not every account may ask for that.
        with contextlib.suppress(OSError):
            os.nice(_PRIORITY)
        gc.freeze()  # collecting what will stay anyway would cost milliseconds between two flips

    def _check_rate(self) -> None:
        wanted, given = self._settings.refresh_hz, self._screen.refresh_hz
        if self._settings.pacing == "vsync" and wanted and given and abs(given / wanted - 1) > 0.01:
            raise DeviceSettingError(
                f"projector window: screen {self._screen.name} refreshes at {given:.2f} Hz, not at {wanted:g} Hz",
                f"Set the rate: xrandr --output {self._screen.name} --mode {self._settings.width_px}x"
                f"{self._settings.height_px} --rate {wanted:g}; or correct refresh_hz.",
            )

    # Commands

    def facts(self) -> dict[str, Any]:
        """What is known of the screen and of who draws."""
        screen = self._screen
        return {
            "screen": {
                "index": screen.index,
                "name": screen.name,
                "area_px": list(screen.area),
                "mode_hz": screen.refresh_hz,
            },
            "renderer": self._canvas.renderer(),
            "warnings": self._warnings(),
            "focus_lost": self._unfocused,
        }

    def measure(self) -> FlipTiming:
        """Flip black as fast as the screen lets, and see how regularly that goes."""
        self._content = None, False
        flips = []
        for _ in range(self._settings.timing_flips):
            self._canvas.draw(None)
            flips.append(self._swap())
            self._window.dispatch_events()
        self._check_thoroughly(forget=True)
        return FlipTiming.of(flips)

    def configure(self, refresh_s: float) -> None:
        """Take over the time of one refresh, s."""
        self._refresh_s = refresh_s

    def stage(self, name: str) -> None:
        """Attach to the shared memory through which pictures come."""
        self._staging = SharedMemory(name)

    def clear(self) -> None:
        """Forget the pictures of the last sequence; what is on the screen stays."""
        self._check_thoroughly(forget=True)
        self._sequence = None
        self._content = None, False
        self._canvas.clear()

    def load(self, shapes: list[tuple[int, ...]]) -> None:
        """Take pictures, one behind the other, from the shared memory."""
        assert self._staging is not None
        pictures, begin = [], 0
        for shape in shapes:
            picture: Picture = np.ndarray(shape, np.uint8, self._staging.buf, begin)
            pictures.append(picture)
            begin += picture.nbytes
        self._canvas.load(pictures)

    def show(self, index: int) -> tuple[float, bool]:
        """Show a picture; when it was flipped (s, monotonic clock) and whether that took too long."""
        self._check()
        self._content = index, False
        self._draw()
        asked = self._wait()
        flipped = self._swap()
        self._check()
        return flipped, flipped - asked > 1.5 * self._refresh_s

    def darken(self) -> None:
        """Show black and end whatever was playing."""
        self._sequence = None
        self._content = None, False
        if self._can_draw and self._connection.viewable(self._window._window):
            self._flip_now()

    def play(self, number: int) -> None:
        """Begin to show all pictures, one after the other."""
        self._check_thoroughly()
        self._sequence = _Sequence(number, self._canvas.loaded, self._settings.hold, self._refresh_s)

    def verify(self) -> None:
        """Raise whatever has kept the right picture off the surface."""
        self._check_thoroughly()

    # Between commands

    def idle(self) -> float:
        """Show the next refresh of a playing sequence, or look after the window."""
        if self._sequence is not None:
            self._step(self._sequence)
            return 0.0
        self._pump()
        now = time.monotonic()
        if now > self._next_examination:
            # Not everything is told by an event; changed grey curves, for one, are not.
            self._note(self._watch.examine())
            self._next_examination = now + _EXAMINE_EVERY_S
        else:
            self._note(self._watch.look())
        if self._exposed and self._can_draw:
            self._flip_now()
        if now > self._next_key:
            self._connection.keep_awake()
            self._next_key = now + _AWAKE_EVERY_S
        return _PATIENCE_S

    def close(self) -> None:
        """Close the window; the screen saver may come again."""
        if self._staging is not None:
            self._staging.close()
        if self._can_draw:
            self._window.close()
        self._connection.close()

    def _step(self, sequence: _Sequence) -> None:
        """One refresh of a playing sequence, or the end of it."""
        try:
            self._check()
            if not sequence.over:
                self._refresh(sequence)
                return
            if sequence.pictures:
                # The last picture is on for its period until this flip, and stays on. Its patch does not: the next
                # sequence has to begin with a rising edge.
                self._content = self._content[0], False
                self._draw()
                self._wait()
                self._swap()
            self._check_thoroughly()
            self._emit(("played", sequence.number, tuple(sequence.shown_s), sequence.late()))
        except HardwareError as error:
            self._emit(("broken", sequence.number, error))
        self._sequence = None

    def _refresh(self, sequence: _Sequence) -> None:
        index, repeated = divmod(sequence.refreshes, sequence.hold)
        self._content = index, index % 2 == 0
        self._draw()
        due = self._wait()
        flipped = self._swap()
        sequence.refreshes += 1
        if not repeated:
            sequence.shown_s.append(flipped)
            # The screen flips at refreshes only; a timer can miss its moment by any time.
            if self._settings.pacing == "timer" and flipped - due > 0.5 * sequence.refresh_s:
                sequence.delayed.add(index)

    def _wait(self) -> float:
        """Wait for the moment a timer sets for the flip; that moment, or now where the screen sets the pace, s."""
        now = time.monotonic()
        if self._settings.pacing == "vsync":
            return now
        period, phase = self._refresh_s, self._settings.timer_phase_ms * 1e-3
        due = (math.floor((now - phase) / period) + 1) * period + phase
        if due - self._flipped_s < 0.75 * period:
            # As with a screen's refresh, a late flip moves the next ones: two within one would lose a picture.
            due += period
        time.sleep(due - now)
        return due

    def _draw(self) -> None:
        index, patch_white = self._content
        self._canvas.draw(index, patch_white=patch_white)
        gl.glFinish()  # so that at the moment of the flip nothing is left to do but to flip

    def _swap(self) -> float:
        """Swap buffers, wait until that has happened, and say when, s."""
        self._exposed = False
        self._window.flip()
        # The next picture cannot be begun before the swap is done: having cleared one pixel of it proves the swap.
        gl.glEnable(gl.GL_SCISSOR_TEST)
        gl.glScissor(0, 0, 1, 1)
        gl.glClear(gl.GL_COLOR_BUFFER_BIT)
        gl.glDisable(gl.GL_SCISSOR_TEST)
        gl.glFinish()
        self._flipped_s = time.monotonic()
        return self._flipped_s

    def _flip_now(self) -> None:
        self._draw()
        self._swap()

    @property
    def _can_draw(self) -> bool:
        return self._window.context is not None

    def _pump(self) -> None:
        if self._can_draw:
            self._window.dispatch_events()

    def _check(self) -> None:
        """Raise what has happened to the window; quick while nothing has changed on the desktop."""
        self._pump()
        if self._disturbance is None:
            self._note(self._watch.examine() if self._troubled else self._watch.look())
        self._raise()

    def _check_thoroughly(self, *, forget: bool = False) -> None:
        """The same, asking the X server in any case; with ``forget``, what was and is over does not count."""
        self._pump()
        if forget:
            self._watch.forget()
            if self._disturbance is not None and not self._disturbance.lost:
                self._disturbance = None
        self._note(self._watch.look_thoroughly())
        self._raise()

    def _raise(self) -> None:
        disturbance = self._disturbance
        self._troubled = disturbance is not None
        if disturbance is None:
            return
        if not disturbance.lost:
            self._disturbance = None  # said once; whether it lasts is examined again
        raise disturbance.error()

    def _note(self, disturbance: Disturbance | None) -> None:
        # What came first is the cause of what followed.
        if self._disturbance is None:
            self._disturbance = disturbance

    # What the window says

    def _on_close(self) -> bool:
        self._disturbance = CLOSED
        self._window.close()
        return True

    def _on_expose(self) -> None:
        self._exposed = True

    def _on_deactivate(self) -> None:
        # No fault: an operator works on the other screen. What comes to lie above the window is seen anyway.
        self._unfocused += 1

    def _server_gone(self, display: Any) -> int:
        # Xlib ends the process when this returns.
        self._emit(("lost", SERVER_GONE.error()))
        os._exit(1)

    def _warnings(self) -> list[str]:
        warnings = []
        session_display = self._settings.display in (None, os.environ.get("DISPLAY"))
        wayland = os.environ.get("XDG_SESSION_TYPE") == "wayland" and session_display
        if wayland or self._connection.is_xwayland:
            warnings.append(
                "this is a Wayland session: neither flips nor the place of the window can be trusted; log in with an "
                "X11 session"
            )
        if self._connection.has_compositor:
            warnings.append(
                "a compositor is running and may delay pictures by one or two refreshes; the window asks it to stand "
                "aside, calibrate the latency to see that it does"
            )
        if not self._saver_suspended:
            warnings.append(
                "the screen saver and energy saving cannot be suspended (apt install libxss1); switch them off: "
                "xset s off -dpms"
            )
        if self._settings.pacing == "vsync" and "llvmpipe" in self._canvas.renderer():
            warnings.append(
                "OpenGL is drawn by the processor (llvmpipe): flips may come late; install the graphics card's driver"
            )
        if self._settings.pacing == "timer" and self._screen.refresh_hz:
            warnings.append("pacing timer on a screen with a refresh of its own: pictures are torn; use vsync")
        if self._screen.primary and len(self._connection.screens()) > 1:
            warnings.append("the projector is the desktop's primary screen, where panels and dialogs appear")
        return warnings
