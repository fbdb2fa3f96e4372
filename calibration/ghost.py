"""Where the board is to be held, is held, and was held before, for the live picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.folder import CalibrationFolder
from calibration.guide.guidance import Guidance
from calibration.observations import BoardPose
from calibration.planning import placed, pose_of
from calibration.planning.glimpse import guessed_lens, held, outline
from calibration.settings import CalibrationSettings
from scanner.rig import Lens

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ghost:
    """Poses by a lens that is known, or guessed from the first of them: enough to lead a hand.

    Parameters
    ----------
    lens
        The camera's; None where not even a guess can be made.
    board
        What is held.
    seen
        (m, 2) camera px, its points in all earlier poses.
    poses
        These.
    depth_range_mm
        Nearest and farthest distance of the working volume, mm.
    """

    lens: Lens | None
    board: Board
    seen: Array
    poses: tuple[BoardPose, ...]
    depth_range_mm: tuple[float, float]

    @classmethod
    def of(
        cls,
        settings: CalibrationSettings,
        folder: CalibrationFolder,
        board: Board,
        size: tuple[int, int],
        lens: Lens | None,
    ) -> Ghost:
        """Of the poses that the folder holds."""
        geometry, taken = settings.geometry, folder.poses()
        depths = geometry.nearest_mm, geometry.farthest_mm
        if lens is None and taken:
            lens = guessed_lens(taken[0].points_board, taken[0].camera, sum(depths) / 2, size)
        if lens is None:
            return cls(None, board, np.empty((0, 2)), (), depths)
        poses = tuple(pose_of(*held(lens, p.points_board, p.camera)) for p in taken)
        return cls(lens, board, np.concatenate([np.empty((0, 2)), *(p.camera for p in taken)]), poses, depths)

    def shown(self, plain: Guidance, wanted: BoardPose) -> Guidance:
        """The guidance with target, outline and maps."""
        if self.lens is None:
            return plain
        size, view, here, now = self.board.size_mm, plain.view, None, None
        if view is not None:
            here = held(self.lens, self.board.points[view.ids], view.xy)
            now = pose_of(*here)
        return replace(
            plain,
            target=outline(self.lens, size, *placed(wanted)),
            outline=None if here is None else outline(self.lens, size, *here),
            seen=self.seen,
            tilts=np.array([(p.yaw_deg, p.pitch_deg) for p in self.poses]).reshape(-1, 2),
            held_tilt=None if now is None else (now.yaw_deg, now.pitch_deg),
            wanted_tilt=(wanted.yaw_deg, wanted.pitch_deg),
            distances_mm=np.array([p.distance_mm for p in self.poses]),
            held_distance_mm=None if now is None else now.distance_mm,
            wanted_distance_mm=wanted.distance_mm,
            depth_range_mm=self.depth_range_mm,
        )
