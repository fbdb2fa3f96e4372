"""The blind strip along a fold, where bounces come from so near that fringes show one path (method.md §4).

Towards a fold between two shiny faces a place and the emitter of its bounce meet. The detected bounces end where the
paths are half a fringe apart; nearer to the fold the bounces are as strong, shift the coordinate by up to α/(1 + α) of
what is left of that distance, and leave no trace in nine neighbouring frequencies. No regional sequence can light such
a place without its emitter either.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.interreflection import Detection
from scanner.methods.separated import Separated
from scanner.patterns import AXES
from scanner.regions import LEAST_SURFACE, between_paths, emitter_mask, inside, pitch

CLOSE_PATHS_PX = 32.0
"""Two fringes: as near to each other as this, and to a fold, bounces from all around mix."""

_DETECTED_PX = 24.0
"""The paths that are detected nearest to a fold are no farther apart than a fringe and a half."""

_STRONG = 0.2
"""Weaker bounces, which go unseen from farther away as well, move a coordinate by less than half a pixel."""

_AROUND_PX = 3.0
_MOST = 0.5
"""Beside a fold most detected bounces around are strong and near; elsewhere a separation errs now and then."""

_SURE = 0.25
"""Share of a blind strip that lies between such bounces."""

_MUTUAL = 0.05
"""Share of the bounces beside folds that go the other way where faces light each other; beside a mirror none does."""

_BLUR_PX = 2.0
"""The strip's light reaches so far beyond it, by the projector's blur."""


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
        (height, width) bool, places less than two fringes from those: two paths may be too few there.
    across
        (H, W) bool, detected pixels whose bounces are strong and near, as most around them are: from across a fold.
    """

    blind: NDArray[np.bool_]
    strip: NDArray[np.bool_]
    beside: NDArray[np.bool_]
    across: NDArray[np.bool_]

    @classmethod
    def none(cls, shape: tuple[int, ...], size: tuple[int, int]) -> Fold:
        """No fold, for a camera's (height, width) and a projector's (width, height)."""
        camera, projector = np.zeros(shape, bool), np.zeros((size[1], size[0]), bool)
        return cls(camera, projector, projector, camera)


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
    if x is None or y is None:
        return Fold.none(separated.shape, size)
    paths = [p[a] for p in (separated.u, separated.bounce) for a in AXES]
    away = np.hypot(paths[2] - paths[0], paths[3] - paths[1])
    near = separated.plausible & (separated.strength >= _STRONG) & (away <= _DETECTED_PX)
    undetected, step = ~detection.region & ~detection.depth_edge, pitch(x, y)

    def between(some: NDArray[np.bool_]) -> NDArray[np.bool_]:
        direct_x, direct_y, from_x, from_y = (p[some] for p in paths)
        places = between_paths(direct_x, direct_y, from_x, from_y, size, _DETECTED_PX, 0.5)
        return np.asarray(undetected & inside(places, x, y, 0))

    mostly = near & _mostly(near, separated, detection, step)
    blind, sure = between(near), between(mostly)
    count, labels = cv2.connectedComponents(blind.astype(np.uint8), connectivity=8)
    area = np.bincount(labels.ravel(), minlength=count)
    share = np.bincount(labels[sure & blind], minlength=count) / np.maximum(area, 1)
    blind &= ((share >= _SURE) & (area >= LEAST_SURFACE))[labels]
    strip, beside = (emitter_mask(x[blind], y[blind], size, reach, step) for reach in (_BLUR_PX, CLOSE_PATHS_PX))
    across = np.zeros(separated.shape, bool)
    across.reshape(-1)[separated.pixels[mostly]] = True
    return Fold(blind | (undetected & inside(strip, x, y, 0)), strip, beside, across)


def _mostly(near: NDArray[np.bool_], separated: Separated, detection: Detection, step: float) -> NDArray[np.bool_]:
    """(P,) whether most detected pixels around are ``near`` ones."""
    image = np.zeros(separated.shape, np.float32)
    image.reshape(-1)[separated.pixels] = near
    reach = max(1, round(_AROUND_PX / step))
    window = (2 * reach + 1, 2 * reach + 1)
    share = cv2.blur(image, window) / np.maximum(cv2.blur(detection.region.astype(np.float32), window), 1e-6)
    return np.asarray(share.reshape(-1)[separated.pixels] >= _MOST)


def doubted_beside(fold: Fold, separated: Separated) -> Separated:
    """Trust no separation beside folds where two paths are too few: it says where to light, and is no coordinate.

    Faces that light each other send light back and forth; a mirror sends it one way only.
    """
    across = fold.across.reshape(-1)[separated.pixels]
    if not fold.blind.any() or not across.any():
        return separated
    away = np.stack([(separated.bounce[a] - separated.u[a])[across] for a in AXES], axis=1)
    along = away @ np.linalg.eigh(away.T @ away)[1][:, -1]
    if not _MUTUAL <= np.mean(along > 0) <= 1 - _MUTUAL:
        return separated
    near = inside(fold.beside, separated.u["x"], separated.u["y"], 0)
    return replace(separated, trusted=separated.trusted & ~near)
