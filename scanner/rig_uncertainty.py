"""What a rig's own uncertainty does to points: the covariance that its calibration states, carried along viewing rays.

Noise differs from pixel to pixel; an error of the rig moves neighbours alike and stays from scan to scan. So it is a
term of its own: no mean over pixels or scans lowers it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanner.rig import Lens, Rig, RigError

Array = NDArray[np.float64]
Map = NDArray[np.float32]

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
_FOCAL = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
_AXES = {"x": 0, "y": 1, "z": 2}
_NODES = (13, 11, 9)
"""Of the grid over columns, rows and logarithms of depth: between them the σ of a rig is straight within 2 %."""
_STEP = 1e-4  # of a depth, for its derivative
_FLAT = 1e-3  # a scene this shallow still gets a grid


def sigma_rig(rig: Rig, depth: Map, sigma_x: Map | None, sigma_y: Map | None) -> Map | None:
    """Standard deviation of points along their viewing rays from the rig's own covariance.

    To first order (GUM, 5.2.2): a step δ of the parameters moves the projector coordinates u of a pixel's point by
    ∂u/∂θ δ, which its inverse depth w makes up for by least squares, δw = −Σ u_w (∂u/∂θ δ)/σ² / Σ u_w²/σ²; the point
    d/w moves with w and with the ray d. Done for each principal axis of the covariance on a coarse grid of pixels and
    depths, interpolated between.

    Parameters
    ----------
    rig
        With the covariance of `calibration.bundle.calibrate_rig` in its metadata.
    depth
        (H, W) mm, NaN where there is no point.
    sigma_x, sigma_y
        (H, W) σ of projector column and row, px, whose medians weigh the axes; None for one that was not measured.

    Returns
    -------
    (H, W) mm, NaN where there is no point; None for a rig that states no covariance, or one that cannot be used
    (`covariance_fault`).
    """
    stated = None if covariance_fault(rig) is not None else _stated(rig)
    if stated is None:
        return None
    out = np.full(depth.shape, np.nan, np.float32)
    row, column = np.nonzero(depth > 0)
    if row.size == 0:
        return out
    from scipy.ndimage import map_coordinates

    distance = np.log(depth[row, column].astype(np.float64))
    low, high = float(distance.min()) - _FLAT, float(distance.max()) + _FLAT
    ends = ((0.0, depth.shape[1] - 1.0), (0.0, depth.shape[0] - 1.0), (low, high))
    x, y, z = np.meshgrid(*(np.linspace(*end, n) for end, n in zip(ends, _NODES, strict=True)), indexing="ij")
    weights = np.array([_weight(sigma_x), _weight(sigma_y)])
    grid = along_rays(rig, *stated, np.stack((x, y), -1), np.exp(z), weights)
    place = [
        (values - end[0]) / max(end[1] - end[0], _FLAT) * (n - 1)
        for values, end, n in zip((column, row, distance), ends, _NODES, strict=True)
    ]
    out[row, column] = map_coordinates(grid, place, order=1, mode="nearest")
    return out


def along_rays(rig: Rig, names: list[str], covariance: Array, px: Array, depth: Array, weights: Array) -> Array:
    """Standard deviation of points along their viewing rays, exactly where it is asked for; see `sigma_rig`.

    Parameters
    ----------
    rig
        Where the parameters stand.
    names
        (q,) parameters, such as ``camera.fx`` or ``rotation.x`` (rad about the projector's axes), board's ignored.
    covariance
        (q, q).
    px, depth
        (..., 2) camera px, (...) mm.
    weights
        (2,) 1/σ² of projector column and row, 0 for one that was not measured.

    Returns
    -------
    (...) mm.

    Raises
    ------
    RigError
        ``names`` holds one that no rig has.
    """
    ours = [i for i, name in enumerate(names) if not name.startswith("board.")]
    variance, axes = np.linalg.eigh(covariance[np.ix_(ours, ours)])
    step = _STEP * depth
    by_depth = (rig.epipolar_curve(px, depth + step) - rig.epipolar_curve(px, depth - step)) / (2 * step)[..., None]
    u_w = -by_depth * (depth**2)[..., None]
    information = (weights * u_w**2).sum(-1)
    ray = rig.camera.rays(px)
    length = np.linalg.norm(ray, axis=-1)
    total = np.zeros(depth.shape)
    for size, axis in zip(np.sqrt(np.maximum(variance, 0)), axes.T, strict=True):
        rigs = [_moved(rig, [names[i] for i in ours], sign * size * axis) for sign in (1, -1)]
        u = (rigs[0].epipolar_curve(px, depth) - rigs[1].epipolar_curve(px, depth)) / 2
        turned = (rigs[0].camera.rays(px) - rigs[1].camera.rays(px)) / 2
        w = -(weights * u_w * u).sum(-1) / information
        total += (((turned * ray).sum(-1) * depth - length**2 * depth**2 * w) / length) ** 2
    return np.asarray(np.sqrt(total))


def covariance_fault(rig: Rig) -> str | None:
    """Say why `sigma_rig` cannot use the covariance that a rig states; None where it can, or none is stated.

    Another program may keep something else under the same names: its rig scans as well as any.
    """
    try:
        stated = _stated(rig)
        if stated is not None:
            names = [name for name in stated[0] if not name.startswith("board.")]
            _moved(rig, names, np.zeros(len(names)))
    except RigError as error:
        return f"{error.message}: points are without sigma_rig. {error.remedy}"
    return None


def _stated(rig: Rig) -> tuple[list[str], Array] | None:
    document = rig.metadata.get("calibration", {})
    if not isinstance(document, Mapping) or not {"parameters", "covariance"} <= document.keys():
        return None
    names: Any = document["parameters"]
    listed = isinstance(names, list | tuple) and all(isinstance(name, str) for name in names)
    if not listed or len(set(names)) < len(names):
        raise RigError(
            "the covariance of the rig comes without a list of different names, one for each parameter",
            "Calibrate again, or leave covariance out of the rig's metadata.",
        )
    try:
        covariance = np.array(document["covariance"], np.float64)
    except (TypeError, ValueError):
        covariance = np.empty(0)
    if covariance.shape != (len(names), len(names)) or not np.isfinite(covariance).all():
        raise RigError(
            f"the covariance of the rig is no table of {len(names)} × {len(names)} numbers, one for each parameter",
            "Take the rig file from a backup, calibrate again, or leave covariance out of its metadata.",
        )
    return list(names), covariance


def _weight(sigma: Map | None) -> float:
    if sigma is None:
        return 0.0
    known = sigma[sigma > 0]
    return 1.0 / float(np.median(known)) ** 2 if known.size else 1.0


def _moved(rig: Rig, names: list[str], steps: Array) -> Rig:
    """The rig after a step (q,) of its parameters."""
    by_name = dict(zip(names, steps.tolist(), strict=True))
    turn, shift = np.zeros(3), np.zeros(3)
    lenses: list[Lens] = []
    for part, lens in (("camera", rig.camera), ("projector", rig.projector)):
        matrix = lens.matrix.copy()
        distortion = np.pad(lens.distortion, (0, len(_DISTORTION) - lens.distortion.size))
        taken = {name: by_name.pop(f"{part}.{name}") for name in (*_FOCAL, *_DISTORTION) if f"{part}.{name}" in by_name}
        if "fx" in taken:
            taken.setdefault("fy", taken["fx"])  # pixels taken as square
        for name, step in taken.items():
            if name in _FOCAL:
                matrix[_FOCAL[name]] += step
            else:
                distortion[_DISTORTION.index(name)] += step
        lenses.append(Lens(matrix, distortion, lens.size))
    for part, vector in (("rotation", turn), ("translation", shift)):
        for name, index in _AXES.items():
            vector[index] = by_name.pop(f"{part}.{name}", 0.0)
    if by_name:
        raise RigError(
            f"the covariance of the rig names {', '.join(by_name)}, which no rig has",
            "Read it with the version of this program that wrote it, or calibrate again.",
        )
    rotation = _rotation(turn) @ rig.rotation
    return replace(rig, camera=lenses[0], projector=lenses[1], rotation=rotation, translation=rig.translation + shift)


def _rotation(turn: Array) -> Array:
    """(3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # sin a / a and (1 - cos a) / a², which do not lose digits at small angles in this form.
    turned = np.eye(3) + np.sinc(angle / math.pi) * cross + np.sinc(angle / (2 * math.pi)) ** 2 / 2 * (cross @ cross)
    return np.asarray(turned)
