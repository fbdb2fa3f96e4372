"""Frames in memory that two processes share."""

from __future__ import annotations

import contextlib
import math
import os
import sys
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np

from drivers.devices import FrameFormat, Pixels
from drivers.errors import DeviceSettingError

_PAGE = 4096
_SHARED = "/dev/shm"


class FrameRing:
    """A number of frames in shared memory, all of one format and all of it really there before it is used.

    Who may touch which slot is the users' agreement. The memory has a name only until both sides have it, so nothing
    can be left behind, however the processes end.

    Parameters
    ----------
    frame_format
        Of the frames.
    slots
        How many.
    name
        Of the memory, to share what another process has made; None makes it.

    Raises
    ------
    DeviceSettingError
        There is not as much shared memory.
    """

    def __init__(self, frame_format: FrameFormat, slots: int, name: str | None = None) -> None:
        self.frame_format = frame_format
        self.slots = slots
        size = math.prod(frame_format.shape) * frame_format.dtype.itemsize
        stride = -(-size // _PAGE) * _PAGE
        if name is None:
            _check_room(stride * slots)
        self._memory = SharedMemory(name, create=name is None, size=stride * slots)
        self._frames: list[Any] = [
            np.ndarray(frame_format.shape, frame_format.dtype, self._memory.buf, slot * stride) for slot in range(slots)
        ]
        # The first touch of a page costs more than copying it.
        pages = np.ndarray(stride * slots, np.uint8, self._memory.buf)[::_PAGE]
        if name is None:
            pages.sum()
        else:
            pages[...] = 0

    @property
    def name(self) -> str:
        """What the other process needs to share the memory."""
        return self._memory.name

    def __getitem__(self, slot: int) -> Pixels:
        return self._frames[slot]  # type: ignore[no-any-return]

    def forget_name(self) -> None:
        """Call where it was made, once both sides have it; from here on it goes with the last of them."""
        with contextlib.suppress(FileNotFoundError):
            self._memory.unlink()

    def close(self) -> None:
        """Let go of the memory; no frame may be in use."""
        self._frames.clear()
        self._memory.close()


def _check_room(size: int) -> None:
    # Memory that is promised and not there ends the process at its first touch (SIGBUS).
    if not sys.platform.startswith("linux"):
        return
    state = os.statvfs(_SHARED)
    free = state.f_bavail * state.f_frsize
    if size > free:
        raise DeviceSettingError(
            f"the ring of frames needs {size / 1e6:.0f} MB of shared memory, {_SHARED} has {free / 1e6:.0f} MB free",
            f"Set `ring_frames` lower, or give {_SHARED} more (mount -o remount,size=4G {_SHARED}; in a container "
            "--shm-size=4g).",
        )
