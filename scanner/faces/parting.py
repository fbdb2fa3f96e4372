"""Parting what round one knows of the scene into faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.faces.growing import Ground, Grown, borders, fill, grow
from scanner.faces.seeds import SHARPEST_DEG, seeds
from scanner.regions import pitch
from scanner.rig import Rig
from scanner.triangulation import triangulate

_OFF_LINE_PX = 3.0
"""Coordinates farther than this from their epipolar line are no place on a face."""

_TOLERANCE_PX = 1.0
"""What continues a face misses it by this, and by half the distance of neighbours."""

_BEND = 3.0
"""Towards a crease or a limb a face goes on as a plane, and misses what is there by so many times more."""

_LEAST_BORDER = 8
"""Cells along which two pieces of one face go over into each other at least."""

_WHOLE = 0.8
"""At this share of the cells between them they do."""

_SAME_PLACE_PX = 4.0
"""A coordinate as near as this to the face is of the face: a quarter of a fringe."""

Coordinates = tuple[NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True)
class Faces:
    """The faces of a scene.

    Parameters
    ----------
    label
        (H, W) int32, number of the face that a pixel sees, 0 for none.
    x, y
        (H, W) projector coordinates of the face there, px; NaN where there is none.
    """

    label: NDArray[np.int32]
    x: NDArray[np.float32]
    y: NDArray[np.float32]

    def settled(self, paths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Paths of pixels, (4, H, W) direct coordinates and those of the bounce, with the place on the face as direct.

        Of two paths the one on the face is direct, whichever was taken for it; where neither is, that of the bounce is
        not known. Pixels without a face stay as they are.
        """
        known = self.label > 0
        off = [np.hypot(paths[k] - self.x, paths[k + 1] - self.y) for k in (0, 2)]
        with np.errstate(invalid="ignore"):
            on, exchanged = (o <= _SAME_PLACE_PX for o in off)
        nan = np.float32(np.nan)
        bounce = [np.where(on, paths[2 + k], np.where(exchanged, paths[k], nan)) for k in (0, 1)]
        return np.where(known, np.stack([self.x, self.y, *bounce]), paths)

    def others(self, label: NDArray[np.intp], size: tuple[int, int]) -> NDArray[np.bool_]:
        """(height, width) bool, projector places of faces that are not among ``label``."""
        known = self.label > 0
        column, row = (np.rint(np.where(known, u, -1)).astype(np.intp) for u in (self.x, self.y))
        known &= (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
        foreign = known & ~np.isin(self.label, label)
        masks = []
        for some in (foreign, known & ~foreign):
            mask = np.zeros((size[1], size[0]), np.uint8)
            mask[row[some], column[some]] = 1
            masks.append(mask)
        reach = int(np.ceil(pitch(self.x, self.y))) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        return np.asarray(cv2.morphologyEx(masks[0], cv2.MORPH_CLOSE, disc) > masks[1])


def find_faces(rig: Rig, sure: Coordinates, open_to: Sequence[Coordinates], wanted: NDArray[np.bool_]) -> Faces:
    """Part a scene into faces.

    Parameters
    ----------
    rig
        Calibrated camera and projector.
    sure
        Coordinates (x, y), (H, W) px, that are beyond doubt; NaN elsewhere. Faces begin there.
    open_to
        Others that a pixel may have, in any order: what continues a face is taken.
    wanted
        (H, W) bool, pixels that a face is continued to where nothing says that it goes on.
    """
    shape = wanted.shape
    step = pitch(*sure)
    side = max(1, round(1 / step)) if step > 1 / 16 else 1
    # A cell is one pixel of several that see the same projector pixel.
    rows, columns = (np.arange(side // 2, n, side) for n in shape)
    grid = np.ix_(rows, columns)
    across, down = np.meshgrid(columns, rows)
    rays = rig.camera.rays(np.stack([across, down], axis=-1).astype(np.float64))
    # Where the lens model ends there is no place either, and zero harms no sum.
    x, y = (np.nan_to_num(rays[..., k]) for k in (0, 1))
    places = [_inverse_depth(rig, c, grid) for c in (sure, *open_to)]
    offered, scale = (np.stack([p[k] for p in places]) for k in (0, 1))
    ground = x, y, offered, scale
    tolerance = _TOLERANCE_PX + 0.5 * step * side
    label, normal, sharp = seeds(offered[0], (x, y), scale[0], tolerance)
    if not label.any():
        nothing = np.full(shape, np.nan, np.float32)
        return Faces(np.zeros(shape, np.int32), nothing, nothing)
    grown = Grown(label, np.where(label > 0, offered[0], np.nan), normal)
    grow(grown, ground, sharp, tolerance)
    fill(grown, ground, wanted[grid] | np.isfinite(offered).any(axis=0), _BEND * tolerance)
    w, label = grown.w, _joined(label, grown.w, ground, tolerance)
    points = rays / np.where(label > 0, w, np.nan)[..., None]
    pixels = rig.projector.project(rig.to_projector_frame(points))
    label = np.where(np.isfinite(pixels[..., 0]), label, 0)
    planes = [label, *(np.where(label > 0, pixels[..., k], np.nan).astype(np.float32) for k in (0, 1))]
    return Faces(*(_enlarged(p, side, shape) for p in planes))


def _inverse_depth(
    rig: Rig, coordinates: Coordinates, grid: tuple[NDArray[np.intp], ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverse depth of the cells, 1/mm, and how far the coordinate moves with it, px mm; NaN where there is none."""
    x, y = (np.full(u.shape, np.nan, np.float32) for u in coordinates)
    x[grid], y[grid] = (u[grid] for u in coordinates)
    one = np.ones(x.shape, np.float32)
    found = triangulate(rig, x, one, y, one)
    points = found.points[grid].astype(np.float64)
    assert found.epipolar_px is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        points[~(found.epipolar_px[grid] <= _OFF_LINE_PX)] = np.nan
        distance = np.linalg.norm(points, axis=-1)
        # σ along the ray is |d| z² σ_w, |d| the length of the ray at z = 1.
        scale = distance * points[..., 2] / found.sigma_point[grid]
        return 1 / points[..., 2], scale


def _joined(label: NDArray[np.int32], w: NDArray[np.float64], ground: Ground, tolerance_px: float) -> NDArray[np.int32]:
    """Labels in which pieces that go over into each other are one."""
    count = int(label.max()) + 1
    pair, how = borders(label, w, ground)
    if not len(pair):
        return label
    smooth = (how[:, 0] < SHARPEST_DEG) & (how[:, 1] <= tolerance_px)
    key = pair.min(axis=1).astype(np.int64) * count + pair.max(axis=1)
    pairs, number = np.unique(key, return_inverse=True)
    met, agreed = np.bincount(number), np.bincount(number, smooth)
    one = (met >= _LEAST_BORDER) & (agreed >= _WHOLE * met)
    area = np.bincount(label.ravel(), minlength=count)
    into, most = np.arange(count), np.zeros(count)
    for first, second, cells in zip(*np.divmod(pairs[one], count), agreed[one], strict=True):
        small, large = (first, second) if area[first] < area[second] else (second, first)
        # A bit beside a crease may go over into both faces: it belongs to one.
        if cells > most[small]:
            into[small], most[small] = large, cells
    while not np.array_equal(into, into[into]):
        into = into[into]
    return np.asarray(np.unique(into, return_inverse=True)[1][into][label], np.int32)


def _enlarged(cells: NDArray, side: int, shape: tuple[int, ...]) -> NDArray:  # type: ignore[type-arg]
    """Values (H, W) of the pixels from those of the cells."""
    if side == 1:
        return cells
    rows, columns = (np.minimum(np.arange(n) // side, m - 1) for n, m in zip(shape, cells.shape, strict=True))
    return np.asarray(cells[np.ix_(rows, columns)])
