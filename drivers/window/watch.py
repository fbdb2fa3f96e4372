"""Looking after a window while the scan looks elsewhere."""

from __future__ import annotations

from drivers.window.disturbance import CLOSED, Disturbance
from drivers.window.screens import Screen
from drivers.window.x11 import XConnection


class WindowWatch:
    """Looks after one window on one screen.

    Parameters
    ----------
    connection
        To the X server; events on it belong to this object.
    window
        The X number of the window.
    screen
        Where it has to be.
    """

    def __init__(self, connection: XConnection, window: int, screen: Screen) -> None:
        self._connection = connection
        self._window = window
        self._screen = screen
        connection.watch(window)

    def look(self) -> Disturbance | None:
        """Say what is wrong now; takes microseconds while nothing has changed on the desktop."""
        any_came, obscured = self._connection.drain(self._window)
        if not any_came:
            return None
        return self.examine() or (_covered("a window that has gone again") if obscured else None)

    def forget(self) -> None:
        """Let what has happened up to now, and is over, not count."""
        self._connection.synchronise()
        self._connection.drain(self._window)

    def look_thoroughly(self) -> Disturbance | None:
        """Say what is wrong now, or was since the last look, even where no event tells it."""
        self._connection.synchronise()
        return self.look() or self.examine()

    def examine(self) -> Disturbance | None:
        """Ask the X server whether the window fills its screen and nothing lies above it."""
        screen, connection = self._screen, self._connection
        now = next((s for s in connection.screens() if s.name == screen.name), None)
        if now is None:
            return Disturbance(
                f"screen {screen.name} is not there any more",
                "Check the projector's power and video cable, then start the scan again.",
            )
        if now.area != screen.area or now.scaled:
            scaled = ", scaled" if now.scaled else ""
            return Disturbance(
                f"screen {screen.name} has changed to {now.width_px} × {now.height_px} px at ({now.x_px}, {now.y_px})"
                f"{scaled}",
                "Set the projector's mode again and leave the displays' settings alone during a scan.",
            )
        if not now.gamma_linear:
            return Disturbance(
                f"the graphics card began to bend grey values on screen {screen.name}",
                "Switch night light and colour profiles off for the projector, then start the scan again.",
            )
        viewable = connection.viewable(self._window)
        if viewable is None:
            return CLOSED
        if not viewable:
            return Disturbance(
                "it was minimised or hidden",
                "Leave the projector's window alone; keep the desktop on the workspace it was opened on.",
            )
        area = connection.area(self._window)
        if area != screen.area:
            x, y, width, height = area
            return Disturbance(
                f"it does not fill its screen any more, it has {width} × {height} px at ({x}, {y})",
                "Leave the projector's window alone; start the scan again.",
            )
        if above := connection.above(self._window, area):
            return _covered(", ".join(above))
        return None


def _covered(what: str) -> Disturbance:
    return Disturbance(
        f"it was covered by: {what}",
        "Move other windows off the projector's screen and switch notifications off; repeat the sequence.",
        lost=False,
    )
