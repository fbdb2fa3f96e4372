"""What a scan ends with: the maps of every pixel, the figures about them, and the result folder on disk."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import Pixels


class Flag(IntFlag):
    """Why a pixel is as it is; any number may be set. Pixels with NaN coordinates carry at least one of them."""

    LOW_MODULATION = 1
    """Too little fringe modulation for the noise: shadow, black surface, background."""
    SATURATED = 2
    """At least one frame of the pixel is at full scale."""
    INTERREFLECTION = 4
    """A bounce was detected here in round one."""
    DEPTH_EDGE = 8
    """The pixel mixes two surfaces at a depth edge."""
    SECOND_ROUND = 16
    """The coordinate was measured in round two."""
    SEPARATED = 32
    """The coordinate comes from the two-path separation of round one."""
    MISFIT = 64
    """The coordinate was refused: the fringes of this pixel do not fit one path."""
    OFF_EPIPOLAR = 128
    """The (x, y) pair was refused: it does not lie on the pixel's epipolar line."""
    OUT_OF_VOLUME = 256
    """The coordinate lies outside the projector picture, or the point is not in front of the rig."""
    NOT_LIT = 512
    """Round two did not light this pixel's place, or cut its fringes."""
    INCOMPLETE = 1024
    """The recording ended before this pixel could be decided."""
    THIRD_PATH = 2048
    """Round one shows more than two light paths here: neither one nor two fit its fringes."""
    RIPPLE = 4096
    """A weak bounce that only the neighbourhood shows was taken off the coordinate."""
    STRAY = 8192
    """The coordinate was refused: hardly any neighbour goes on with it."""
    BLIND = 16384
    """The coordinate was refused: between a fold and bounces from across it, too near for fringes to show them."""


@dataclass(frozen=True)
class Maps:
    """Per-pixel results; all arrays (H, W) of the camera unless said otherwise; invalid is NaN plus a flag.

    Parameters
    ----------
    x_p, y_p
        Projector column and row, px, float32; None where the axis was not projected.
    sigma_x, sigma_y
        Predicted standard deviation of x_p and y_p, px.
    modulation
        Fringe modulation B of round one, DN.
    brightness
        Mean grey value A of round one, DN.
    variation
        Paper's B_v, the standard deviation of the modulation over the frequencies, DN; None with fewer than two.
    misfit, misfit_dof
        χ² per degree of freedom of the one-path fit, over all axes, and how many degrees of freedom that are.
    interreflection
        bool, the detected region.
    score
        The statistic that the detection compares with its threshold, larger where a bounce is likelier; None for
        methods that detect none.
    flags
        uint16, `Flag`.
    depth
        mm along the camera's z.
    points
        (H, W, 3) mm in the camera frame.
    sigma_point
        Predicted standard deviation along the viewing ray from noise, mm.
    sigma_rig
        The same from the rig's own uncertainty, common to neighbours and to all scans; None where it states none.
    epipolar_px
        Distance of (x_p, y_p) from the pixel's epipolar line, px; None with one axis.
    x_p_round1, y_p_round1, misfit_round2
        Coordinates of round one and misfit of round two; None for methods of one round.
    lit
        (projector height, projector width) bool, what any regional sequence lit.
    lit_by
        (projector height, projector width) uint8, bit k - 1 set where regional sequence k lit.
    sequence
        uint8, the regional sequence that measured the pixel, 0 for none.
    regional_pattern
        uint8 or uint16 frame of round two, for the report.
    """

    x_p: NDArray[np.float32] | None
    y_p: NDArray[np.float32] | None
    sigma_x: NDArray[np.float32] | None
    sigma_y: NDArray[np.float32] | None
    modulation: NDArray[np.float32]
    brightness: NDArray[np.float32]
    variation: NDArray[np.float32] | None
    misfit: NDArray[np.float32]
    interreflection: NDArray[np.bool_]
    flags: NDArray[np.uint16]
    misfit_dof: int = 0
    depth: NDArray[np.float32] | None = None
    points: NDArray[np.float32] | None = None
    sigma_point: NDArray[np.float32] | None = None
    sigma_rig: NDArray[np.float32] | None = None
    epipolar_px: NDArray[np.float32] | None = None
    x_p_round1: NDArray[np.float32] | None = None
    y_p_round1: NDArray[np.float32] | None = None
    misfit_round2: NDArray[np.float32] | None = None
    lit: NDArray[np.bool_] | None = None
    lit_by: NDArray[np.uint8] | None = None
    sequence: NDArray[np.uint8] | None = None
    regional_pattern: Pixels | None = None
    score: NDArray[np.float32] | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W) bool, pixels with a coordinate on every measured axis."""
        ok = np.ones(self.flags.shape, bool)
        for u in (self.x_p, self.y_p):
            if u is not None:
                ok &= np.isfinite(u)
        return ok


@dataclass(frozen=True)
class ScanResult:
    """Maps and figures of one scan.

    Parameters
    ----------
    method
        Name of the method.
    simulated
        True where the frames were simulated; everything written is stamped with it.
    maps
        Per-pixel results.
    summary
        JSON-ready: ``counts`` {name: pixels}, ``frames``, ``timings_s`` {stage: seconds}, ``quality`` {name: figure},
        ``gates`` [{name, value, limit, passed, meaning}], ``noise`` {read_dn,
        dn_per_electron}, ``versions`` {package: version}.
    warnings
        Sentences for the operator.
    """

    method: str
    simulated: bool
    maps: Maps
    summary: dict[str, Any]
    warnings: list[str] = field(default_factory=list)
