"""Which frame of a sequence is wrong, and what it shows instead: for people to read."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanner.integrity.waveform import series

_EXPLAINS = 0.85
_MOST_NAMED = 2


@dataclass(frozen=True)
class Culprit:
    """A frame that does not belong with the others.

    Parameters
    ----------
    frame
        From 0.
    step_rad, gain
        Step and contrast, relative to the others, of the fringe that it shows.
    offset
        What it is brighter by, in units of the modulation.
    """

    frame: int
    step_rad: float
    gain: float
    offset: float

    def message(self, steps_rad: NDArray[np.float64]) -> str:
        """What the frame shows, in words."""
        number, count = self.frame + 1, len(steps_rad)
        off = np.angle(np.exp(1j * (self.step_rad - steps_rad)))
        nearest = int(np.abs(off).argmin())
        if self.gain > 0.7 and abs(self.offset) < 0.3 and nearest != self.frame and abs(off[nearest]) < np.pi / count:
            return (
                f"frame {number} shows step {nearest + 1} of {count} (off by {np.degrees(off[self.frame]):+.0f}°): "
                "a stale, repeated, missing or swapped frame"
            )
        if self.gain < 0.2 and self.offset < -0.5:
            return f"frame {number} is dark"
        if abs(self.offset) > 0.05 and abs(self.gain - 1) < 0.3 * abs(self.offset):
            return (
                f"frame {number} is {'brighter' if self.offset > 0 else 'darker'} than the others: the light flickers"
            )
        return (
            f"frame {number} has {100 * self.gain:.0f} % of the contrast of the others, "
            f"{np.degrees(off[self.frame]):+.0f}° from its step: torn, mixed or blank"
        )


def culprits(
    values: NDArray[np.float32], steps_rad: NDArray[np.float64], noise_dn: float, orders: int
) -> list[Culprit]:
    """The fewest frames without which the others fit their steps; empty where no few frames are to blame.

    Parameters
    ----------
    values
        (N, P) grey values of the pixels that show the error.
    steps_rad
        (N,) planned steps.
    noise_dn
        Standard deviation of a grey value, DN.
    orders
        Of the waveform; as many as leave two degrees of freedom are taken.
    """
    count = len(steps_rad)
    model = series(steps_rad, max(1, min(orders, (count - 3) // 2)))
    unexplained = np.linalg.qr(model, mode="complete")[0][:, model.shape[1] :]
    degrees = unexplained.shape[1]
    rest = unexplained.T @ values
    scatter = rest @ rest.T - noise_dn**2 * values.shape[1] * np.eye(degrees)

    def share(frames: tuple[int, ...]) -> float:
        """Of the energy that no waveform explains, what errors of these frames do."""
        errors = unexplained[list(frames)]
        explained = np.linalg.solve(errors @ errors.T, errors @ scatter @ errors.T)
        return float(np.trace(explained) / np.trace(scatter))

    removed: tuple[int, ...] = ()
    for size in range(1, _MOST_NAMED + 1):
        if degrees < 2 * size:
            break
        best = max(combinations(range(count), size), key=share)
        if share(best) > _EXPLAINS:
            removed = best
            break
    if not removed:
        return []
    kept = [n for n in range(count) if n not in removed]
    mean, re, im = np.linalg.lstsq(series(steps_rad[kept], 1), values[kept], rcond=None)[0]
    shapes = np.stack([np.hypot(re, im), re, -im], axis=1)
    found = []
    for frame in removed:
        offset, along, across = np.linalg.lstsq(shapes, values[frame] - mean, rcond=None)[0]
        found.append(Culprit(frame, float(np.arctan2(across, along)), float(np.hypot(along, across)), float(offset)))
    return found
