"""The blind strip along a fold, where bounces come from so near that fringes show one path (method.md §4).

Towards a fold between two shiny faces a place and the emitter of its bounce meet. The detected bounces end where the
paths are half a fringe apart; nearer to the fold the bounces are as strong, shift the coordinate by up to α/(1 + α) of
what is left of that distance, and leave no trace in nine neighbouring frequencies. No regional sequence can light such
a place without its emitter either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanner.interreflection import Detection
from scanner.methods.separated import Separated
from scanner.patterns import AXES
from scanner.regions import emitter_mask, inside, pitch, towards_emitters

CLOSE_PATHS_PX = 32.0
"""Two fringes: as near to each other as this, and to a fold, bounces from all around mix."""

_DETECTED_PX = 24.0
"""The paths that are detected nearest to a fold are no farther apart than a fringe and a half."""


@dataclass(frozen=True)
class Fold:
    """What lies at folds.

    Parameters
    ----------
    blind
        (H, W) bool, undetected pixels between a fold and the detected bounces from across it.
    strip
        (height, width) bool, their projector places: nothing can be measured there, and they throw bounces.
    beside
        (height, width) bool, places less than two fringes from those: two paths are too few there.
    """

    blind: NDArray[np.bool_]
    strip: NDArray[np.bool_]
    beside: NDArray[np.bool_]


def find_folds(
    separated: Separated,
    detection: Detection,
    x: NDArray[np.float32] | None,
    y: NDArray[np.float32] | None,
    size: tuple[int, int],
) -> Fold:
    """Find the blind strips.

    Parameters
    ----------
    separated, detection
        Round one: both paths in its region.
    x, y
        (H, W) its one-path coordinates of all pixels, px, NaN where there is none; None where not projected, and then
        no fold is found.
    size
        Projector (width, height), px.
    """
    blind, strip = np.zeros(separated.shape, bool), np.zeros((size[1], size[0]), bool)
    if x is None or y is None:
        return Fold(blind, strip, strip)
    known = separated.located
    direct_x, direct_y, from_x, from_y = (p[a][known] for p in (separated.u, separated.bounce) for a in AXES)
    between = towards_emitters(direct_x, direct_y, from_x, from_y, size, _DETECTED_PX)
    undetected, step = ~detection.region & ~detection.depth_edge, pitch(x, y)
    blind = undetected & inside(between, x, y, 0)
    strip, beside = (emitter_mask(x[blind], y[blind], size, reach, step) for reach in (0, CLOSE_PATHS_PX))
    return Fold(blind | (undetected & inside(strip, x, y, 0)), strip, beside)


def doubted_beside(fold: Fold, separated: Separated) -> Separated:
    """Trust no separation beside a fold: it says where to light, and is no coordinate."""
    if not fold.blind.any():
        return separated
    near = inside(fold.beside, separated.u["x"], separated.u["y"], 0)
    return replace(separated, trusted=separated.trusted & ~near)
