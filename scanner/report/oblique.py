"""The measured surface seen from the side, as a still picture: several scans from one viewpoint can be compared."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from scanner.report.surface import LocalPlanes

Array = NDArray[Any]

_WIDTH = 520
_YAW, _PITCH = math.radians(32), math.radians(-14)
_LIGHT = np.array([-0.35, -0.5, -0.79])


@dataclass(frozen=True)
class Viewpoint:
    """An orthographic view of a box of space.

    Parameters
    ----------
    middle
        (3,) mm, where the view is centred.
    rotation
        (3, 3) from the camera's frame to the view's: x right, y down, z away.
    px_per_mm, size
        Scale, and the picture's (width, height).
    """

    middle: NDArray[np.float64]
    rotation: NDArray[np.float64]
    px_per_mm: float
    size: tuple[int, int]

    @classmethod
    def of(cls, points: Array) -> Self:
        """See the middle 98 % of ``points`` (H, W, 3) from their right and above."""
        known = points[np.isfinite(points[..., 2])].astype(np.float64)
        if not len(known):
            return cls(np.zeros(3), np.eye(3), 1.0, (_WIDTH, _WIDTH // 2))
        middle = np.median(known, axis=0)
        cy, sy, cp, sp = math.cos(_YAW), math.sin(_YAW), math.cos(_PITCH), math.sin(_PITCH)
        rotation = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]) @ np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
        flat = ((known - middle) @ rotation.T)[:, :2]
        low, high = np.percentile(flat, 1, axis=0), np.percentile(flat, 99, axis=0)
        middle = middle + rotation[:2].T @ ((low + high) / 2)
        span = 1.12 * np.maximum(high - low, 1e-3)
        scale = _WIDTH / span[0]
        height = int(np.clip(scale * span[1], 0.4 * _WIDTH, 1.1 * _WIDTH))
        return cls(middle, rotation, min(scale, height / span[1]), (_WIDTH, height))

    def shaded(self, points: Array, planes: LocalPlanes) -> NDArray[np.float32]:
        """(h, w) brightness 0..1 of the (H, W, 3) points, lit from the upper left; NaN where there is none.

        Parameters
        ----------
        points, planes
            Of one scan.
        """
        normals = np.repeat(np.repeat(planes.normals, planes.stride, axis=0), planes.stride, axis=1)
        normals = normals[: points.shape[0], : points.shape[1]]
        known = np.isfinite(points[..., 2])
        seen = (points[known].astype(np.float64) - self.middle) @ self.rotation.T
        width, height = self.size
        x = np.rint(seen[:, 0] * self.px_per_mm + width / 2).astype(np.intp)
        y = np.rint(seen[:, 1] * self.px_per_mm + height / 2).astype(np.intp)
        # A point without a neighbourhood of its own, a stray, is drawn dark.
        shade = np.nan_to_num(normals[known] @ _LIGHT, nan=0.12)
        shade = np.clip(shade, 0.05, 1)
        reach = self._splat(points)
        offsets = np.arange(-reach, reach + 1)
        dy, dx = (d.ravel() for d in np.meshgrid(offsets, offsets, indexing="ij"))
        x, y = (x[:, None] + dx).ravel(), (y[:, None] + dy).ravel()
        shade, depth = np.repeat(shade, dx.size), np.repeat(seen[:, 2], dx.size)
        inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
        far_first = inside[np.argsort(-depth[inside], kind="stable")]
        canvas = np.full((height, width), np.nan, np.float32)
        canvas[y[far_first], x[far_first]] = shade[far_first]
        return canvas

    def _splat(self, points: Array) -> int:
        """Half the side of a point's square, px, so that neighbours touch."""
        step = np.linalg.norm(np.diff(points, axis=1), axis=2)
        usual = float(np.nanmedian(step)) if np.isfinite(step).any() else 1.0
        return int(np.clip(math.ceil(usual * self.px_per_mm / 2), 0, 4))
