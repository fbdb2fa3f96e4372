"""Which screens there are, and the one that is asked for."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.errors import DeviceNotFoundError, DeviceSettingError, HardwareError, MissingLibraryError


@dataclass(frozen=True)
class Screen:
    """One monitor or projector of an X display.

    Parameters
    ----------
    index
        Its number in the list, from 0.
    name
        That of its output, such as ``HDMI-1``.
    x_px, y_px
        Its upper left corner on the desktop.
    width_px, height_px
        Its size on the desktop.
    refresh_hz
        Rate of its mode; None where it does not say, as of a virtual one.
    primary
        True for the one that window managers prefer.
    scaled
        True where the desktop is stretched to the mode of the screen, so that no pixel can be shown exactly.
    gamma_linear
        False where the graphics card bends grey values on their way to this screen (colour profile, night light).
    """

    index: int
    name: str
    x_px: int
    y_px: int
    width_px: int
    height_px: int
    refresh_hz: float | None
    primary: bool = False
    scaled: bool = False
    gamma_linear: bool = True

    @property
    def area(self) -> tuple[int, int, int, int]:
        """(x, y, width, height) on the desktop, px."""
        return self.x_px, self.y_px, self.width_px, self.height_px

    def __str__(self) -> str:
        rate = "rate unknown" if self.refresh_hz is None else f"{self.refresh_hz:.2f} Hz"
        primary = ", primary" if self.primary else ""
        return (
            f"{self.index}: {self.name} {self.width_px} × {self.height_px} px at ({self.x_px}, {self.y_px}), "
            f"{rate}{primary}"
        )


def list_screens(display: str | None = None) -> tuple[list[Screen], str]:
    """Look which screens there are; never raises.

    Parameters
    ----------
    display
        X display; None takes the one in DISPLAY.

    Returns
    -------
    screens
        In the order of their index; empty where there are none.
    reason
        Why there are none, with what to do about it; empty otherwise.
    """
    try:
        return find_screens(display), ""
    except HardwareError as error:
        return [], str(error)


def find_screens(display: str | None = None) -> list[Screen]:
    """Ask the X server for its screens.

    Raises
    ------
    MissingLibraryError
        pyglet or a library of X is not there.
    DeviceNotFoundError
        The display cannot be opened.
    """
    with x11_libraries():
        from drivers.window.x11 import XConnection
    connection = XConnection(display)
    try:
        return connection.screens()
    finally:
        connection.close()


@contextmanager
def x11_libraries() -> Iterator[None]:
    """Turn an import that fails inside the block into `MissingLibraryError`; refuse what is not X11 on Linux."""
    if not sys.platform.startswith("linux"):
        raise MissingLibraryError(
            f"the projector window is made for X11 on Linux; this is {sys.platform}",
            "Drive the projector from a Linux machine.",
        )
    try:
        yield
    except ImportError as error:
        raise MissingLibraryError(
            f"the projector window cannot be used: {error}",
            "pip install 'pyglet>=2.1.15,<3'; apt install libx11-6 libxext6 libxrandr2 libxss1 libgl1 libglx-mesa0 "
            "libgl1-mesa-dri",
        ) from None


def choose_screen(screens: Sequence[Screen], wanted: int | str | None, size: tuple[int, int]) -> Screen:
    """Pick the screen that the settings mean.

    Parameters
    ----------
    screens
        What is there.
    wanted
        Index, name, or None for the only one of the right size.
    size
        (width, height) it must have, px.

    Raises
    ------
    DeviceNotFoundError
        None, or more than one, is meant; the message lists what is there.
    DeviceSettingError
        The screen is in another mode, or stretches or bends what it is given.
    """
    width, height = size
    if wanted is None:
        found = [s for s in screens if (s.width_px, s.height_px) == size]
        meant = f"of {width} × {height} px"
    elif isinstance(wanted, int):
        found = [s for s in screens if s.index == wanted]
        meant = f"number {wanted}"
    else:
        found = [s for s in screens if s.name == wanted]
        meant = f"named {wanted}"
    if len(found) != 1:
        there = "; ".join(map(str, screens)) or "none"
        count = "is no screen" if not found else f"are {len(found)} screens"
        raise DeviceNotFoundError(
            f"projector window: there {count} {meant}; known are: {there}",
            "Switch the projector on, extend the desktop to it (do not mirror), and name it with screen:.",
        )
    screen = found[0]
    if (screen.width_px, screen.height_px) != size:
        raise DeviceSettingError(
            f"projector window: screen {screen.name} shows {screen.width_px} × {screen.height_px} px, not the "
            f"projector's own {width} × {height}",
            f"Set the mode: xrandr --output {screen.name} --mode {width}x{height} --scale 1; or correct width_px, "
            "height_px.",
        )
    if screen.scaled:
        raise DeviceSettingError(
            f"projector window: the desktop is scaled on screen {screen.name}, so that pixels are not shown 1:1",
            f"Switch scaling off: xrandr --output {screen.name} --scale 1.",
        )
    if not screen.gamma_linear:
        raise DeviceSettingError(
            f"projector window: the graphics card bends grey values on screen {screen.name} (colour profile or night "
            "light)",
            f"Remove its colour profile, switch night light off, then: xrandr --output {screen.name} --gamma 1:1:1.",
        )
    return screen
