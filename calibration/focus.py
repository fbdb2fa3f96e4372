"""Is it in focus, in numbers: the camera by the width of its edges, the projector by the contrast of its fringes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.observations import Finding
from calibration.photometry.mtf import Mtf
from drivers import Pixels

CAMERA_SPOT_PX = 1.2
"""Largest standard deviation of an edge, camera px, that is in focus: 10 to 90 % within 3.1 px."""

FRINGE_CONTRAST = 0.75
"""Least contrast of the finest fringe, over that of an infinitely coarse one, that is in focus."""

_NARROW, _WIDE = 1.0, 2.0
_EDGE = 0.25
_NOISES = 10.0
_FEWEST = 100
_GRADIENT_NOISE = 1 / math.sqrt(8 * math.pi)


@dataclass(frozen=True)
class EdgeBlur:
    """How wide the edges of a frame are.

    Parameters
    ----------
    spot_px
        Median standard deviation of the edges' profiles, camera px, a pixel's own width included.
    low_px, high_px
        Quartiles over the edges.
    edges
        How many edge pixels were looked at.
    """

    spot_px: float
    low_px: float
    high_px: float
    edges: int

    @property
    def width_px(self) -> float:
        """From 10 to 90 % of an edge, px: 2.563 σ of its Gaussian."""
        return 2.563 * self.spot_px


@dataclass(frozen=True)
class Focus:
    """A judgement.

    Parameters
    ----------
    value
        What was measured: standard deviation of an edge (camera px), or contrast of a fringe (0..1).
    limit
        What it must not exceed, or reach.
    in_focus
        Whether it does.
    finding
        What to do, where it does not.
    """

    value: float
    limit: float
    in_focus: bool
    finding: Finding | None


def edge_blur(frame: Pixels, saturated_dn: int, noise_dn: float = 1.5) -> EdgeBlur | None:
    """Width of the edges in a frame, such as those of a chessboard's squares or of projected stripes.

    Parameters
    ----------
    frame
        (H, W) grey values.
    saturated_dn
        Grey value of a saturated pixel; edges beside one are left out, for clipping makes them look sharp.
    noise_dn
        Standard deviation of a grey value; only edges that clearly exceed it count.

    Returns
    -------
    The widths; None where there are fewer than a hundred clear edge pixels.

    Notes
    -----
    Two Gaussian gradients of widths s₁ and s₂ of a step with standard deviation σ have the peak ratio
    R² = (σ² + s₂²)/(σ² + s₁²), hence σ² = (s₂² − R² s₁²)/(R² − 1): the re-blur of Zhuo & Sim, Pattern Recognition 44,
    1852 (2011), with both gradients smoothed, so that noise counts less. The gradient is read at the pixel nearest the
    edge, which makes σ come out up to 0.1 px too wide below 0.8 px and less above.
    """
    grey = frame.astype(np.float32)
    narrow, wide = _gradient(grey, _NARROW), _gradient(grey, _WIDE)
    floor = max(_EDGE * float(np.quantile(narrow[0], 0.995)), _NOISES * noise_dn * _GRADIENT_NOISE / _NARROW**2)
    clear = cv2.erode((frame < saturated_dn).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    row, column = np.nonzero(_ridge(*narrow) & (narrow[0] > floor) & clear)
    strength, reblurred = narrow[0][row, column], wide[0][row, column]
    # An edge that another one is near to, or that bends, loses more by smoothing than a straight single one can.
    squared = np.square(strength / np.maximum(reblurred, 1e-6))
    single = (squared > 1) & (squared < (_WIDE / _NARROW) ** 2)
    if np.count_nonzero(single) < _FEWEST:
        return None
    r2 = squared[single]
    sigma = np.sqrt((_WIDE**2 - r2 * _NARROW**2) / (r2 - 1))
    low, median, high = np.quantile(sigma, [0.25, 0.5, 0.75])
    return EdgeBlur(float(median), float(low), float(high), int(r2.size))


def camera_focus(blur: EdgeBlur, limit_px: float = CAMERA_SPOT_PX) -> Focus:
    """Judge the camera's focus by the edges of something with sharp ones, such as a printed board.

    Parameters
    ----------
    blur
        Of such a frame.
    limit_px
        Largest standard deviation of an edge, camera px.
    """
    sharp = blur.spot_px <= limit_px
    finding = Finding(
        "camera_out_of_focus",
        blur.spot_px > 2 * limit_px,
        f"edges are {blur.width_px:.1f} px wide (10 to 90 %), at most {2.563 * limit_px:.1f} px are sharp",
        "Turn the camera's focus ring until the width is least, then lock it; close the aperture by a stop.",
    )
    return Focus(blur.spot_px, limit_px, sharp, None if sharp else finding)


def projector_focus(mtf: Mtf, frequency: float = 1 / 16, limit: float = FRINGE_CONTRAST) -> Focus:
    """Judge the projector's focus by the contrast of the finest fringe that is scanned with.

    Parameters
    ----------
    mtf
        Of projector and camera together, on a plain board at the working distance, the camera in focus.
    frequency
        Of that fringe, 1/px.
    limit
        Least contrast.
    """
    contrast = float(mtf.at(frequency))
    sharp = contrast >= limit
    finding = Finding(
        "projector_out_of_focus",
        contrast < limit / 2,
        f"fringes of {1 / frequency:.3g} px keep {100 * contrast:.0f} % of their contrast, expected"
        f" {100 * limit:.0f} % or more (spot of {mtf.spot_px:.1f} projector px)",
        "Turn the projector's focus until the contrast is largest, at the distance where the object will stand; then"
        " check the camera's.",
    )
    return Focus(contrast, limit, sharp, None if sharp else finding)


Floats = NDArray[np.float32]


def _gradient(grey: Floats, sigma: float) -> tuple[Floats, Floats, Floats]:
    """Magnitude, x and y of the gradient after a Gaussian of ``sigma``, sampled from its derivative."""
    reach = math.ceil(5 * sigma)
    t = np.arange(-reach, reach + 1)
    bell = np.exp(-(t**2) / (2 * sigma**2))
    smooth = (bell / bell.sum()).astype(np.float32)
    # OpenCV correlates, so that this is the derivative and not its negative.
    slope = (t * bell / (t**2 * bell).sum()).astype(np.float32)
    x = np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, slope, smooth), np.float32)
    y = np.asarray(cv2.sepFilter2D(grey, cv2.CV_32F, smooth, slope), np.float32)
    return np.asarray(np.hypot(x, y), np.float32), x, y


def _ridge(magnitude: Floats, x: Floats, y: Floats) -> NDArray[np.bool_]:
    """Pixels where the gradient is largest along its own direction, which is where an edge is."""
    steps = np.where(np.abs(x) >= np.abs(y), np.abs(y) < 0.4142 * np.abs(x), np.abs(x) < 0.4142 * np.abs(y))
    across = np.abs(x) >= np.abs(y)
    same = x * y > 0
    ridge = np.zeros(magnitude.shape, bool)
    inner = magnitude[1:-1, 1:-1]
    for chosen, dr, dc in (
        (steps & across, 0, 1),
        (steps & ~across, 1, 0),
        (~steps & same, 1, 1),
        (~steps & ~same, 1, -1),
    ):
        h, w = magnitude.shape
        ahead = magnitude[1 + dr : h - 1 + dr, 1 + dc : w - 1 + dc]
        behind = magnitude[1 - dr : h - 1 - dr, 1 - dc : w - 1 - dc]
        ridge[1:-1, 1:-1] |= chosen[1:-1, 1:-1] & (inner >= ahead) & (inner > behind)
    return ridge
