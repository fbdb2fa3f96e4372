"""Projector windows on X servers of their own, for tests."""

import shutil
import time
from contextlib import contextmanager
from ctypes.util import find_library

import numpy as np
from requirements import require

from drivers import DeviceState, SystemClock
from drivers.window import WindowProjector, WindowSettings
from sim_backend.xserver import XServer

PACKAGES = "apt install xvfb x11-xserver-utils libgl1 libglx-mesa0 libgl1-mesa-dri libxrandr2 libxss1"


def require_display():
    require(shutil.which("Xvfb"), f"Xvfb is not installed: {PACKAGES}")
    for library in ("GL", "Xrandr", "Xss"):
        require(find_library(library), f"lib{library} is not installed: {PACKAGES}")


def settings_for(server, **changes):
    """Settings of a window that fills the X server's screen and flips 100 times a second."""
    values = {
        "width_px": server.width,
        "height_px": server.height,
        "display": server.display,
        "pacing": "timer",
        "refresh_hz": 100.0,
        "timing_flips": 30,
    }
    return WindowSettings.model_validate(values | changes)


def within(seconds, condition):
    """Wait until ``condition()`` is true; False where it is not within ``seconds``."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return bool(condition())


class OneWindow:
    """At most one open window, opened anew only where the settings change or it was lost: that takes a second."""

    def __init__(self, server):
        self.server = server
        self._device = None
        self._key = None

    def __call__(self, *, clock=None, make=WindowProjector, **changes):
        """A configured window of these settings."""
        key = (clock, make, repr(changes))
        device = self._device
        if device is None or self._key != key or device.state not in (DeviceState.CONFIGURED, DeviceState.ARMED):
            self.close()
            self._device, self._key = make(settings_for(self.server, **changes), clock or SystemClock()), key
            self._device.open()
            self._device.configure()
        return self._device

    def close(self):
        if self._device is not None:
            self._device.close()
        self._device = None


@contextmanager
def window_subject(channels):
    """A subject of the conformance suite: a window of ``channels``, and the grey values of its lit channels."""
    require_display()
    with XServer(131, 97) as server:
        device = WindowProjector(settings_for(server, channels=channels), SystemClock())

        def read_surface():
            surface = server.surface()
            lit = np.array([channels in ("grey", name) for name in ("red", "green", "blue")])
            grey = surface[..., lit.argmax()]
            assert np.array_equal(surface, grey[..., None] * lit.astype(np.uint8)), "light in another channel"
            return grey

        try:
            yield device, read_surface
        finally:
            device.close()
