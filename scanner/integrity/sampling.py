"""Which pixels of a frame are looked at: windows of 3 × 3 px, spread evenly, in tiles that are judged one by one.

Windows, because the noise is what differs between neighbours; tiles, because a torn frame is right in most of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers import Pixels

_SIDE_PX = 3
_WINDOW = _SIDE_PX**2
_MOST_WINDOWS = (32, 48)
_TILES = (8, 4)
_ENOUGH_WINDOWS = 20
_NEARLY = 0.95

_INNER, _INNER_SIGMAS = 0.9, 1.645
"""Of a normal distribution so many lie within so many σ."""

_EFFICIENCY = 0.64
"""Degrees of freedom of the σ that this quantile tells, for each value: p (1 - p)/f² is the variance of a quantile."""

_CONTRASTS = np.array([[1, 0, -1], [1, -2, 1]], np.float32) / np.sqrt(np.array([[2], [6]], np.float32))
_ROUGH = np.einsum("ir,jc->ijrc", _CONTRASTS, _CONTRASTS).reshape(4, _WINDOW).T
"""What is left of a window without any sum of a function of the row and one of the column, as fringes along either axis
are: four numbers, each with the standard deviation of the noise (after Immerkær, CVIU 64, 300 (1996))."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of the noise of a grey value, as measured.

    Parameters
    ----------
    sigma_dn
        DN.
    freedom
        Degrees of freedom: the variance is known as well as from so many independent values. Infinite where σ is given.
    """

    sigma_dn: float
    freedom: float

    def joined(self, other: Noise) -> Noise:
        """What both measurements of the same noise say together."""
        freedom = self.freedom + other.freedom
        if not np.isfinite(freedom):
            return self if self.freedom >= other.freedom else other
        total = self.freedom * self.sigma_dn**2 + other.freedom * other.sigma_dn**2
        return Noise(float(np.sqrt(total / freedom)), freedom)


@dataclass(frozen=True, eq=False)
class Grid:
    """The pixels of one frame size that are looked at, window by window, the windows tile by tile.

    Parameters
    ----------
    shape
        Of a frame, (H, W).
    rows_px, columns_px
        (P,) where the pixels are; nine in a row make a window.
    tile
        (P,) number of the pixel's tile, ascending.
    tiles
        How many tiles there are.
    """

    shape: tuple[int, int]
    rows_px: NDArray[np.intp]
    columns_px: NDArray[np.intp]
    tile: NDArray[np.intp]
    tiles: int

    @property
    def bands(self) -> int:
        """How many bands of rows the tiles make."""
        return _TILES[0]

    @property
    def band(self) -> NDArray[np.intp]:
        """(P,) number of the pixel's band of rows."""
        return self.tile // _TILES[1]

    def take(self, frame: NDArray[np.generic]) -> NDArray[np.float32]:
        """(P,) values of a (H, W) picture."""
        return frame.reshape(-1).take(self.rows_px * self.shape[1] + self.columns_px).astype(np.float32)

    def take_all(self, frames: Pixels) -> NDArray[np.float32]:
        """(N, P) grey values of (N, H, W) frames."""
        return np.stack([self.take(frame) for frame in frames])

    def rows(self, alarm: NDArray[np.bool_], judged: NDArray[np.bool_]) -> str:
        """Words for the (tiles,) tiles with an error among those that were judged; empty where that is nearly all."""
        bad, seen = (t.reshape(_TILES).any(axis=1) for t in (alarm, judged))
        if not bad.any() or bad.sum() > 0.7 * seen.sum():
            return ""
        rows = self.rows_px[np.isin(self.band, np.flatnonzero(bad))]
        return f" in rows {int(rows.min()) + 1} to {int(rows.max()) + 1}"

    def sums(self, values: NDArray[np.float32], chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(K, tiles + 1) sums of (K, chosen pixels) values over each tile, and over all of them at the end."""
        present, begin = np.unique(self.tile[chosen], return_index=True)
        found = np.zeros((len(values), self.tiles + 1))
        if present.size:
            found[:, present] = np.add.reduceat(values, begin, axis=1)
        found[:, -1] = found[:, :-1].sum(axis=1)
        return found


@lru_cache(maxsize=8)
def grid(shape: tuple[int, int]) -> Grid:
    """The pixels to look at in frames of ``shape`` (H, W); the first and last rows and columns are among them."""
    begins, tiles = [], []
    for length, most, cuts in zip(shape, _MOST_WINDOWS, _TILES, strict=True):
        begin = np.rint(np.linspace(0, length - _SIDE_PX, min(most, length // _SIDE_PX))).astype(np.intp)
        begins.append(begin)
        tiles.append(begin * cuts // length)
    down, across = np.divmod(np.arange(_WINDOW), _SIDE_PX)
    rows, columns, tile = (
        plane.reshape(-1, _WINDOW)
        for plane in np.broadcast_arrays(
            begins[0][:, None, None] + down,
            begins[1][:, None] + across,
            tiles[0][:, None, None] * _TILES[1] + tiles[1][:, None],
        )
    )
    order = np.argsort(tile[:, 0], kind="stable")
    laid = [np.ascontiguousarray(plane[order]).ravel() for plane in (rows, columns, tile)]
    return Grid(shape, laid[0], laid[1], laid[2], _TILES[0] * _TILES[1])


def unsaturated(values: NDArray[np.float32], saturated_dn: int) -> NDArray[np.bool_]:
    """(P,) pixels of (N, P) grey values that are not saturated, nor their neighbours about to be.

    Of pixels at the edge of saturation the noise would choose the dark ones: whole windows are left out instead.
    """
    brightest = values.max(axis=0)
    near = brightest.reshape(-1, _WINDOW).mean(axis=1) > _NEARLY * saturated_dn
    return np.asarray((brightest < saturated_dn) & ~np.repeat(near, _WINDOW))


def noise_of(values: NDArray[np.float32], valid: NDArray[np.bool_], lit: NDArray[np.bool_], least: float) -> Noise:
    """Noise of (K, P) independent values, from what differs between neighbours; ``least`` at least.

    Parameters
    ----------
    values
        Anything linear in the grey values.
    valid
        (P,) pixels that may be asked at all.
    lit
        (P,) those that matter. All others are asked as well: they are more, and darkness has no more noise than light.
    least
        What rounding alone makes.
    """
    rough = np.abs(values.reshape(len(values), -1, _WINDOW) @ _ROUGH)
    whole = valid.reshape(-1, _WINDOW).all(axis=1)
    found, freedom = least, np.inf
    for windows in (whole, whole & (lit.reshape(-1, _WINDOW).sum(axis=1) > _WINDOW // 2)):
        if np.count_nonzero(windows) >= _ENOUGH_WINDOWS:
            # The outer tenth may be faults; the median would not do, because what is cut off at black has hardly any
            # noise.
            found = max(found, float(np.quantile(rough[:, windows], _INNER)) / _INNER_SIGMAS)
            # The darkness has many windows, but what it says of the light is a lower bound.
            freedom = _EFFICIENCY * rough[:, windows].size
    return Noise(found, freedom)


def gradients(z: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """(P,) step of a (P,) phasor to the next pixel to the right and below within its window; 0 at the window's end."""
    square = z.reshape(-1, _SIDE_PX, _SIDE_PX)
    steps = np.zeros((2, *square.shape), np.complex64)
    steps[0, :, :, :-1] = square[:, :, 1:] * square[:, :, :-1].conj()
    steps[1, :, :-1] = square[:, 1:] * square[:, :-1].conj()
    return steps.reshape(2, -1)
