"""Phase shifting with Qi's check: what does not lie on its pixel's epipolar line is an invalid point.

Both axes are measured by temporal phase shifting. The pair (x_p, y_p) of a pixel that sees one path lies on the
epipolar line that the rig draws for the pixel; a second path pulls it off, unless it pulls along the line. The distance
is the statistic (Qi et al.'s removal of invalid points, reference 16 of Opt. Express 27, 28293, which compares with it
in Fig. 24). No pattern is added, and nothing is put in an invalid point's place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from drivers import FrameFormat
from scanner.config import ScanSection
from scanner.methods.base import FirstRound, OneRound, PlanError, RoundFrames, Setup, refuse_off_epipolar
from scanner.methods.multi_frequency import decode_axes, one_path_maps, temporal_phase_shifting
from scanner.patterns import Plan
from scanner.phasors import RoundPhasors
from scanner.result import Flag, Maps
from scanner.triangulation import triangulate


@dataclass(frozen=True)
class EpipolarCheck(OneRound):
    """TPS on both axes, invalid points taken out by their distance from the epipolar line; one round."""

    name: str = "epipolar"
    title: str = "Temporal phase shifting with the epipolar check (Qi et al.)"

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """Plan of TPS, both axes.

        Raises
        ------
        PlanError
            One axis only.
        """
        if len(scan.axes) < 2:
            raise PlanError("scan, axes: the epipolar check needs both", "Write axes: [x, y].")
        return temporal_phase_shifting.first_round(scan, size)

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundPhasors:
        """Phasors of the frames."""
        return RoundPhasors(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Coordinates; those off their epipolar line are the detected region.

        Raises
        ------
        PlanError
            No rig, or an axis cannot be told.
        """
        assert isinstance(frames, RoundPhasors)
        decoded = decode_axes(frames, setup)
        maps, usable = one_path_maps(frames, decoded, setup)
        if setup.rig is None or len(decoded) < 2:
            raise PlanError("the epipolar check needs a rig and both axes", "Name a calibrated rig, or use tps.")
        x, y = (decoded[a].coordinates for a in ("x", "y"))
        found = triangulate(setup.rig, x.u, x.sigma, y.u, y.sigma)
        assert found.epipolar_sigmas is not None
        distance = np.where(usable, np.abs(found.epipolar_sigmas), np.float32(np.nan))
        # What the better half of the pixels shows holds the calibration's error too; without one it is the noise.
        spread = max(1.0, float(np.nanmedian(distance)) / float(norm.ppf(0.75))) if usable.any() else 1.0
        limit = float(norm.isf(setup.scan.false_alarm_rate / 2)) * spread
        detected = usable & ~(distance <= limit)
        return FirstRound(refuse_off_epipolar(_without(maps, detected, distance), setup.rig), frames.plan)


def _without(maps: Maps, detected: NDArray[np.bool_], score: NDArray[np.float32]) -> Maps:
    """Take the coordinates of the detected pixels out."""
    flags = maps.flags.copy()
    flags[detected] |= np.uint16(Flag.INTERREFLECTION | Flag.OFF_EPIPOLAR)

    def rest(u: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        return None if u is None else np.where(detected, np.float32(np.nan), u)

    return replace(
        maps,
        x_p=rest(maps.x_p),
        y_p=rest(maps.y_p),
        sigma_x=rest(maps.sigma_x),
        sigma_y=rest(maps.sigma_y),
        interreflection=detected,
        flags=flags,
        score=score,
    )
