"""Pictures that carry their number, and how a frame is read without knowing where camera and projector stand.

A picture is split into vertical stripes, each of which carries one bit of the picture's Gray code. Which camera pixels
see which bit is photographed first, one bit at a time. As light adds, any frame is black plus a share v of each of
these frames: v = 1 or 0 where the bit is on or off, and in between where the picture changed during the exposure. The
least-squares v holds for every scene, with bounces and all. Read in bands of the projector's rows, it also tells a
picture that is torn: new above, old below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.photometry.ramp import PhotometryError
from drivers import Pixels

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

BANDS = 8
"""Bands of rows that are read by themselves."""

_STRIPES_PER_BIT = 3
_BAND_BITS = 3
_FEWEST = 40
_CLEAR = 0.004


@dataclass(frozen=True)
class CodedSequence:
    """The pictures of a display check.

    Parameters
    ----------
    size
        Projector (width, height), px.
    bits
        Of a picture's number; 2^bits pictures are all different.
    """

    size: tuple[int, int]
    bits: int = 5

    @property
    def count(self) -> int:
        """How many pictures carry a number of their own."""
        return 1 << self.bits

    def picture(self, number: int) -> Picture:
        """(height, width) picture ``number``: neighbours differ in one bit (Gray code), all others in other bits."""
        code = number ^ (number >> 1)
        return self._columns(np.array([code >> bit & 1 for bit in range(self.bits)], bool))

    def references(self) -> list[Picture]:
        """What is photographed first: black, white, the bits of a band's number, and one bit of the code at a time."""
        width, height = self.size
        band = np.arange(height) * BANDS // height
        rows = [np.where(band[:, None] >> bit & 1, np.uint8(255), np.uint8(0)) for bit in range(_BAND_BITS)]
        singles = [self._columns(np.arange(self.bits) == bit) for bit in range(self.bits)]
        black, white = np.zeros((height, width), np.uint8), np.full((height, width), 255, np.uint8)
        return [black, white, *(np.repeat(row, width, axis=1) for row in rows), *singles]

    def _columns(self, lit: NDArray[np.bool_]) -> Picture:
        width, height = self.size
        stripe = np.arange(width) * (_STRIPES_PER_BIT * self.bits) // width
        row = np.where(lit[stripe % self.bits], np.uint8(255), np.uint8(0))
        return np.ascontiguousarray(np.broadcast_to(row, (height, width)))


@dataclass(frozen=True, eq=False)
class CodeReader:
    """Reads numbers off frames.

    Parameters
    ----------
    black
        (P,) frame under black at the pixels that are used, DN.
    singles
        (bits, P) rise above black with one bit on.
    band
        (P,) which band of the projector's rows a pixel sees.
    pixels
        (P,) numbers of the pixels.
    noise_dn
        Standard deviation of a grey value, from frames of the same picture.
    """

    black: Array
    singles: Array
    band: NDArray[np.intp]
    pixels: NDArray[np.intp]
    noise_dn: float

    @classmethod
    def of_references(cls, frames: list[Pixels], noise_dn: float, saturated_dn: int) -> CodeReader:
        """Reader from the frames of `CodedSequence.references`.

        Raises
        ------
        PhotometryError
            The frames do not tell the bits apart.
        """
        black, white, *others = (f.reshape(-1).astype(np.float64) for f in frames)
        rise = white - black
        strongest = float(np.quantile(rise, 0.99))
        if strongest < 10 * max(noise_dn, 0.5):
            raise PhotometryError(
                f"white makes the camera's pixels brighter by {strongest:.1f} grey levels only",
                "Check that the projector shows this computer's picture; point it and the camera at the same surface,"
                " lengthen the exposure.",
            )
        clear = (rise > 0.3 * strongest) & (white < saturated_dn)
        rows = np.array([(r - black) / np.maximum(rise, 1e-9) for r in others[:_BAND_BITS]])
        # At a band's edge a pixel belongs to neither side.
        clear &= (np.abs(rows - 0.5) > 0.3).all(axis=0)
        pixels = np.flatnonzero(clear)
        band = ((rows[:, pixels] > 0.5) << np.arange(_BAND_BITS)[:, None]).sum(axis=0)
        singles = np.array(others[_BAND_BITS:])[:, pixels] - black[pixels]
        reader = cls(black[pixels], singles, band, pixels, noise_dn)
        if pixels.size < BANDS * _FEWEST or not reader.bands:
            raise PhotometryError(
                "the camera cannot tell the stripes of the coded pictures apart",
                "Put a plain white board into the picture, focus, and avoid saturation; where the projector's picture"
                " stands still or lags behind, `scan latency` comes first.",
            )
        return reader

    @cached_property
    def _normal(self) -> dict[int, Array]:
        """(bits, bits) inverse normal matrix of every band in which all bits are seen clearly."""
        usable = {}
        for band in range(BANDS):
            a = self.singles[:, self.band == band]
            # The references are as noisy as a frame, and share the noise of black; without its part in the products,
            # every share would come out too small.
            normal = a @ a.T - a.shape[1] * self.noise_dn**2 * (np.eye(len(a)) + 1)
            if a.shape[1] >= _FEWEST and np.linalg.eigvalsh(normal)[0] > 0:
                inverse = np.linalg.inv(normal)
                if 2 * self.noise_dn * np.sqrt(np.diag(inverse).max()) < _CLEAR:
                    usable[band] = inverse
        return usable

    @property
    def bands(self) -> tuple[int, ...]:
        """The bands in which every bit is seen clearly."""
        return tuple(self._normal)

    def shares(self, frame: Pixels) -> tuple[Array, Array]:
        """How far every bit is on, in every usable band, and the standard deviation.

        Parameters
        ----------
        frame
            (H, W).

        Returns
        -------
        share, sigma
            (bands, bits) each.
        """
        rise = frame.reshape(-1)[self.pixels].astype(np.float64) - self.black
        shares, sigmas = [], []
        for band, inverse in self._normal.items():
            here = self.band == band
            products = self.singles[:, here] @ rise[here] - np.count_nonzero(here) * self.noise_dn**2
            shares.append(inverse @ products)
            sigmas.append(2 * self.noise_dn * np.sqrt(np.diag(inverse)))
        return np.array(shares), np.array(sigmas)


def number_of(bits: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Numbers of Gray codes (..., bits), the lowest bit first."""
    code = (bits.astype(np.int64) << np.arange(bits.shape[-1])).sum(axis=-1)
    shift = 1
    while shift < bits.shape[-1]:
        code = code ^ (code >> shift)
        shift *= 2
    return np.asarray(code)
