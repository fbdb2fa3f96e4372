"""Uniform pictures from black to white: taking them with a bench, and keeping what is needed of the frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import Bench, OperatorError, Pixels
from scanner.preview.measures import dark_below_dn

RAMP_LEVELS: tuple[int, ...] = (*range(0, 256, 8), 255)
"""33 grey levels, black and white among them."""

_PIXELS = 60_000
_FEWEST = 500
_STRONG = 0.25
_UNCLIPPED = 0.97


class PhotometryError(OperatorError):
    """The frames do not show what photometry needs."""


@dataclass(frozen=True, eq=False)
class Ramp:
    """Grey values of well lit, unsaturated pixels under uniform pictures.

    Parameters
    ----------
    levels
        (K,) grey levels that were projected, in the order of time; black and white come several times.
    values
        (K, P) float32, DN, of the pixels that were kept, in picture order.
    saturated_dn
        Grey value from which a pixel says nothing.
    clipped_share
        Share of the lit pixels that white saturates; they were left out.
    """

    levels: NDArray[np.int64]
    values: NDArray[np.float32]
    saturated_dn: int
    clipped_share: float

    @classmethod
    def of_frames(cls, levels: Sequence[int], frames: Sequence[Pixels], saturated_dn: int) -> Ramp:
        """Keep what is needed of frames that are all there.

        Parameters
        ----------
        levels
            Grey level of each frame, in the order of time; 0 and 255 among them.
        frames
            K frames, (H, W) each.
        saturated_dn
            Grey value of a saturated pixel.

        Raises
        ------
        PhotometryError
            Hardly a pixel is lit and unsaturated.
        ValueError
            No black or no white frame, or not as many levels as frames.
        """
        if len(levels) != len(frames) or not {0, 255} <= set(levels):
            raise ValueError("a ramp needs a level for every frame, and both black (0) and white (255)")
        chosen, clipped = _usable(frames[levels.index(0)], frames[levels.index(255)], saturated_dn)
        values = np.stack([frame.reshape(-1)[chosen] for frame in frames]).astype(np.float32)
        return cls(np.asarray(levels, np.int64), values, saturated_dn, clipped)


def take_ramp(
    bench: Bench,
    levels: Sequence[int] = RAMP_LEVELS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Ramp:
    """Project uniform pictures and photograph them.

    Every second level on the way up and the others on the way down, between black and white at both ends and in the
    middle: a lamp that drifts shows, and cannot pass for a response.

    Parameters
    ----------
    bench
        Open; the caller darkens and closes it.
    levels
        Grey levels, 0 and 255 among them.
    progress
        Called with (frames taken, frames in all).

    Raises
    ------
    PhotometryError
        Hardly a pixel is lit and unsaturated.
    HardwareError
        A device failed.
    """
    between = sorted(set(levels) - {0, 255})
    order = [0, 255, *between[::2], 255, 0, *between[1::2][::-1], 0, 255]
    width, height = bench.projector_size
    fmt = bench.frame_format
    bench.prepare([np.full((height, width), level, np.uint8) for level in order])
    black, frame = np.empty(fmt.shape, fmt.dtype), np.empty(fmt.shape, fmt.dtype)
    bench.expose(0, black)
    bench.expose(1, frame)
    chosen, clipped = _usable(black, frame, fmt.saturated_dn)
    values = np.empty((len(order), chosen.size), np.float32)
    values[0], values[1] = black.reshape(-1)[chosen], frame.reshape(-1)[chosen]
    for index in range(2, len(order)):
        bench.expose(index, frame)
        values[index] = frame.reshape(-1)[chosen]
        progress(index + 1, len(order))
    return Ramp(np.array(order, np.int64), values, fmt.saturated_dn, clipped)


def _usable(black: Pixels, white: Pixels, saturated_dn: int) -> tuple[NDArray[np.intp], float]:
    """Numbers of pixels that the projector lights well and white does not saturate, and the share that it does."""
    rise: NDArray[Any] = white.astype(np.float32) - black
    strongest = float(np.quantile(rise, 0.99))
    if strongest < 2 * dark_below_dn(saturated_dn):
        raise PhotometryError(
            f"the camera sees little difference between black and white: 99 % of its pixels rise by less than "
            f"{strongest:.1f} of {saturated_dn} grey levels",
            "Point projector and camera at the same white surface, take the lens caps off, lengthen the exposure.",
        )
    lit = rise > _STRONG * strongest
    clear = lit & (white < _UNCLIPPED * saturated_dn)
    clipped = 1 - float(np.count_nonzero(clear)) / float(np.count_nonzero(lit))
    chosen = np.flatnonzero(clear)
    if chosen.size < _FEWEST:
        raise PhotometryError(
            f"{chosen.size} pixels are well lit and below {100 * _UNCLIPPED:.0f} % of full scale under white, "
            f"{100 * clipped:.0f} % of the lit ones are above it",
            "Shorten the exposure, close the aperture, or put a larger plain white board into the picture.",
        )
    # Evenly over the picture, so that neighbours in the list still are in one part of it.
    return chosen[:: max(1, chosen.size // _PIXELS)], clipped
