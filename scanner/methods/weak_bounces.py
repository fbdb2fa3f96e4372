"""Bounces that only the neighbourhood of a pixel shows, on both axes of a round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanner.methods.base import Setup
from scanner.methods.multi_frequency import DecodedAxis
from scanner.methods.separated import phasors_of
from scanner.patterns import Axis
from scanner.phasors import RoundPhasors
from scanner.ripples import remove_ripples, shift_of

_MATTERS = 0.5
"""A shift of so many σ is worth telling."""


def without_ripples(
    frames: RoundPhasors,
    decoded: dict[Axis, DecodedAxis],
    good: NDArray[np.bool_],
    asked: NDArray[np.bool_],
    setup: Setup,
) -> tuple[dict[Axis, DecodedAxis], NDArray[np.bool_], NDArray[np.bool_]]:
    """Take the bounces that only neighbours show off the ``asked`` pixels, and off their phasors.

    Parameters
    ----------
    frames
        Of a round. **Changed**: what is taken off leaves their phasors.
    decoded
        Its axes.
    good, asked
        (H, W) bool, as for `scanner.ripples.remove_ripples`.
    setup
        Whether it is wanted.

    Returns
    -------
    tuple
        The axes without them; (H, W) bool, the pixels that were changed; and those of them where that matters beside
        the noise of the coordinate.
    """
    if not setup.scan.remove_ripples:
        return decoded, np.zeros(good.shape, bool), np.zeros(good.shape, bool)
    smooth: dict[Axis, DecodedAxis] = {}
    ripples: dict[Axis, NDArray[np.float32]] = {}
    matters = np.zeros(good.shape, bool)
    for axis, d in decoded.items():
        extent = frames.plan.extent(axis)
        coordinates, ripples[axis] = remove_ripples(
            phasors_of(frames, axis), d.coordinates, d.sigma_z, d.gain, good, asked, extent
        )
        smooth[axis] = replace(d, coordinates=coordinates)
        shift = shift_of(ripples[axis], phasors_of(frames, axis).frequency)
        matters |= shift >= _MATTERS * d.coordinates.sigma
    if len(ripples) == 2:
        pairs: tuple[tuple[Axis, Axis], ...] = (("x", "y"), ("y", "x"))
        for axis, other in pairs:
            # Both axes see the same bounce: what one shows and the other does not is still in the other's coordinate.
            hidden = np.maximum(ripples[other] - ripples[axis], 0)
            c = smooth[axis].coordinates
            sigma = np.hypot(c.sigma, shift_of(hidden, phasors_of(frames, axis).frequency))
            smooth[axis] = replace(smooth[axis], coordinates=replace(c, sigma=sigma))
    changed = np.asarray(np.maximum.reduce(list(ripples.values())) > 0)
    return smooth, changed, changed & matters
