"""What can happen to a projector's window, and what the operator reads of it."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.errors import DeviceLostError, HardwareError, SequenceFaultError


class WindowLostError(DeviceLostError):
    """The window or its screen is not what it was when it was opened."""


@dataclass(frozen=True)
class Disturbance:
    """Something that keeps the right picture off the surface.

    Parameters
    ----------
    text
        What it is.
    remedy
        What the operator can do about it.
    lost
        True where the window has to be opened anew, False where the sequence can simply be repeated.
    """

    text: str
    remedy: str
    lost: bool = True

    def error(self) -> HardwareError:
        """As an error to be raised."""
        kind = WindowLostError if self.lost else SequenceFaultError
        return kind(f"projector window: {self.text}", self.remedy)


CLOSED = Disturbance("it was closed", "Leave the projector's window open during a scan; start the scan again.")
SERVER_GONE = Disturbance(
    "the X server has ended or dropped the connection", "Log in again and see the X server's log; start the scan again."
)
