"""Whether frames followed one another without a gap."""

from __future__ import annotations

_SHORT_COUNTER = 0xFFFF
"""GigE Vision 1.x counts frames with 16 bits and leaves out 0."""


class Continuity:
    """Looks at the numbers and time stamps of the frames of one run, in the order in which they arrive.

    The first frame of a run cannot be judged: cameras begin to count from 0, from 1, or where they left off.
    """

    def __init__(self) -> None:
        self._last_id: int | None = None
        self._last_ns: int | None = None
        self._excused = 0

    @property
    def last(self) -> str:
        """Where in the run one is, in words."""
        return "before the first frame" if self._last_id is None else f"after frame {self._last_id}"

    def excuse(self) -> None:
        """A frame arrived that was reported incomplete; its number is missing for a known reason."""
        self._excused += 1

    def judge(self, frame_id: int | None, t_ns: int | None) -> tuple[int, str | None]:
        """Compare a frame with the one before.

        Parameters
        ----------
        frame_id
            The camera's number of it; None where it gives none.
        t_ns
            The camera's time stamp, ns; None where it gives none.

        Returns
        -------
        lost
            How many frames are missing before it.
        fault
            What is wrong, None where nothing is.
        """
        last_id, last_ns, excused = self._last_id, self._last_ns, self._excused
        self._last_id, self._last_ns, self._excused = frame_id, t_ns, 0
        if frame_id is not None and last_id is not None:
            step = self._step(last_id, frame_id)
            if step == 0:
                return 0, f"frame {frame_id} came twice"
            if step < 0:
                return 0, f"frame {frame_id} came after frame {last_id}"
            if step - 1 > excused:
                lost = step - 1 - excused
                gap = f"frame {last_id + 1}" if step == 2 else f"frames {last_id + 1} to {frame_id - 1}"
                known = f", {excused} of them incomplete" if excused else ""
                return lost, f"{gap} did not arrive ({step - 1} missing{known})"
        if t_ns is not None and last_ns is not None and t_ns <= last_ns:
            return 0, f"frame {frame_id} has a time stamp that is not after that of the frame before it"
        return 0, None

    @staticmethod
    def _step(last: int, now: int) -> int:
        if last > now and last <= _SHORT_COUNTER and last - now > _SHORT_COUNTER // 2:
            return now + _SHORT_COUNTER - last + (now == 0)
        return now - last
