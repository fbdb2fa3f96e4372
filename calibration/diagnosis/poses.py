"""How the board was held: enough poses, tilts, depths, and all of the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibration.observations import Finding
from calibration.planning.coverage import common_view, inside_any
from calibration.solver.result import Calibration, PoseResult

Array = NDArray[np.float64]

_FEW_POSES = 5
_LEAST_TILT_DEG, _GOOD_TILT_DEG = 8.0, 15.0
_LEAST_DEPTH = 0.06  # of the mean distance
_SAME_POSE = 0.004  # of the picture's width: nearer poses tell nothing that averaging would not
_LEAST_COVERED = 0.5


def ill_posed(calibration: Calibration) -> list[Finding]:
    """Findings about the poses that took part."""
    used = [pose for pose in calibration.poses if pose.used]
    apart = _apart(calibration, used)
    return [
        *_count(used, apart),
        *_tilts(used),
        *_depths(used),
        *_coverage(calibration),
    ]


def tilt_spread(poses: list[PoseResult]) -> tuple[float, float]:
    """Largest and across it the smallest spread (°) of the boards' normals, and so of what perspective can tell.

    The spread is the peak-to-peak of the normals along their two principal directions.
    """
    normals = np.stack([pose.rotation[:, 2] for pose in poses])
    middle = normals.mean(0) / np.linalg.norm(normals.mean(0))
    flat = normals - (normals @ middle)[:, None] * middle
    _, _, axes = np.linalg.svd(flat)
    angles = np.degrees(np.arcsin(np.clip(flat @ axes[:2].T, -1, 1)))
    spread = np.ptp(angles, axis=0)
    return float(spread.max()), float(spread.min())


def _count(used: list[PoseResult], apart: list[list[int]]) -> list[Finding]:
    findings = []
    repeated = [group for group in apart if len(group) > 1]
    if repeated:
        names = "; ".join(", ".join(used[i].name for i in group) for group in repeated)
        findings.append(
            Finding(
                "repeated_pose",
                len(apart) < 3,
                f"the board was held in the same place again ({names}): {len(used)} poses are {len(apart)} different "
                "ones",
                "Move and tilt the board between poses, by a hand's breadth and by 20° or more.",
            )
        )
    if len(apart) < _FEW_POSES:
        findings.append(
            Finding(
                "too_few_poses",
                len(apart) < 3,
                f"{len(apart)} different poses leave little to check the result by",
                "Take ten or more, tilted differently.",
            )
        )
    return findings


def _tilts(used: list[PoseResult]) -> list[Finding]:
    widest, narrowest = tilt_spread(used)
    if widest < _LEAST_TILT_DEG:
        return [
            Finding(
                "too_few_tilts",
                True,
                f"all boards are held parallel within {widest:.1f}°: a focal length cannot be told from a distance so",
                "Tilt the board by 20° to 40°, to the left, right, up and down in turn.",
            )
        ]
    if narrowest < _LEAST_TILT_DEG or widest < _GOOD_TILT_DEG:
        return [
            Finding(
                "too_few_tilts",
                False,
                f"the boards' tilts span {widest:.0f}° one way and {narrowest:.0f}° the other",
                "Add poses tilted by 20° to 40° about the other axis.",
            )
        ]
    return []


def _depths(used: list[PoseResult]) -> list[Finding]:
    distance = np.array([pose.translation[2] for pose in used])
    span = float(np.ptp(distance) / distance.mean())
    if span >= _LEAST_DEPTH:
        return []
    return [
        Finding(
            "one_depth",
            False,
            f"all boards are held at one depth ({distance.min():.0f} to {distance.max():.0f} mm): the rig is proven "
            "nowhere else",
            "Add poses at the near and the far end of the volume to be measured.",
        )
    ]


def _coverage(calibration: Calibration) -> list[Finding]:
    place = common_view(calibration)
    if not len(place.camera):
        return []
    points = [
        calibration.data.measured[0, rows][calibration.data.known[0, rows].all(axis=1)]
        for rows in calibration.data.slices()
    ]
    seen = inside_any(points, place.camera)
    share = float(seen.mean())
    if share >= _LEAST_COVERED:
        return []
    middle = (place.camera.min(0) + place.camera.max(0)) / 2
    missing = np.sign(np.round((place.camera[~seen].mean(0) - middle) / np.ptp(place.camera, axis=0), 1))
    where = {(-1, "x"): "left", (1, "x"): "right", (-1, "y"): "upper", (1, "y"): "lower"}
    told = " ".join(where[int(v), a] for v, a in ((missing[1], "y"), (missing[0], "x")) if v) or "outer"
    return [
        Finding(
            "coverage",
            False,
            f"the board was seen in {100 * share:.0f} % of what camera and projector both see; most is missing on the "
            f"{told} side of the camera's picture",
            "Hold the board there too: lens distortion is known only where it was seen.",
        )
    ]


def _apart(calibration: Calibration, used: list[PoseResult]) -> list[list[int]]:
    """Groups of poses that lie on each other, as the camera sees the corners of the board."""
    points = calibration.data.points
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    corners = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    limit = _SAME_POSE * calibration.rig.camera.size[0]
    views = [calibration.rig.camera.project(corners @ pose.rotation.T + pose.translation) for pose in used]
    groups: list[list[int]] = []
    for i, view in enumerate(views):
        for group in groups:
            if np.nanmax(np.abs(views[group[0]] - view)) < limit:
                group.append(i)
                break
        else:
            groups.append([i])
    return groups
