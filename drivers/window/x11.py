"""The questions that the projector window puts to the X server: screens, where a window is, what lies above it."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import POINTER, byref, c_int, c_uint, c_ulong, c_ushort
from typing import Any

from pyglet.libs.x11 import xlib, xrandr

from drivers.errors import DeviceNotFoundError
from drivers.window.screens import Screen

Area = tuple[int, int, int, int]
"""(x, y, width, height), px on the desktop."""

_RANDR_CHANGES = 0b111  # screen, CRTC and output
_INTERLACED, _DOUBLE_SCAN = 1 << 4, 1 << 5
_SIDEWAYS = 0b1010  # rotated by 90° or 270°
_INPUT_OUTPUT = 1


class _MonitorInfo(ctypes.Structure):
    _fields_ = (
        ("name", xlib.Atom),
        ("primary", c_int),
        ("automatic", c_int),
        ("noutput", c_int),
        ("x", c_int),
        ("y", c_int),
        ("width", c_int),
        ("height", c_int),
        ("mwidth", c_int),
        ("mheight", c_int),
        ("outputs", POINTER(xrandr.RROutput)),
    )


class _Gamma(ctypes.Structure):
    _fields_ = (("size", c_int), ("red", POINTER(c_ushort)), ("green", POINTER(c_ushort)), ("blue", POINTER(c_ushort)))


def _function(name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(xrandr.lib, name)
    function.restype, function.argtypes = result, list(arguments)
    return function


# RandR 1.5; pyglet binds what it needs of 1.3 only.
_Display = POINTER(xlib.Display)
_get_monitors = _function("XRRGetMonitors", POINTER(_MonitorInfo), _Display, xlib.Window, c_int, POINTER(c_int))
_free_monitors = _function("XRRFreeMonitors", None, POINTER(_MonitorInfo))
_select_changes = _function("XRRSelectInput", None, _Display, xlib.Window, c_int)
_get_gamma = _function("XRRGetCrtcGamma", POINTER(_Gamma), _Display, xrandr.RRCrtc)
_gamma_size = _function("XRRGetCrtcGammaSize", c_int, _Display, xrandr.RRCrtc)
_free_gamma = _function("XRRFreeGamma", None, POINTER(_Gamma))


class XConnection:
    """One connection to an X server, and the X screen that its name means.

    Parameters
    ----------
    display
        Such as ``:0`` or ``:0.1``; None takes DISPLAY.

    Raises
    ------
    DeviceNotFoundError
        The server cannot be reached, or is too old to tell its monitors.

    Notes
    -----
    Xlib ends a process that asks for a window that is not there any more, unless it has a handler for errors;
    importing ``pyglet.display`` sets one.
    """

    def __init__(self, display: str | None) -> None:
        name = display if display is not None else os.environ.get("DISPLAY", "")
        self._display = xlib.XOpenDisplay(name.encode()) if name else None
        if not self._display:
            what = f"the X display {name} cannot be opened" if name else "there is no X display (DISPLAY is not set)"
            raise DeviceNotFoundError(
                f"projector window: {what}",
                "Run in the operator's graphical session, or name the display that the projector is at with display:, "
                "such as display: ':0'.",
            )
        self.number = xlib.XDefaultScreen(self._display)
        """Number of the X screen."""
        self.root = xlib.XRootWindow(self._display, self.number)
        major, minor = c_int(), c_int()
        if not xrandr.XRRQueryVersion(self._display, byref(major), byref(minor)) or (major.value, minor.value) < (1, 5):
            self.close()
            raise DeviceNotFoundError(
                f"projector window: the X server {name} does not tell its monitors (RandR 1.5)",
                "Use X.Org 1.18 or newer.",
            )

    def close(self) -> None:
        """Disconnect; allowed any number of times."""
        display, self._display = self._display, None
        if display:
            xlib.XCloseDisplay(display)

    def screens(self) -> list[Screen]:
        """The monitors of the X screen, as window managers see them."""
        count = c_int()
        infos = _get_monitors(self._display, self.root, 1, byref(count))
        try:
            with self._resources() as resources:
                return [self._screen(index, infos[index], resources) for index in range(count.value)]
        finally:
            if infos:
                _free_monitors(infos)

    def _screen(self, index: int, info: _MonitorInfo, resources: Any) -> Screen:
        rate, scaled, linear = None, False, True
        if info.noutput:
            rate, scaled, linear = self._output(info.outputs[0], resources)
        return Screen(
            index=index,
            name=self._atom_name(info.name),
            x_px=info.x,
            y_px=info.y,
            width_px=info.width,
            height_px=info.height,
            refresh_hz=rate,
            primary=bool(info.primary),
            scaled=scaled,
            gamma_linear=linear,
        )

    @contextmanager
    def _resources(self) -> Iterator[Any]:
        # "Current": the other call lets the server look at all plugs anew, which takes a second and may blank screens.
        resources = xrandr.XRRGetScreenResourcesCurrent(self._display, self.root)
        try:
            yield resources
        finally:
            xrandr.XRRFreeScreenResources(resources)

    def _output(self, output: int, resources: Any) -> tuple[float | None, bool, bool]:
        """Rate (Hz), whether scaled, whether grey values arrive unbent."""
        info = xrandr.XRRGetOutputInfo(self._display, resources, output)
        crtc_id = info.contents.crtc
        xrandr.XRRFreeOutputInfo(info)
        if not crtc_id:
            return None, False, True
        crtc = xrandr.XRRGetCrtcInfo(self._display, resources, crtc_id)
        shown, mode_id = (crtc.contents.width, crtc.contents.height), crtc.contents.mode
        sideways = bool(crtc.contents.rotation & _SIDEWAYS)
        xrandr.XRRFreeCrtcInfo(crtc)
        modes = (resources.contents.modes[number] for number in range(resources.contents.nmode))
        mode = next((mode for mode in modes if mode.id == mode_id), None)
        if mode is None:
            return None, False, True
        size = (mode.height, mode.width) if sideways else (mode.width, mode.height)
        lines = mode.vTotal * (2 if mode.modeFlags & _DOUBLE_SCAN else 1) / (2 if mode.modeFlags & _INTERLACED else 1)
        rate = mode.dotClock / (mode.hTotal * lines) if mode.dotClock and mode.hTotal and lines else None
        return rate, shown != size, self._is_linear(crtc_id)

    def _is_linear(self, crtc: int) -> bool:
        if _gamma_size(self._display, crtc) < 2:
            return True
        ramps = _get_gamma(self._display, crtc)
        try:
            size = ramps.contents.size
            given = [list(ramp[:size]) for ramp in (ramps.contents.red, ramps.contents.green, ramps.contents.blue)]
        finally:
            _free_gamma(ramps)
        if not any(map(any, given)):
            return True  # never set, as in a virtual X server
        # One step of eight bits: some drivers leave the lower byte of a linear ramp empty.
        return all(abs(ramp[n] / 65535 - n / (size - 1)) < 1 / 255 for ramp in given for n in range(size))

    def watch(self, window: int) -> None:
        """Get an event whenever something happens to ``window``, to another one on the desktop, or to the screens."""
        xlib.XSelectInput(self._display, window, xlib.StructureNotifyMask | xlib.VisibilityChangeMask)
        xlib.XSelectInput(self._display, self.root, xlib.SubstructureNotifyMask)
        _select_changes(self._display, self.root, _RANDR_CHANGES)
        xlib.XSync(self._display, 0)

    def synchronise(self) -> None:
        """Wait until the server has done all it was asked for, and all events up to then have come."""
        xlib.XSync(self._display, 0)

    def drain(self, window: int) -> tuple[bool, bool]:
        """Forget the events that have come: whether there were any, and any that said ``window`` is obscured.

        Notes
        -----
        X servers tell the latter only where no compositor runs; what lies above then is known by `above`.
        """
        event, any_came, obscured = xlib.XEvent(), False, False
        while xlib.XPending(self._display):
            xlib.XNextEvent(self._display, byref(event))
            any_came = True
            if event.type == xlib.VisibilityNotify and event.xvisibility.window == window:
                obscured |= event.xvisibility.state != xlib.VisibilityUnobscured
        return any_came, obscured

    def viewable(self, window: int) -> bool | None:
        """Whether ``window`` and all it lies in are shown; None where it is not there any more."""
        attributes = xlib.XWindowAttributes()
        if not xlib.XGetWindowAttributes(self._display, window, byref(attributes)):
            return None
        return bool(attributes.map_state == xlib.IsViewable)

    def area(self, window: int) -> Area:
        """Where ``window`` is on the desktop."""
        root, x, y = xlib.Window(), c_int(), c_int()
        width, height, border, depth = c_uint(), c_uint(), c_uint(), c_uint()
        xlib.XGetGeometry(
            self._display,
            window,
            byref(root),
            byref(x),
            byref(y),
            byref(width),
            byref(height),
            byref(border),
            byref(depth),
        )
        xlib.XTranslateCoordinates(self._display, window, self.root, 0, 0, byref(x), byref(y), byref(root))
        return x.value, y.value, width.value, height.value

    def above(self, window: int, area: Area) -> list[str]:
        """Names of the windows that are shown above ``window`` within ``area``."""
        stack = self._children(self.root)
        own = window
        while own not in stack:
            own = self._parent(own)
            if not own:
                return []
        return [self._title(other) for other in stack[stack.index(own) + 1 :] if self._covers(other, area)]

    def _covers(self, window: int, area: Area) -> bool:
        attributes = xlib.XWindowAttributes()
        if not xlib.XGetWindowAttributes(self._display, window, byref(attributes)):
            return False
        if attributes.map_state != xlib.IsViewable or getattr(attributes, "class") != _INPUT_OUTPUT:
            return False
        x, y, width, height = area
        return bool(
            attributes.x < x + width
            and attributes.x + attributes.width > x
            and attributes.y < y + height
            and attributes.y + attributes.height > y
        )

    def _children(self, window: int) -> list[int]:
        return self._tree(window)[1]

    def _parent(self, window: int) -> int:
        return self._tree(window)[0]

    def _tree(self, window: int) -> tuple[int, list[int]]:
        root, parent, children, count = xlib.Window(), xlib.Window(), POINTER(xlib.Window)(), c_uint()
        if not xlib.XQueryTree(self._display, window, byref(root), byref(parent), byref(children), byref(count)):
            return 0, []
        found = [children[number] for number in range(count.value)]
        if children:
            xlib.XFree(children)
        return parent.value or 0, found

    def _title(self, window: int) -> str:
        # A window manager puts a frame without a name around the window that has one.
        for candidate in (window, *self._children(window)):
            text = ctypes.c_char_p()
            if xlib.XFetchName(self._display, candidate, byref(text)) and text.value:
                title = text.value.decode(errors="replace")
                xlib.XFree(text)
                return title
        return f"window 0x{window:x}"

    def _atom_name(self, atom: int) -> str:
        name: bytes = xlib.XGetAtomName(self._display, atom)
        return name.decode(errors="replace")

    def _atom(self, name: str) -> int:
        return int(xlib.XInternAtom(self._display, name.encode(), 0))

    @property
    def has_compositor(self) -> bool:
        """True where a program puts the picture of the desktop together from those of the windows."""
        return bool(xlib.XGetSelectionOwner(self._display, self._atom(f"_NET_WM_CM_S{self.number}")))

    @property
    def is_xwayland(self) -> bool:
        """True where the X server is itself a window system's client, without a screen of its own."""
        code, event, error = c_int(), c_int(), c_int()
        return bool(xlib.XQueryExtension(self._display, b"XWAYLAND", byref(code), byref(event), byref(error)))

    def set_property(self, window: int, name: str, value: int) -> None:
        """Set a property of ``window`` to a number."""
        data = ctypes.cast(ctypes.pointer(c_ulong(value)), POINTER(ctypes.c_ubyte))
        cardinal = self._atom("CARDINAL")
        xlib.XChangeProperty(self._display, window, self._atom(name), cardinal, 32, xlib.PropModeReplace, data, 1)

    def ask_for_place(self, window: int, area: Area) -> None:
        """Tell the window manager that the operator wants ``window``, which is not shown yet, at ``area``."""
        hints = xlib.XSizeHints()
        hints.flags = xlib.USPosition | xlib.USSize
        hints.x, hints.y, hints.width, hints.height = area
        xlib.XSetWMNormalHints(self._display, window, byref(hints))
        xlib.XMoveResizeWindow(self._display, window, *area)
        xlib.XSync(self._display, 0)

    def ask_for_full_screen(self, window: int) -> None:
        """Ask the window manager to let ``window``, which is shown, fill the monitor it is on."""
        add, from_application = 1, 1
        self._tell(window, "_NET_WM_STATE", add, self._atom("_NET_WM_STATE_FULLSCREEN"), 0, from_application)

    def ask_for_monitor(self, window: int, number: int) -> None:
        """Ask the window manager to let ``window``, a full screen, fill monitor ``number``."""
        edges, from_application = [number] * 4, 1
        self._tell(window, "_NET_WM_FULLSCREEN_MONITORS", *edges, from_application)

    def _tell(self, window: int, message: str, *values: int) -> None:
        event = xlib.XEvent()
        event.xclient.type = xlib.ClientMessage
        event.xclient.window = window
        event.xclient.message_type = self._atom(message)
        event.xclient.format = 32
        for number, value in enumerate(values):
            event.xclient.data.l[number] = value
        mask = xlib.SubstructureRedirectMask | xlib.SubstructureNotifyMask
        xlib.XSendEvent(self._display, self.root, 0, mask, byref(event))
        xlib.XSync(self._display, 0)

    def take_from_window_manager(self, window: int, area: Area) -> None:
        """Make ``window``, which is not shown yet, one that window managers leave alone, at ``area``."""
        attributes = xlib.XSetWindowAttributes()
        attributes.override_redirect = 1
        xlib.XChangeWindowAttributes(self._display, window, xlib.CWOverrideRedirect, byref(attributes))
        xlib.XMoveResizeWindow(self._display, window, *area)
        xlib.XSync(self._display, 0)

    def keep_awake(self) -> None:
        """Let the screen saver and the energy saving think that somebody has just pressed a key."""
        xlib.XResetScreenSaver(self._display)
        xlib.XFlush(self._display)

    def suspend_screen_saver(self) -> bool:
        """No screen saver and no energy saving as long as this connection lasts; False where that cannot be had."""
        try:
            library = ctypes.CDLL("libXss.so.1")
        except OSError:
            return False
        event, error = c_int(), c_int()
        library.XScreenSaverQueryExtension.argtypes = [_Display, POINTER(c_int), POINTER(c_int)]
        library.XScreenSaverSuspend.argtypes = [_Display, c_int]
        if not library.XScreenSaverQueryExtension(self._display, byref(event), byref(error)):
            return False
        library.XScreenSaverSuspend(self._display, 1)
        xlib.XSync(self._display, 0)
        return True
