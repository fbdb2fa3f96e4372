"""What is seen in live pictures: looks that take longer than a picture may wait, at the newest one each."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Self, TypeVar

import cv2
import numpy as np

from calibration.boards import Board, Charuco
from calibration.detection.searching import search, stretched
from calibration.observations import BoardView
from drivers import Pixels

T = TypeVar("T")

_LIVE_PX, _LIVE_MARKERS_PX = 640, 1280
"""Largest picture that is searched live; markers have to be read, and need more."""


def glimpsed(frame: Pixels, board: Board) -> BoardView | None:
    """A board's points in a live picture, to a pixel or two; None where it is not seen.

    Parameters
    ----------
    frame
        (H, W).
    board
        What to look for.
    """
    largest = _LIVE_MARKERS_PX if isinstance(board, Charuco) else _LIVE_PX
    factor = max(1, -(-max(frame.shape) // largest))
    height, width = (extent // factor for extent in frame.shape)
    whole = stretched(frame)[: height * factor, : width * factor]
    found = search(np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8), board)
    if found is None:
        return None
    ids, xy = found
    return BoardView(ids, xy * factor + (factor - 1) / 2, np.full(len(ids), float(factor)))


class Looking(Generic[T]):
    """Looks at pictures in a thread of its own, so that the live picture stays fluent; a context manager.

    Parameters
    ----------
    look
        What is done with a picture; it gets a copy.
    """

    def __init__(self, look: Callable[[Pixels], T]) -> None:
        self._look = look
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="looking")
        self._job: Future[T] | None = None
        self._seen: T | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._worker.shutdown(cancel_futures=True)

    def at(self, frame: Pixels) -> T | None:
        """What was seen last, None at first; looks at ``frame`` unless a former picture is still looked at."""
        if self._job is not None and self._job.done():
            self._seen, self._job = self._job.result(), None
        if self._job is None:
            self._job = self._worker.submit(self._look, frame.copy())
        return self._seen
