"""Ideal frames: fringes of two paths and Gaussian noise, without a scene, optics or a camera.

``I = A + B cos(2πf u + φ_n) + α [A + B cos(2πf (u + Δu) + φ_n)] + noise``, as Optics Express 27(20) 28293 simulates in
its Figs. 22 and 23, with A = B = 80 DN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel
from scanner.interreflection import (
    MOST_EVIDENCE,
    detect,
    detect_pooled,
    misfit_statistic,
    modulation_variation,
    variation_statistic,
)
from scanner.patterns import Axis, Plan, phase_steps
from scanner.phasors import AxisPhasors, RoundPhasors
from scanner.pooling import one_path_residuals, pool
from scanner.unwrapping import Coordinates, unwrap

Floats = NDArray[np.float64]

MEAN_DN = AMPLITUDE_DN = 80.0

_BLACK_DN = 400.0
"""Black level of the frames: strong noise must not be cut off at 0."""

_JOINED = 5
"""Side of the square over which the pooled score is averaged, px: small beside a region, for its border's sake."""

DETECTORS = ("variation", "misfit", "pooled")


@dataclass(frozen=True)
class IdealScene:
    """Two paths of every pixel, arrays (H, W).

    Parameters
    ----------
    direct
        u of the direct path by axis, px.
    delta
        Δu by axis: from the direct path to the bounce, px.
    alpha
        Amplitude ratio of the bounce; 0 where there is none.
    """

    direct: Mapping[Axis, Floats]
    delta: Mapping[Axis, Floats]
    alpha: Floats

    @property
    def region(self) -> NDArray[np.bool_]:
        """bool, pixels with a bounce."""
        return np.asarray(self.alpha > 0)

    @property
    def distance(self) -> Floats:
        """|Δu| of the axis where it is larger, px."""
        return np.asarray(np.max([np.abs(d) for d in self.delta.values()], axis=0))


@dataclass(frozen=True)
class Judgement:
    """One detector on one scene.

    Parameters
    ----------
    score
        (H, W) larger where a bounce is likelier; what a threshold would cut.
    region
        (H, W) bool, what the detector says at its false-alarm rate.
    beyond
        (H, W) bool, pixels beyond the detector's threshold before labelling: of clean ones, the false-alarm rate.
    """

    score: NDArray[np.float32]
    region: NDArray[np.bool_]
    beyond: NDArray[np.bool_]


@dataclass(frozen=True)
class Observed:
    """Phasors and one-path fits of ideal frames."""

    phasors: list[AxisPhasors]
    sigma_z: list[NDArray[np.float32]]
    coordinates: list[Coordinates]

    def judge(self, detector: str, false_alarm_rate: float) -> Judgement:
        """Ask one of `DETECTORS`."""
        usable = np.ones(self.sigma_z[0].shape, bool)
        one = [np.ones(len(p.frequency)) for p in self.phasors]
        statistic, dof = misfit_statistic(self.coordinates)
        if detector == "pooled":
            residuals = [
                one_path_residuals(p, c, s, g, usable)
                for p, c, s, g in zip(self.phasors, self.coordinates, self.sigma_z, one, strict=True)
            ]
            found = detect_pooled(residuals, statistic, dof, self.coordinates, usable, false_alarm_rate)
            pooled = pool(residuals, statistic, dof, usable, false_alarm_rate, found.excess_noise)
            # What the labelling joins over a region, joined over a small square: a score without a threshold.
            joined = cv2.blur(np.clip(pooled.evidence, -MOST_EVIDENCE, MOST_EVIDENCE), (_JOINED, _JOINED))
            return Judgement(np.asarray(joined, np.float32), found.region, pooled.detected)
        if detector == "variation":
            variations = [modulation_variation(p, g) for p, g in zip(self.phasors, one, strict=True)]
            statistic, dof = variation_statistic(variations, self.sigma_z, [len(g) for g in one])
        found = detect(statistic, dof, self.coordinates, usable, false_alarm_rate)
        return Judgement(found.statistic, found.region, found.statistic > found.threshold)


def observe(
    scene: IdealScene,
    frequencies: Mapping[Axis, Sequence[float]],
    steps: int,
    sigma_dn: float,
    rng: np.random.Generator,
    size: tuple[int, int] = (1280, 800),
) -> Observed:
    """Frames of a plan, rounded to whole DN, and what the first round makes of them."""
    shape = scene.alpha.shape
    sequences = tuple(phase_steps(a, f, steps) for a, fs in frequencies.items() for f in fs)
    plan = Plan(size, sequences)
    collected = RoundPhasors(plan, FrameFormat(shape[1], shape[0], 12))
    for number, sequence in enumerate(sequences):
        frequency, axis = sequence.fringes[0].frequency, sequence.axis
        u = scene.direct[axis]
        first, second = 2 * np.pi * frequency * u, 2 * np.pi * frequency * (u + scene.delta[axis])
        frames = np.empty((steps, *shape), np.uint16)
        for frame, step in zip(frames, sequence.steps_rad, strict=True):
            light = MEAN_DN * (1 + scene.alpha) + AMPLITUDE_DN * (
                np.cos(first + step) + scene.alpha * np.cos(second + step)
            )
            frame[:] = np.rint(_BLACK_DN + light + sigma_dn * rng.standard_normal(shape, np.float32))
        collected.add(number, frames)
    noise = NoiseModel(float(np.sqrt(sigma_dn**2 + 1 / 12)))
    phasors = [p for p in (collected.axis(a) for a in plan.axes) if p is not None]
    sigma_z = [p.sigma_z(noise, collected.mean) for p in phasors]
    coordinates = [unwrap(p, s, plan.extent(p.axis)) for p, s in zip(phasors, sigma_z, strict=True)]
    return Observed(phasors, sigma_z, coordinates)


def curved_scene(shape: tuple[int, int], alpha: float, rng: np.random.Generator, axes: Sequence[Axis]) -> IdealScene:
    """One region with a curved border and a corner; Δu runs through its whole range along x, 0 and 640 px included.

    Along y, where asked for, Δu is small and runs through 0 as well.
    """
    height, width = shape
    row, column = np.mgrid[0:height, 0:width].astype(float)
    y, x = (row - 0.5 * height) / (0.38 * height), (column - 0.52 * width) / (0.36 * width)
    turn = rng.uniform(0, 2 * np.pi)
    inside = np.hypot(y, x) < 1 + 0.12 * np.cos(3 * np.arctan2(y, x) + turn)
    inside &= ~((row > rng.uniform(0.58, 0.7) * height) & (column > rng.uniform(0.58, 0.7) * width))
    along = 740 - 840 * (column / width - 0.14) / 0.76 + rng.uniform(0.5, 1.2) * (row - 0.5 * height) * 300 / height
    direct: dict[Axis, Floats] = {"x": 60 + 720 * column / width + 15 * row / height, "y": 100 + 540 * row / height}
    delta: dict[Axis, Floats] = {"x": along, "y": 90 * (column / width - 0.5) - 200 * (row / height - 0.4)}
    return IdealScene({a: direct[a] for a in axes}, {a: delta[a] for a in axes}, np.where(inside, alpha, 0.0))


def disc_scene(
    shape: tuple[int, int], alpha: float, delta_px: float, radius_px: float, axes: Sequence[Axis]
) -> IdealScene:
    """A disc whose bounce has the same Δu everywhere, along every axis."""
    height, width = shape
    row, column = np.mgrid[0:height, 0:width].astype(float)
    inside = np.hypot(row - (height - 1) / 2, column - (width - 1) / 2) < radius_px
    direct: dict[Axis, Floats] = {"x": 60 + 1.7 * column + 0.1 * row, "y": 40 + 1.7 * row}
    constant = np.full(shape, delta_px)
    return IdealScene({a: direct[a] for a in axes}, dict.fromkeys(axes, constant), np.where(inside, alpha, 0.0))


def tiled_scene(
    tiles: int,
    side_px: int,
    alpha: tuple[float, float],
    delta_px: tuple[float, float],
    rng: np.random.Generator,
    axes: Sequence[Axis] = ("x", "y"),
) -> IdealScene:
    """Draw ``tiles`` x ``tiles`` squares, every other one with a bounce of random α, Δu, direction and slope of Δu."""
    height = width = tiles * side_px
    row, column = np.mgrid[0:height, 0:width].astype(float)
    amplitude = np.zeros((height, width))
    delta: dict[Axis, Floats] = {a: np.zeros((height, width)) for a in axes}
    for i in range(tiles):
        for j in range(tiles):
            if (i + j) % 2:
                continue
            part = slice(i * side_px, (i + 1) * side_px), slice(j * side_px, (j + 1) * side_px)
            amplitude[part] = rng.uniform(*alpha)
            towards = rng.uniform(0, 2 * np.pi)
            length = rng.uniform(*delta_px)
            for axis, share in zip(axes, (np.cos(towards), np.sin(towards)), strict=False):
                slope = rng.uniform(-2, 2, 2)
                middle = (i + 0.5) * side_px, (j + 0.5) * side_px
                # A single axis takes the whole distance.
                along = length if len(axes) == 1 else length * share
                delta[axis][part] = along + slope[0] * (row[part] - middle[0]) + slope[1] * (column[part] - middle[1])
    direct: dict[Axis, Floats] = {"x": 300 + 1.3 * column + 0.1 * row, "y": 150 + 1.2 * row}
    return IdealScene({a: direct[a] for a in axes}, delta, amplitude)
