"""All observations of a calibration as flat arrays, so that one call projects them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibration.observations import PoseObservation

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Measurements:
    """What all poses measured, pose after pose.

    Parameters
    ----------
    points
        (N, 3) mm in the board's frame.
    pose
        (N,) which pose, ascending.
    point
        (N,) which point of the board, as a row of `State.board`.
    measured
        (2, N, 2) px: camera, projector; 0 where nothing was measured.
    weight
        (2, N, 2) 1/σ²; 0 where nothing was measured. The projector's is that of its coordinate at the camera's place.
    gradient
        (N, 2, 2) by which the projector's coordinates err with the camera's, px/px.
    extent
        Half of the board's larger side, mm: where a bend is stated.
    count
        Number of poses.
    """

    points: Array
    pose: NDArray[np.int64]
    point: NDArray[np.int64]
    measured: Array
    weight: Array
    gradient: Array
    extent: float
    count: int

    @property
    def known(self) -> NDArray[np.bool_]:
        """(2, N, 2) which coordinates were measured."""
        return self.weight > 0

    @property
    def board_size(self) -> int:
        """How many different points of the board were seen."""
        return int(self.point.max()) + 1

    def slices(self) -> list[slice]:
        """The rows of every pose."""
        ends = np.searchsorted(self.pose, np.arange(self.count + 1)).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def of_camera(self) -> Measurements:
        """The same with the projector's coordinates unmeasured."""
        return replace(self, weight=self.weight * np.array([1.0, 0.0])[:, None, None])


def gathered(observations: Sequence[PoseObservation], keep: Sequence[NDArray[np.bool_]] | None = None) -> Measurements:
    """Flat arrays of ``observations``; ``keep`` (per pose, (n,)) leaves points out."""
    chosen = keep if keep is not None else [np.ones(len(o.ids), bool) for o in observations]
    points = np.concatenate([o.points_board[k] for o, k in zip(observations, chosen, strict=True)])
    pose = np.concatenate([np.full(int(k.sum()), i) for i, k in enumerate(chosen)])
    pairs = [
        np.concatenate([getattr(o, name)[k] for o, k in zip(observations, chosen, strict=True)])
        for name in ("camera", "projector")
    ]
    sigmas = [
        np.concatenate(
            [
                np.broadcast_to(_columns(getattr(o, name)), o.camera.shape)[k]
                for o, k in zip(observations, chosen, strict=True)
            ]
        )
        for name in ("camera_sigma", "projector_sigma")
    ]
    measured, sigma = np.stack(pairs).astype(np.float64), np.stack(sigmas).astype(np.float64)
    known = np.isfinite(measured) & np.isfinite(sigma) & (sigma > 0)
    weight = np.where(known, 1 / np.where(known, sigma, 1.0) ** 2, 0.0)
    gradient = np.concatenate(
        [
            np.broadcast_to(o.projector_gradient, (*o.camera.shape, 2))[k]
            for o, k in zip(observations, chosen, strict=True)
        ]
    )
    extent = float(np.ptp(points[:, :2], axis=0).max()) / 2
    ids = np.concatenate([o.ids[k] for o, k in zip(observations, chosen, strict=True)])
    _, point = np.unique(ids, return_inverse=True)
    return Measurements(
        points, pose, point, np.where(known, measured, 0.0), weight, gradient * known[0][:, None], extent, len(chosen)
    )


def _columns(sigma: Array) -> Array:
    """σ per coordinate (n, 2), or per point (n,) for both coordinates."""
    sigma = np.asarray(sigma, np.float64)
    return sigma[:, None] if sigma.ndim == 1 else sigma
