"""Where the board has been, and where to hold it next."""

from calibration.planning.coverage import coverage
from calibration.planning.poses import placed, pose_of
from calibration.planning.suggestion import (
    GOOD_BASELINE,
    GOOD_CENTRE_PX,
    GOOD_FOCAL,
    Suggestion,
    first_poses,
    grid,
    next_pose,
)

__all__ = [
    "GOOD_BASELINE",
    "GOOD_CENTRE_PX",
    "GOOD_FOCAL",
    "Suggestion",
    "coverage",
    "first_poses",
    "grid",
    "next_pose",
    "placed",
    "pose_of",
]
