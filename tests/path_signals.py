"""Phasors of pixels that see two paths, on the simulated bench's rig, with nothing rendered: the truth is exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.paths import AxisPhasorsOf
from scanner.rig import Rig
from sim_backend.settings import SimulatedSettings

EXTENT = {"x": 1280, "y": 800}
FREQUENCY = (80 + np.arange(9)) / 1280
B, STEPS = 80.0, 12


@dataclass(frozen=True)
class Signals:
    """P pixels; ``u`` and ``amplitude`` (2, 2, P): path (direct, bounce) by axis (x, y)."""

    rig: Rig
    pixels: NDArray[np.intp]
    u: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    alpha: NDArray[np.float64]
    axes: dict[str, AxisPhasorsOf]


def signals(
    rng: np.random.Generator,
    count: int,
    alpha: tuple[float, float],
    sigma: float,
    apart_x: tuple[float, float],
    apart_y: tuple[float, float] = (0, 400),
    off_line_px: float = 3.0,
    ratio: float = 0.97,
    spread: tuple[float, float] = (0.02, 0.05),
) -> Signals:
    """Pixels at random depth whose bounce comes from elsewhere in the picture.

    Parameters
    ----------
    alpha
        Range of the bounce's amplitude over the direct one's.
    sigma
        Noise of a frame, DN.
    apart_x, apart_y
        Ranges of |Δx| and |Δy|, px.
    off_line_px
        Least distance of the bounce's (x, y) from the pixel's epipolar line.
    ratio, spread
        Modulation along y over that along x, and the relative scatter of that for (direct, bounce).
    """
    rig = SimulatedSettings().rig()
    width, height = rig.camera.size
    kept = []
    while sum(k.shape[-1] for k in kept) < count:
        n = 4 * count
        column, row = rng.integers(0, width, n), rng.integers(0, height, n)
        depth = rng.uniform(450, 800, n)
        points = rig.camera.rays(np.stack([column, row], -1).astype(float)) * depth[:, None]
        direct = rig.projector.project(rig.to_projector_frame(points)).T
        step = np.stack([rng.uniform(*r, n) * rng.choice([-1, 1], n) for r in (apart_x, apart_y)])
        bounce = direct + step
        line = rig.epipolar_line(np.stack([column, row], -1).astype(float)).T
        off = np.abs(line[0] * bounce[0] + line[1] * bounce[1] + line[2])
        size = np.array([[EXTENT["x"]], [EXTENT["y"]]])
        ok = off > off_line_px
        for place in (direct, bounce):
            ok &= ((place >= -0.5) & (place < size - 0.5)).all(axis=0)
        kept.append(np.stack([np.stack([column, row]), direct, bounce])[..., ok])
    place = np.concatenate(kept, axis=-1)[..., :count]
    order = np.argsort(place[0, 1] * width + place[0, 0], kind="stable")
    place = place[..., order]
    u = place[1:]
    a = rng.uniform(*alpha, count)
    path = np.stack([np.full(count, B), a * B])
    skew = ratio * np.exp(np.array(spread)[:, None] * rng.standard_normal((2, count)))
    amplitude = np.stack([path, path * skew], axis=1)
    axes = {}
    sigma_z = np.full(count, sigma * np.sqrt(2 / STEPS))
    for k, axis in enumerate(("x", "y")):
        clean = np.sum(amplitude[:, k] * np.exp(2j * np.pi * FREQUENCY[:, None, None] * u[:, k]), axis=1)
        noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
        z = (clean + sigma_z * noise).astype(np.complex64)
        axes[axis] = AxisPhasorsOf(z, FREQUENCY, sigma_z.astype(np.float32), EXTENT[axis], np.ones(9))
    pixels = (place[0, 1] * width + place[0, 0]).astype(np.intp)
    return Signals(rig, pixels, u, amplitude, a, axes)
