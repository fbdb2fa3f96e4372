"""Getting a window to fill the one screen it is meant for, and knowing that it does."""

from __future__ import annotations

import time
from typing import Any

import pyglet
from pyglet import gl
from pyglet.display.xlib import NoSuchDisplayException, XlibDisplay, XlibScreen
from pyglet.window import NoSuchConfigException

from drivers.errors import DeviceNotFoundError, DeviceSettingError, MissingLibraryError
from drivers.window.screens import Screen
from drivers.window.x11 import XConnection

_TITLE = "projector"
_SETTLE_S = 2.0
_STEADY_S = 0.15
# pyglet says what these are at run time, by the platform.
_Config: Any = gl.Config
_Display: Any = XlibDisplay


def open_window(connection: XConnection, display: str | None, screen: Screen, *, fullscreen: bool, vsync: bool) -> Any:
    """Open a window that fills ``screen``.

    A window manager makes the full screen of the monitor that it believes the window to be on. So the window is laid
    over its screen first and made full then; where that comes up elsewhere, the protocol's own message about monitors
    is tried; where that does not help, or ``fullscreen`` is false, the window is taken away from the window manager.
    Where the window is, the X server is asked each time.

    Raises
    ------
    DeviceSettingError
        It does not get there.
    MissingLibraryError
        There is no OpenGL 3.3.
    """
    try:
        x_display = _Display(display, connection.number)
    except NoSuchDisplayException as error:
        raise DeviceNotFoundError(f"projector window: {error}", "Check display: in the bench file.") from None
    window = _create(XlibScreen(x_display, *screen.area))
    number = window._window
    connection.set_property(number, "_NET_WM_BYPASS_COMPOSITOR", 1)
    if fullscreen:
        connection.ask_for_place(number, screen.area)
        window.set_visible(True)
        connection.ask_for_full_screen(number)
        if _fills(connection, window, screen):
            return _with_vsync(window, vsync)
        connection.ask_for_monitor(number, screen.index)
        if _fills(connection, window, screen):
            return _with_vsync(window, vsync)
        window.set_visible(False)
        time.sleep(_STEADY_S)  # the window manager lets go of it meanwhile
    connection.take_from_window_manager(number, screen.area)
    window.set_visible(True)
    window.set_size(screen.width_px, screen.height_px)
    if _fills(connection, window, screen):
        return _with_vsync(window, vsync)
    x, y, width, height = connection.area(number)
    window.close()
    raise DeviceSettingError(
        f"projector window: it came up with {width} × {height} px at ({x}, {y}), not on screen {screen}",
        "Make the projector an extended desktop of its own (not mirrored), or give it an X screen of its own and name "
        "that with display:.",
    )


def _create(place: Any) -> Any:
    depth = {"red_size": 8, "green_size": 8, "blue_size": 8, "sample_buffers": 0, "samples": 0}
    wanted = _Config(double_buffer=True, major_version=3, minor_version=3, **depth)
    try:
        window: Any = pyglet.window.Window(
            width=place.width,
            height=place.height,
            style=pyglet.window.Window.WINDOW_STYLE_BORDERLESS,
            visible=False,
            screen=place,
            display=place.display,
            config=place.get_best_config(wanted),
            caption=_TITLE,
        )
    except NoSuchConfigException:
        raise _no_opengl("the X server offers no picture format of 8 bits per channel") from None
    except gl.ContextException as error:
        raise _no_opengl(str(error)) from None
    window.set_mouse_visible(False)
    return window


def _with_vsync(window: Any, vsync: bool) -> Any:
    # Some drivers forget what was asked for before the window was shown.
    window.set_vsync(vsync)
    return window


def _no_opengl(why: str) -> MissingLibraryError:
    return MissingLibraryError(
        f"projector window: OpenGL 3.3 cannot be had: {why}",
        "Install the graphics card's driver, or Mesa's: apt install libgl1 libglx-mesa0 libgl1-mesa-dri.",
    )


def _fills(connection: XConnection, window: Any, screen: Screen) -> bool:
    """Wait until the window has stayed on its screen for a while, or has had its time."""
    deadline = time.monotonic() + _SETTLE_S
    steady_since: float | None = None
    while (now := time.monotonic()) < deadline:
        window.dispatch_events()
        right = bool(connection.viewable(window._window)) and connection.area(window._window) == screen.area
        if not right:
            steady_since = None
        elif steady_since is None:
            steady_since = now
        elif now - steady_since >= _STEADY_S:
            return bool(window.get_framebuffer_size() == (screen.width_px, screen.height_px))
        time.sleep(0.01)
    return False
