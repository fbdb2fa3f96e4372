"""What else happens on a desktop: another X program that closes, moves, hides and covers the projector's window."""

import ctypes
from ctypes import POINTER, byref, c_int, c_uint, c_ulong

from pyglet.libs.x11 import xlib


@xlib.XErrorHandler
def _ignore(display, event):
    return 0


class _SaverInfo(ctypes.Structure):
    _fields_ = (
        ("window", xlib.Window),
        ("state", c_int),
        ("kind", c_int),
        ("since_ms", c_ulong),
        ("idle_ms", c_ulong),
        ("events", c_ulong),
    )


class Desktop:
    """A program of its own on the X server ``display``; the methods act on the window whose title begins so."""

    def __init__(self, display, title="projector"):
        xlib.XSetErrorHandler(_ignore)
        self._display = xlib.XOpenDisplay(display.encode())
        assert self._display
        self._root = xlib.XDefaultRootWindow(self._display)
        self._title = title

    def __enter__(self):
        return self

    def __exit__(self, *_):
        xlib.XCloseDisplay(self._display)

    def window(self):
        """The X number of the window, None where there is none."""
        return self._find(self._root)

    def _find(self, parent):
        root, above, children, count = xlib.Window(), xlib.Window(), POINTER(xlib.Window)(), c_uint()
        xlib.XQueryTree(self._display, parent, byref(root), byref(above), byref(children), byref(count))
        for child in [children[number] for number in range(count.value)]:
            name = ctypes.c_char_p()
            if xlib.XFetchName(self._display, child, byref(name)) and name.value.startswith(self._title.encode()):
                return child
            if found := self._find(child):
                return found
        return None

    def ask_to_close(self):
        event = xlib.XEvent()
        event.xclient.type = xlib.ClientMessage
        event.xclient.window = window = self.window()
        event.xclient.message_type = self._atom("WM_PROTOCOLS")
        event.xclient.format = 32
        event.xclient.data.l[0] = self._atom("WM_DELETE_WINDOW")
        xlib.XSendEvent(self._display, window, 0, 0, byref(event))
        self._done()

    def destroy(self):
        xlib.XDestroyWindow(self._display, self.window())
        self._done()

    def kill(self):
        xlib.XKillClient(self._display, self.window())
        self._done()

    def hide(self):
        xlib.XUnmapWindow(self._display, self.window())
        self._done()

    def minimise(self):
        xlib.XIconifyWindow(self._display, self.window(), 0)
        self._done()

    def press(self, key):
        """Press and release a key in the window; ``key`` is its X name, such as ``q`` and ``space``."""
        event = xlib.XEvent()
        pressed = event.xkey
        pressed.display, pressed.window, pressed.root = self._display, self.window(), self._root
        pressed.time, pressed.same_screen = xlib.CurrentTime, True
        pressed.keycode = xlib.XKeysymToKeycode(self._display, xlib.XStringToKeysym(key.encode()))
        for pressed.type, mask in ((xlib.KeyPress, xlib.KeyPressMask), (xlib.KeyRelease, xlib.KeyReleaseMask)):
            xlib.XSendEvent(self._display, pressed.window, True, mask, byref(event))
        self._done()

    def move(self, x, y):
        xlib.XMoveWindow(self._display, self.window(), x, y)
        self._done()

    def resize(self, width, height):
        xlib.XResizeWindow(self._display, self.window(), width, height)
        self._done()

    def cover(self, x, y, width, height, title="mail has come"):
        """Put a window above all, as notifications do; returns its X number."""
        window = xlib.XCreateSimpleWindow(self._display, self._root, x, y, width, height, 0, 0, 0xFFFFFF)
        attributes = xlib.XSetWindowAttributes()
        attributes.override_redirect = 1
        xlib.XChangeWindowAttributes(self._display, window, xlib.CWOverrideRedirect, byref(attributes))
        xlib.XStoreName(self._display, window, title.encode())
        xlib.XMapRaised(self._display, window)
        self._done()
        return window

    def uncover(self, window):
        xlib.XDestroyWindow(self._display, window)
        self._done()

    def is_managed(self):
        """Whether window managers look after the window."""
        attributes = xlib.XWindowAttributes()
        assert xlib.XGetWindowAttributes(self._display, self.window(), byref(attributes))
        return not attributes.override_redirect

    def screen_saver_is_on(self):
        query = ctypes.CDLL("libXss.so.1").XScreenSaverQueryInfo
        query.argtypes = [POINTER(xlib.Display), xlib.Window, POINTER(_SaverInfo)]
        info = _SaverInfo()
        assert query(self._display, self._root, byref(info))
        return info.state == 1

    def _atom(self, name):
        return xlib.XInternAtom(self._display, name.encode(), 0)

    def _done(self):
        xlib.XSync(self._display, 0)
