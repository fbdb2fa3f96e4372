"""What the regional sequences light: where the direct light of a group comes from, without what throws its bounces."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from scanner.faces import Faces
from scanner.methods.fold import CLOSE_PATHS_PX, Fold
from scanner.methods.separated import Separated
from scanner.patterns import AXES
from scanner.regions import (
    LEAST_SURFACE,
    beyond_the_middle,
    continued,
    emitter_mask,
    pitch,
    sound_mask,
    surfaces,
)

_AROUND_PX = 24.0
"""Standard deviation of the window in which what round one does not tell follows most of what it does, camera px."""

_BEYOND = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)), np.uint8)
"""Two pixels beyond the end of a face."""

_EMITTER_PX = 3.0
"""How far from an emitter undetected places are lit along."""


def lit_sets(
    group: NDArray[np.int8],
    paths: NDArray[np.float32],
    located: NDArray[np.bool_],
    between: NDArray[np.bool_],
    rim: NDArray[np.bool_],
    first: tuple[NDArray[np.float32], NDArray[np.float32]],
    separated: Separated,
    fold: Fold,
    faces: Faces | None,
    size: tuple[int, int],
    margin_px: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int8], list[NDArray[np.bool_]]]:
    """What every group lights.

    Parameters
    ----------
    group
        (H, W) number of the group of a pixel whose paths are known, -1 for none.
    paths
        (4, H, W) direct coordinates (x, y) and those of the bounce, px.
    located
        (H, W) bool, where they are clear.
    between, rim
        (H, W) bool, pixels of the region without a group, and undetected ones around, that are served as well.
    first
        Coordinates (x, y) of round one, (H, W) px.
    separated, fold, faces
        Round one's separation, what lies at folds, and the faces of the scene where they are known.
    size, margin_px
        Projector (width, height), px; by how much what is lit is grown.

    Returns
    -------
    tuple
        Direct coordinates x and y of all that is served, (H, W) px; the group that serves each; and (height, width)
        bool for every group.
    """
    places = [np.where(group >= 0, p, np.float32(np.nan)) for p in paths[:2]]
    for place, u in zip(places, first, strict=True):
        place[rim] = u[rim]
    if group.max(initial=-1) < 0:
        return places[0], places[1], group, []
    nearest = _around(group, faces, [np.where(np.isfinite(p), p, u) for p, u in zip(places, first, strict=True)])
    step = pitch(paths[0], paths[1])
    masks = []
    for k in range(int(group.max()) + 1):
        chosen, mine = group == k, between & (nearest == k)
        direct = []
        for place, u, doubted, a in zip(places, paths[:2], _goes_on(separated, paths, chosen), AXES, strict=True):
            # Where the fringe orders of both paths could not be told, the surface around them can.
            found = continued(u, chosen, mine) if a in separated.u else u[mine]
            # Farther away, what is on one surface with it: a third path spoils a bounce sooner than the direct path.
            found = np.where(np.isnan(found), doubted[mine], found)
            place[mine] = found
            direct.append(np.append(u[chosen], found))
        # The margin grows neither onto emitters nor across a fold.
        across = chosen & fold.across
        behind = beyond_the_middle(
            paths[0][across], paths[1][across], paths[2][across], paths[3][across], CLOSE_PATHS_PX
        )
        emitters = np.append(paths[2][chosen], behind[0]), np.append(paths[3][chosen], behind[1])
        mask = sound_mask(direct[0], direct[1], size, margin_px, emitters, step)
        around = rim & (nearest == k) & ~chosen
        along = sound_mask(first[0][around], first[1][around], size, margin_px, None, step)
        sources = paths[2][chosen & located], paths[3][chosen & located]
        throwing = emitter_mask(*sources, size, _EMITTER_PX, step)
        mask |= along & ~throwing
        dark = fold.strip
        if faces is not None:
            others = faces.others(np.unique(faces.label[chosen]), size)
            # Fringes are whole up to the end of a face only where a little more is lit, and that may throw no bounce.
            beyond = cv2.erode(others.astype(np.uint8), _BEYOND, borderValue=1) > 0
            dark = dark | beyond | (others & throwing)
        masks.append(mask & ~dark)
    return places[0], places[1], np.where(np.isfinite(places[0]) | np.isfinite(places[1]), nearest, -1), masks


def _goes_on(separated: Separated, paths: NDArray[np.float32], chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(2, H, W) direct coordinates of separations that do not fit, px, where they go on with those of a group."""
    found = np.full((2, *separated.shape), np.nan, np.float32)
    if len(separated.u) < 2:
        return found
    spoilt = ~separated.plausible
    found.reshape(2, -1)[:, separated.pixels[spoilt]] = [separated.u[a][spoilt] for a in AXES]
    found[:, chosen] = paths[:2, chosen]
    count, labels, _ = surfaces(found[0], found[1])
    connected = np.bincount(labels[chosen], minlength=count) >= LEAST_SURFACE
    connected[0] = False
    found[:, ~connected[labels]] = np.nan
    return found


def _around(group: NDArray[np.int8], faces: Faces | None, places: list[NDArray[np.float32]]) -> NDArray[np.int8]:
    """(H, W) group of every pixel: its own, else that of most pixels around it, on the same surface if there is any."""
    count, labels, _ = surfaces(places[0], places[1])
    if faces is not None:
        # A bit of continuous surface may belong to two faces, and a face is in one group.
        labels = np.where(faces.label > 0, faces.label + count, labels)
        count += int(faces.label.max()) + 1
    votes = []
    for k in range(int(group.max()) + 1):
        mine = group == k
        there = np.zeros(count, bool)
        there[labels[mine]] = True
        there[0] = False
        near = cv2.GaussianBlur(mine.astype(np.float32), (0, 0), _AROUND_PX, borderType=cv2.BORDER_CONSTANT)
        # Beyond the blur the nearest counts, a little.
        votes.append(near + 1e-6 / (1 + distance_transform_edt(~mine)) + there[labels])
    found = np.argmax(np.stack(votes), axis=0)
    return np.where(group >= 0, group, found).astype(np.int8)
