"""Neighbours vote where the data of a pixel do not decide which place is its direct one: surfaces are continuous."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from scanner.paths.joint import DirectPaths, PathPair
from scanner.regions import continued

_LEAST_STEP_PX, _MOST_STEP_PX = 0.1, 3.0
"""How far a surface leaves the plane through its neighbours, projector px; measured on the decided pixels between."""
_STRAY = 0.1
"""Share of pixels at a depth edge."""
_WITNESSES = 5000
"""Decided pixels that show it, at most."""
_SPAN_PX = 1000.0
"""Range over which a coordinate across an edge may lie, px."""


def ask_neighbours(
    found: DirectPaths,
    pixels: NDArray[np.intp],
    known: NDArray[np.bool_],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    enough: float,
) -> DirectPaths:
    """Let decided pixels vote on undecided ones beside them.

    Parameters
    ----------
    found
        What the data of every pixel say.
    pixels
        (P,) flat numbers of the pixels.
    known
        (H, W) bool, pixels whose coordinates are beyond doubt.
    x, y
        (H, W) these coordinates, px.
    enough
        Confidence from which a pixel is decided and is not asked about.

    Returns
    -------
    DirectPaths
        Best and rival exchanged where the vote says so; the vote's log-likelihood ratio added to the confidence.

    Notes
    -----
    The plane through the neighbours predicts both coordinates; a hypothesis is off by a normal deviation on one surface
    and anywhere across an edge, so that a vote can lend ln(0.9·1000/(0.1·√2π·σ)) at most, 7 to 10 an axis.
    """
    asked = np.isfinite(found.confidence) & (found.confidence < enough)
    if not asked.any() or not known.any():
        return found
    sure = np.flatnonzero(known.reshape(-1)[pixels])
    witnesses = np.zeros_like(asked)
    witnesses[sure[:: max(1, sure.size // _WITNESSES)]] = True
    wanted = np.zeros(known.shape, bool)
    wanted.reshape(-1)[pixels[asked | witnesses]] = True
    # `continued` answers in the order of the picture, and so do the pixels.
    order = np.searchsorted(np.flatnonzero(wanted), pixels)
    vote = np.zeros(pixels.size, np.float32)
    for axis, u in enumerate((x, y)):
        predicted = continued(u, known & np.isfinite(u), wanted)
        off = found.best.direct[axis, witnesses] - predicted[order[witnesses]]
        off = np.abs(off[np.isfinite(off)])
        step = np.clip(2 * np.median(off) / 0.6745, _LEAST_STEP_PX, _MOST_STEP_PX) if off.size else _MOST_STEP_PX
        here = predicted[order[asked]]
        ratio = _likelihood(found.best, axis, asked, here, step) - _likelihood(found.rival, axis, asked, here, step)
        vote[asked] += np.nan_to_num(ratio)
    confidence = np.where(asked, found.confidence + vote, found.confidence)
    turned = confidence < 0
    return replace(
        found,
        best=_choose(turned, found.rival, found.best),
        rival=_choose(turned, found.best, found.rival),
        confidence=np.abs(confidence),
    )


def _likelihood(
    paths: PathPair, axis: int, asked: NDArray[np.bool_], predicted: NDArray[np.float32], step: float
) -> NDArray[np.float64]:
    """Logarithm of the density of a direct coordinate beside its neighbours'."""
    sigma = np.hypot(paths.sigma[axis, asked], step).astype(np.float64)
    off = (paths.direct[axis, asked] - predicted) / sigma
    normal = -0.5 * off**2 - np.log(math.sqrt(2 * math.pi) * sigma)
    # NaN where no neighbour predicts anything.
    with np.errstate(invalid="ignore"):
        return np.asarray(np.logaddexp(math.log(1 - _STRAY) + normal, math.log(_STRAY / _SPAN_PX)))


def _choose(where: NDArray[np.bool_], one: PathPair, other: PathPair) -> PathPair:
    return PathPair(*(np.where(where, getattr(one, f.name), getattr(other, f.name)) for f in fields(PathPair)))
