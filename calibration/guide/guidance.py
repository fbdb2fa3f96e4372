"""What a person who calibrates is to see and to do at one moment."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from calibration.observations import BoardView
from drivers import FrameFormat, Pixels
from scanner.preview.measures import Reading

Array = NDArray[np.float64]

Step = Literal["focus", "exposure", "latency", "response", "geometry", "acceptance"]
STEPS: tuple[Step, ...] = get_args(Step)

Nearness = Literal["unseen", "far", "near", "there"]

NEAR_SHARE, THERE_SHARE = 0.25, 0.06
"""RMS distance of the sheet's corners from the wanted ones, by the wanted sheet's diagonal, that is near and there."""

THERE_DEG = 8.0
"""Difference from the wanted tilt that is no reason to go on turning, °."""

MAX_SATURATED_SHARE = 0.002
"""Share of saturated pixels from which a picture is called too bright: glints may be, paper may not."""

_SHIFT_SHARE = 0.03
_SIZE_SHARE = 0.08
_ROLL_DEG = 6.0


@dataclass(frozen=True)
class Bar:
    """One figure as a bar, full where all that is wanted is reached.

    Parameters
    ----------
    label
        What it is, such as ``focal length of the camera``.
    share
        How much of what is wanted is there; 1 and more is enough, NaN shows the figure without a bar.
    good
        Whether that will do.
    text
        The figure itself, such as ``± 0.08 %, wanted 0.03 %``.
    """

    label: str
    share: float
    good: bool
    text: str


@dataclass(frozen=True, eq=False)
class Curve:
    """Measured points of one quantity against another.

    Parameters
    ----------
    title
        What is plotted.
    x, y
        (n,) the points; NaN leaves one out.
    x_label, y_label
        Quantities with their units.
    fitted
        (n,) model at ``x``, drawn as a line; None for a line through the points.
    """

    title: str
    x: Array
    y: Array
    x_label: str
    y_label: str
    fitted: Array | None = None


def _none(columns: int) -> Array:
    return np.empty((0, columns))


@dataclass(frozen=True, eq=False)
class Guidance:
    """All that the operator's screen shows at one moment; what a step has no use for is left out.

    Parameters
    ----------
    step
        Which of the wizard's steps.
    title
        Where in the step, such as ``pose 4 of 10``.
    instruction
        What the person does now, in one sentence; it is written large.
    frame, frame_format
        (H, W) newest picture of the camera, and what its grey values mean.
    simulated
        Stamp it so.
    view
        The board as it is found in ``frame``; None where it is not.
    board_wanted
        Say on the picture whether the board is seen; by itself where a target is given.
    target, outline
        (k, 2) camera px, outline of the sheet where it is to be held and as it is held now, in the same order,
        clockwise from the print's upper left corner.
    seen
        (m, 2) camera px, the points of all earlier poses.
    tilts, held_tilt, wanted_tilt
        (p, 2) yaw and pitch (°, as in `calibration.observations.BoardPose`) of earlier poses, of the board now, and
        where the next one is wanted.
    distances_mm, held_distance_mm, wanted_distance_mm
        (p,) distances (mm) of earlier poses, of the board now, and the wanted one.
    depth_range_mm
        Nearest and farthest distance of the working volume, mm; None takes what the poses span.
    bars
        Figures on the way to what is wanted.
    reading
        Brightness and focus of ``frame``.
    max_saturated_share
        Share of saturated pixels that is too much.
    zone
        Rows and columns of ``frame`` to be magnified; None for no magnifier.
    curve
        What the step measures.
    hints
        Warnings, each with what to do.
    keys
        Key and what it does, such as ``("space", "take it")``.
    """

    step: Step
    title: str
    instruction: str
    frame: Pixels
    frame_format: FrameFormat
    simulated: bool
    view: BoardView | None = None
    board_wanted: bool | None = None
    target: Array | None = None
    outline: Array | None = None
    seen: Array = field(default_factory=lambda: _none(2))
    tilts: Array = field(default_factory=lambda: _none(2))
    held_tilt: tuple[float, float] | None = None
    wanted_tilt: tuple[float, float] | None = None
    distances_mm: Array = field(default_factory=lambda: np.empty(0))
    held_distance_mm: float | None = None
    wanted_distance_mm: float | None = None
    depth_range_mm: tuple[float, float] | None = None
    bars: tuple[Bar, ...] = ()
    reading: Reading | None = None
    max_saturated_share: float = MAX_SATURATED_SHARE
    zone: tuple[slice, slice] | None = None
    curve: Curve | None = None
    hints: tuple[str, ...] = ()
    keys: tuple[tuple[str, str], ...] = ()

    @property
    def is_about_board(self) -> bool:
        """Whether the picture says if the board is seen."""
        return self.target is not None if self.board_wanted is None else self.board_wanted

    @property
    def is_about_poses(self) -> bool:
        """Whether there are poses to map."""
        return self.wanted_tilt is not None or self.wanted_distance_mm is not None or len(self.tilts) > 0

    @property
    def nearness(self) -> Nearness:
        """How near the board is to where it is wanted: there where nothing is wanted of it but to be seen."""
        if self.view is None and self.outline is None:
            return "unseen"
        if self.target is None:
            return "there"
        if self.outline is None:
            return "far"
        share = offset_share(self.outline, self.target)
        if share > NEAR_SHARE:
            return "far"
        return "there" if share <= THERE_SHARE and self._tilt_to_go <= THERE_DEG else "near"

    @property
    def _tilt_to_go(self) -> float:
        if self.held_tilt is None or self.wanted_tilt is None:
            return 0.0
        return math.hypot(self.wanted_tilt[0] - self.held_tilt[0], self.wanted_tilt[1] - self.held_tilt[1])

    @property
    def moves(self) -> tuple[str, ...]:
        """What is left to do from where the board is held to where it is wanted, in words: the three largest moves.

        Left and right are the picture's; a front turns to the left, right, up or down of the picture.
        """
        found: list[tuple[float, str]] = []
        if self.outline is not None and self.target is not None:
            now, wanted = (_as_complex(corners) for corners in (self.outline, self.target))
            shift = complex(wanted.mean() - now.mean())
            width, height = self.frame_format.width, self.frame_format.height
            found += _word(shift.real / width, _SHIFT_SHARE, "left", "right", " {:.0f} %", 100)
            found += _word(shift.imag / height, _SHIFT_SHARE, "up", "down", " {:.0f} %", 100)
            now, wanted = now - now.mean(), wanted - wanted.mean()
            found += _word(float(np.std(wanted) / np.std(now)) - 1, _SIZE_SHARE, "farther", "nearer")
            roll = math.degrees(np.angle(np.vdot(now, wanted)))
            found += _word(roll, _ROLL_DEG, "turn anticlockwise", "turn clockwise", " {:.0f}°")
        if self.held_tilt is not None and self.wanted_tilt is not None:
            yaw, pitch = (wanted - held for wanted, held in zip(self.wanted_tilt, self.held_tilt, strict=True))
            found += _word(yaw, THERE_DEG, "front to the right", "front to the left", " {:.0f}°")
            found += _word(pitch, THERE_DEG, "front up", "front down", " {:.0f}°")
        return tuple(word for _, word in sorted(found, reverse=True)[:3])


def offset_share(outline: Array, target: Array) -> float:
    """RMS distance of corresponding corners as a share of the target's largest diagonal.

    Parameters
    ----------
    outline, target
        (k, 2) px, in the same order.
    """
    diagonal = np.linalg.norm(target[:, None] - target[None], axis=2).max()
    return float(np.sqrt(((outline - target) ** 2).sum(axis=1).mean()) / diagonal)


def coverage(seen: Array, frame_format: FrameFormat, cells: tuple[int, int]) -> NDArray[np.int64]:
    """How many points fell into each cell of the picture.

    Parameters
    ----------
    seen
        (m, 2) camera px; pixel centres at integers.
    frame_format
        Of the picture.
    cells
        Number of cells (across, down).

    Returns
    -------
    NDArray
        (down, across) counts; points outside the picture are in none.
    """
    edges = tuple(np.linspace(-0.5, extent - 0.5, n + 1) for extent, n in zip(_size(frame_format), cells, strict=True))
    counts, _, _ = np.histogram2d(seen[:, 1], seen[:, 0], bins=(edges[1], edges[0]))
    return counts.astype(np.int64)


def _size(frame_format: FrameFormat) -> tuple[int, int]:
    return frame_format.width, frame_format.height


def _as_complex(corners: Array) -> NDArray[np.complex128]:
    return corners[:, 0] + 1j * corners[:, 1]


def _word(
    amount: float, least: float, negative: str, positive: str, figure: str = "", scale: float = 1.0
) -> list[tuple[float, str]]:
    """How many times the least amount worth a word this is, and the word; nothing below."""
    if abs(amount) < least:
        return []
    return [(abs(amount) / least, (positive if amount > 0 else negative) + figure.format(scale * abs(amount)))]
