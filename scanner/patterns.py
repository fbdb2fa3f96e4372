"""What is projected: a `Plan` of fringe sequences, parametric and rendered on demand.

Pattern n of a sequence is ``A + B cos(2π f u + φ_n)`` with the projector coordinate u (px, pixel centres at integers)
along one axis and, in this project's own plans, φ_n = 2π n / N, n = 1..N (method.md §1; Optics Express 27(20) 28293,
Eq. 15).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanner.response import checked_light, nearest_levels

Axis = Literal["x", "y"]


@dataclass(frozen=True)
class Fringe:
    """One pattern: a fringe of one frequency at one phase step.

    Parameters
    ----------
    frequency
        Periods per projector pixel, 1/px.
    step_rad
        Phase added to 2π f u, rad.
    """

    frequency: float
    step_rad: float


@dataclass(frozen=True)
class FringeSequence:
    """Patterns that are captured, checked and repeated together.

    Parameters
    ----------
    axis
        ``"x"``: the fringes vary along the projector's columns; ``"y"``: along its rows.
    fringes
        The patterns in the order they are shown.
    """

    axis: Axis
    fringes: tuple[Fringe, ...]

    @property
    def frequency(self) -> float | None:
        """The one frequency (1/px) of all patterns, or None where they differ."""
        first = self.fringes[0].frequency
        return first if all(f.frequency == first for f in self.fringes) else None

    @property
    def steps_rad(self) -> NDArray[np.float64]:
        """(N,) phase steps, rad."""
        return np.array([f.step_rad for f in self.fringes])

    @property
    def label(self) -> str:
        """Short name for messages, such as ``x 1/16 px``."""
        if self.frequency is None:
            return f"{self.axis} {len({f.frequency for f in self.fringes})} periods"
        return f"{self.axis} 1/{1 / self.frequency:.5g} px"


def phase_steps(axis: Axis, frequency: float, steps: int) -> FringeSequence:
    """N equal phase steps of one frequency: φ_n = 2π n / N, n = 1..N.

    Raises
    ------
    ValueError
        Fewer than three steps, or a frequency that the projector's pixels alias (f ≥ 1/2).
    """
    if steps < 3:
        raise ValueError(f"{steps} phase steps: mean, modulation and phase need at least 3")
    if not 0 < frequency < 0.5:
        raise ValueError(f"frequency {frequency:g} 1/px: it must lie between 0 and 1/2, a period of 2 px")
    return FringeSequence(axis, tuple(Fringe(frequency, 2 * math.pi * n / steps) for n in range(1, steps + 1)))


@dataclass(frozen=True)
class Plan:
    """All that one round projects.

    Parameters
    ----------
    size
        Projector (width, height), px.
    sequences
        In the order they are shown.
    mean, amplitude
        A and B as fractions of the projector's full scale; ``mean ± amplitude`` must stay within 0..1.
    mask
        (height, width) bool, the projector pixels that are lit; None lights all. Elsewhere the pattern is black.
    response
        Light of each of the 256 grey levels, 0..1 and nowhere falling, for which the pictures are corrected
        (`scanner.response.ProjectorResponse.values`); None for a projector whose light follows the grey level.
    """

    size: tuple[int, int]
    sequences: tuple[FringeSequence, ...]
    mean: float = 0.5
    amplitude: float = 0.5
    mask: NDArray[np.bool_] | None = field(default=None, compare=False)
    response: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if not self.sequences:
            raise ValueError("a plan without a sequence projects nothing")
        if self.mean - self.amplitude < -1e-9 or self.mean + self.amplitude > 1 + 1e-9 or self.amplitude <= 0:
            raise ValueError(f"A = {self.mean:g}, B = {self.amplitude:g}: A ± B must lie within 0..1 and B above 0")
        if self.mask is not None and self.mask.shape != (self.size[1], self.size[0]):
            raise ValueError(
                f"mask {self.mask.shape} does not have the projector's shape {(self.size[1], self.size[0])}"
            )
        if self.response is not None:
            checked_light(self.response)

    @property
    def frame_count(self) -> int:
        """Patterns in the whole plan."""
        return sum(len(s.fringes) for s in self.sequences)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes that are measured, x first."""
        return tuple(a for a in ("x", "y") if any(s.axis == a for s in self.sequences))

    def first_slot(self, sequence: int) -> int:
        """Plan index of the first pattern of sequence ``sequence``."""
        return sum(len(s.fringes) for s in self.sequences[:sequence])

    def extent(self, axis: Axis) -> int:
        """Projector pixels along ``axis``."""
        return self.size[0] if axis == "x" else self.size[1]

    def grey(self, light: ArrayLike) -> NDArray[np.uint8]:
        """Grey levels that come nearest to ``light`` (fractions of full scale, any shape)."""
        if self.response is None:
            return np.rint(255 * np.asarray(light, np.float64)).astype(np.uint8)
        return nearest_levels(self.response, light)

    def render(self, sequence: int) -> list[NDArray[np.uint8]]:
        """(height, width) 8-bit pictures of one sequence, in the grey levels whose light comes nearest."""
        chosen = self.sequences[sequence]
        width, height = self.size
        u = np.arange(self.extent(chosen.axis), dtype=np.float64)
        pictures = []
        for fringe in chosen.fringes:
            line = self.mean + self.amplitude * np.cos(2 * np.pi * fringe.frequency * u + fringe.step_rad)
            grey = self.grey(line)
            picture = np.broadcast_to(grey if chosen.axis == "x" else grey[:, None], (height, width))
            if self.mask is not None:
                picture = np.where(self.mask, picture, np.uint8(0))
            pictures.append(np.ascontiguousarray(picture))
        return pictures

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; the mask is run-length coded."""
        return {
            "size": list(self.size),
            "mean": self.mean,
            "amplitude": self.amplitude,
            "sequences": [
                {"axis": s.axis, "fringes": [[f.frequency, f.step_rad] for f in s.fringes]} for s in self.sequences
            ],
            "mask": None if self.mask is None else _run_lengths(self.mask),
            "response": None if self.response is None else list(self.response),
        }

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Plan:
        """Inverse of `to_json`."""
        width, height = document["size"]
        mask, response = document.get("mask"), document.get("response")
        return cls(
            size=(width, height),
            sequences=tuple(
                FringeSequence(s["axis"], tuple(Fringe(f, step) for f, step in s["fringes"]))
                for s in document["sequences"]
            ),
            mean=document["mean"],
            amplitude=document["amplitude"],
            mask=None if mask is None else _from_run_lengths(mask, (height, width)),
            response=None if response is None else tuple(response),
        )


def _run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Lengths of the alternating runs in row order, beginning with a (maybe empty) run of False."""
    flat = mask.ravel()
    changes = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate(([0], changes, [flat.size]))).tolist()
    return [0, *runs] if flat[0] else runs


def _from_run_lengths(runs: Sequence[int], shape: tuple[int, int]) -> NDArray[np.bool_]:
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs).reshape(shape)


def unambiguous_range(frequencies: Sequence[float]) -> float:
    """Length (px) after which all fringes come round together: the least common period of the frequencies.

    Parameters
    ----------
    frequencies
        1/px; fractional frequencies are taken as ratios of integers up to 10⁴ of the first.

    Notes
    -----
    For f_t = (80 + t)/1280 this is 1280 px, because gcd(80..88) = 1.
    """
    from fractions import Fraction

    ratios = [Fraction(f / frequencies[0]).limit_denominator(10_000) for f in frequencies]
    numerator = math.gcd(*(r.numerator * (math.lcm(*(q.denominator for q in ratios)) // r.denominator) for r in ratios))
    common = Fraction(numerator, math.lcm(*(q.denominator for q in ratios)))
    return 1 / (frequencies[0] * float(common))
