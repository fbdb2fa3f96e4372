"""The unknowns of a calibration: their names, which of them are free, and what little is known beforehand.

All models share one vector of globals. A `Freedom` says which of its entries move and how: an entry may be fixed, free,
or tied to another (fy to fx where pixels are taken as square).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from scanner.rig import Lens

Array = NDArray[np.float64]

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Distortion terms in the order of OpenCV."""

_LENS = ("fx", "fy", "cx", "cy", *DISTORTION)

NAMES: tuple[str, ...] = (
    *(f"camera.{name}" for name in _LENS),
    *(f"projector.{name}" for name in _LENS),
    "rotation.x",
    "rotation.y",
    "rotation.z",
    "translation.x",
    "translation.y",
    "translation.z",
    "board.bend_xx",
    "board.bend_yy",
    "board.bend_xy",
    "board.aspect",
)
"""Names of all globals. Lens: px and OpenCV's terms. rotation: rad, small turns about the projector's axes.
translation: mm. bend: mm at half the board's extent. aspect: board's height per width, less one."""

INDEX = {name: i for i, name in enumerate(NAMES)}
CAMERA, PROJECTOR = slice(0, 18), slice(18, 36)
ROTATION, TRANSLATION = slice(36, 39), slice(39, 42)
BEND, ASPECT = slice(42, 45), 45

GROUPS: dict[str, tuple[str, ...]] = {
    "k1": ("k1",),
    "k2": ("k2",),
    "p1p2": ("p1", "p2"),
    "k3": ("k3",),
    "rational": ("k4", "k5", "k6"),
    "prism": ("s1", "s2", "s3", "s4"),
    "tilt": ("tau_x", "tau_y"),
}
"""Distortion terms that enter together."""

_LOOSE = {"k1": 1.0, "k2": 5.0, "k3": 20.0, "p1": 0.05, "p2": 0.05, "tau_x": 0.3, "tau_y": 0.3}


@dataclass(frozen=True, eq=False)
class State:
    """Where an adjustment stands.

    Parameters
    ----------
    values
        (46,) the globals in the order of `NAMES`; the three of the rotation are a Rodrigues vector.
    turns, shifts
        (m, 3, 3) and (m, 3): X_cam = R X_board + t of every pose, mm.
    board
        (k, 3) mm by which the board's points lie beside where its definition has them.
    """

    values: Array
    turns: Array
    shifts: Array
    board: Array

    @property
    def rotation(self) -> Array:
        """(3, 3) from the camera's into the projector's frame."""
        return np.asarray(cv2.Rodrigues(self.values[ROTATION])[0], np.float64)

    def moved(self, globals_step: Array, pose_steps: Array, board_step: Array | float = 0.0) -> State:
        """State after steps (46,) of the globals, (m, 6) of the poses (turned from the left), (k, 3) of the board."""
        values = self.values + globals_step
        values[ROTATION] = cv2.Rodrigues(cv2.Rodrigues(globals_step[ROTATION])[0] @ self.rotation)[0][:, 0]
        turns = np.stack([cv2.Rodrigues(step[:3])[0] @ turn for step, turn in zip(pose_steps, self.turns, strict=True)])
        return State(values, turns, self.shifts + pose_steps[:, 3:], self.board + board_step)

    def lens(self, part: slice, size: tuple[int, int]) -> Lens:
        """The lens in ``part`` (`CAMERA` or `PROJECTOR`) of the globals."""
        fx, fy, cx, cy = self.values[part][:4]
        distortion = self.values[part][4:]
        last = int(np.flatnonzero(distortion)[-1]) + 1 if distortion.any() else 0
        count = next(n for n in (0, 4, 5, 8, 12, 14) if n >= last)
        return Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion[:count], size)


@dataclass(frozen=True, eq=False)
class Freedom:
    """Which globals are estimated.

    Parameters
    ----------
    names
        (q,) of the free parameters.
    spread
        (46, q): a step of the free parameters, spread to the globals.
    prior
        (46,) precision 1/σ² of what is known beforehand.
    prior_mean
        (46,).
    board_prior
        Precision 1/σ² (1/mm²) of each coordinate of the board's points; None where they are taken as exact.
    """

    names: tuple[str, ...]
    spread: Array
    prior: Array
    prior_mean: Array
    board_prior: float | None = None


def freedom(free: Sequence[str], tied: dict[str, str], prior: Array, prior_mean: Array) -> Freedom:
    """Free the parameters ``free``, and let every key of ``tied`` move with its (free) value.

    Raises
    ------
    KeyError
        A name that is none of `NAMES`.
    """
    spread = np.zeros((len(NAMES), len(free)))
    for column, name in enumerate(free):
        spread[INDEX[name], column] = 1.0
    for name, leader in tied.items():
        spread[INDEX[name]] = spread[INDEX[leader]]
    return Freedom(tuple(free), spread, prior, prior_mean)


def lens_names(lens: str, groups: Sequence[str]) -> list[str]:
    """Names of the distortion terms of ``lens`` ("camera" or "projector") in the given `GROUPS`."""
    return [f"{lens}.{term}" for group in groups for term in GROUPS[group]]


def weak_priors(start: State, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> tuple[Array, Array]:
    """Precision and mean (46,) of priors that no good set feels, and that keep a degenerate one from running away.

    A focal length is known to its own size, a principal point to the picture's width, a distortion term to what no
    lens exceeds, a translation to metres; compared with what ten poses tell, that is 1e-7 of the information.
    """
    sigma = np.full(len(NAMES), math.inf)
    mean = np.zeros(len(NAMES))
    for part, size in ((CAMERA, camera_size), (PROJECTOR, projector_size)):
        first = part.start
        mean[first : first + 4] = start.values[first : first + 4]
        mean[first + 2 : first + 4] = (np.array(size) - 1) / 2
        sigma[first : first + 2] = start.values[first]
        sigma[first + 2 : first + 4] = size[0]
        sigma[first + 4 : first + 18] = [_LOOSE.get(term, 1.0) for term in DISTORTION]
    sigma[TRANSLATION] = 1e4
    sigma[BEND] = 10.0
    sigma[ASPECT] = 1.0
    return sigma**-2.0, mean
