"""Faces of the scene, from what round one knows of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanner.faces import Faces, find_faces
from scanner.methods.fold import Fold
from scanner.methods.separated import Separated
from scanner.result import Maps
from scanner.rig import Rig


def faces_seen(rig: Rig | None, first: Maps, separated: Separated, fold: Fold) -> Faces | None:
    """Part the scene into faces; None without a rig or with one axis.

    Parameters
    ----------
    rig
        Calibrated camera and projector.
    first
        Round one: its coordinates are sure, and its one-path coordinates are open.
    separated
        Both paths of the region's pixels: open as well. A third path that spoils the fit need not spoil the direct one.
    fold
        What is blind at folds holds no coordinate that a face could go on with.
    """
    one_x, one_y = first.x_p_round1, first.y_p_round1
    if rig is None or first.x_p is None or first.y_p is None or one_x is None or one_y is None:
        return None
    two = [(_plane(separated, u["x"]), _plane(separated, u["y"])) for u in (separated.u, separated.bounce)]
    x, y = (np.where(fold.blind, np.float32(np.nan), u) for u in (one_x, one_y))
    return find_faces(rig, (first.x_p, first.y_p), [*two, (x, y)], np.isfinite(one_x) & np.isfinite(one_y))


def _plane(separated: Separated, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) values of all separated pixels, whether these fit or not, NaN elsewhere."""
    found = np.full(separated.shape, np.nan, np.float32)
    found.reshape(-1)[separated.pixels] = values
    return found
