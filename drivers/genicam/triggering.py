"""Which of the frames that a camera delivers was asked for, for each way of triggering it."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from drivers.errors import DeviceSettingError


class Gate(Protocol):
    """Counts requests and arrivals."""

    misses_matter: bool
    """Whether a frame that is missing may be one that was asked for; else the next good one will do."""

    def request(self) -> None:
        """Ask for a frame."""
        ...

    def fire(self) -> bool:
        """Whether the camera's software trigger is to be executed now; True at most once per request."""
        ...

    @property
    def open(self) -> bool:
        """Whether the next frame to arrive was asked for."""
        ...

    def arrive(self) -> bool:
        """Count an arriving frame; returns what `open` was."""
        ...


class SoftwareGate:
    """One frame per software trigger, which is not executed before the frame of the one before has arrived.

    Most cameras ignore a trigger while they expose, and tell nobody.
    """

    misses_matter = True

    def __init__(self) -> None:
        self._waiting = 0
        self._exposing = False

    def request(self) -> None:
        """Ask for a frame."""
        self._waiting += 1

    def fire(self) -> bool:
        """Whether to execute the trigger now."""
        if self._exposing or not self._waiting:
            return False
        self._waiting -= 1
        self._exposing = True
        return True

    @property
    def open(self) -> bool:
        """Whether a frame is due."""
        return self._exposing

    def arrive(self) -> bool:
        """Count an arriving frame."""
        due, self._exposing = self._exposing, False
        return due


class LineGate:
    """Every frame was asked for, by an edge on the camera's input.

    Parameters
    ----------
    device
        The name that errors mention.
    """

    misses_matter = True
    open = True

    def __init__(self, device: str) -> None:
        self._device = device

    def request(self) -> None:
        """Refused: only the edge exposes a frame."""
        raise DeviceSettingError(
            f"{self._device} is triggered by an edge on its input and takes no trigger by software",
            "Name a trigger box in the bench file, or set the camera to `trigger: software`.",
        )

    def fire(self) -> bool:
        """Never by software."""
        return False

    def arrive(self) -> bool:
        """Count an arriving frame."""
        return True


class FreeRunGate:
    """Of frames that come all the time, the first that surely began after the request.

    Parameters
    ----------
    skip_frames
        How many frames may be in exposure or on their way at any time.
    """

    misses_matter = False

    def __init__(self, skip_frames: int) -> None:
        self._skip = skip_frames
        self._arrived = 0
        self._from: deque[int] = deque()

    def request(self) -> None:
        """Ask for a frame."""
        self._from.append(self._arrived + self._skip)

    def fire(self) -> bool:
        """Never: such a camera has no trigger."""
        return False

    @property
    def open(self) -> bool:
        """Whether the next frame is late enough."""
        return bool(self._from) and self._arrived >= self._from[0]

    def arrive(self) -> bool:
        """Count an arriving frame."""
        wanted = self.open
        self._arrived += 1
        if wanted:
            self._from.popleft()
        return wanted
