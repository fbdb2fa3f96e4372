"""What a camera with its own exposure, gain and pixel depth sees of a surface."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat
from sim_backend.surface import Picture

Shown = list[tuple[float, Picture]]
"""Shares of an exposure and the pictures (height, width) that were on the surface meanwhile."""

Grey = NDArray[np.uint8] | NDArray[np.uint16]
"""A frame (height, width)."""


class Light(Protocol):
    """From what is shown to a frame."""

    def expect(self, picture: Picture) -> None:
        """``picture`` (height, width) will be on the surface soon."""
        ...

    def frame(self, shown: Shown, exposure_s: float, gain: float, black_dn: float, frame_format: FrameFormat) -> Grey:
        """Frame (height, width) of one exposure.

        Parameters
        ----------
        shown
            What was on the surface.
        exposure_s
            For how long, s.
        gain
            A factor; 1 is the camera's own.
        black_dn
            Grey value of the frame without light.
        frame_format
            What the frame looks like.
        """
        ...

    def close(self) -> None:
        """Let go of what computes."""
        ...


class DirectLight:
    """Every camera pixel sees one projector pixel, without noise: pictures that cost nothing, to measure speed with."""

    def expect(self, picture: Picture) -> None:
        """Nothing to prepare."""

    def frame(self, shown: Shown, exposure_s: float, gain: float, black_dn: float, frame_format: FrameFormat) -> Grey:
        """Frame (height, width): the pictures in their shares, drawn to the frame's size, whatever the exposure."""
        if len(shown) == 1:
            mixed = shown[0][1]
        else:
            mixed = np.rint(sum(np.float32(share) * picture for share, picture in shown)).astype(np.uint8)
        drawn = cv2.resize(mixed, (frame_format.width, frame_format.height), interpolation=cv2.INTER_NEAREST)
        if frame_format.bits <= 8:
            return np.asarray(drawn, np.uint8)
        return np.asarray(drawn, np.uint16) << np.uint16(frame_format.bits - 8)

    def close(self) -> None:
        """Nothing to let go of."""
