"""What is projected: a `Plan` of pattern sequences, parametric and rendered on demand.

Pattern n of a `FringeSequence` is ``A + B cos(2π f u + φ_n)`` with the projector coordinate u (px, pixel centres at
integers) along one axis and, in this project's own plans, φ_n = 2π n / N, n = 1..N (method.md §1; Optics Express 27(20)
28293, Eq. 15). Patterns of any other profile along the axis, such as codes, are a `ProfileSequence`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanner.response import checked_light, nearest_levels

Axis = Literal["x", "y"]
AXES: tuple[Axis, Axis] = ("x", "y")


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

    def profile(self, extent: int) -> NDArray[np.float64]:
        """(extent,) cosine at the projector pixels along the fringe's axis, -1..1."""
        return np.asarray(np.cos(2 * np.pi * self.frequency * np.arange(extent) + self.step_rad))


@dataclass(frozen=True)
class FringeSequence:
    """Fringes that are captured, checked and repeated together.

    Parameters
    ----------
    axis
        ``"x"``: the fringes vary along the projector's columns; ``"y"``: along its rows.
    fringes
        The patterns in the order they are shown.
    carrier
        A fringe along the *other* axis that the light of every pattern is multiplied by, as (1 + cos)/2; None for plain
        fringes.
    """

    axis: Axis
    fringes: tuple[Fringe, ...]
    carrier: Fringe | None = None

    def __len__(self) -> int:
        return len(self.fringes)

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
        carried = "" if self.carrier is None else f" carrier {math.degrees(self.carrier.step_rad):.0f}°"
        return f"{self.axis} 1/{1 / self.frequency:.5g} px{carried}"

    def light(self, size: tuple[int, int], mean: float, amplitude: float) -> list[NDArray[np.float64]]:
        """Light of each pattern as a fraction of full scale, broadcastable to the projector's (height, width)."""
        lines = [_along(self.axis, mean + amplitude * f.profile(_extent(size, self.axis))) for f in self.fringes]
        if self.carrier is None:
            return lines
        other: Axis = "y" if self.axis == "x" else "x"
        carrier = _along(other, 0.5 + 0.5 * self.carrier.profile(_extent(size, other)))
        return [line * carrier for line in lines]

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document."""
        document: dict[str, Any] = {"axis": self.axis, "fringes": [[f.frequency, f.step_rad] for f in self.fringes]}
        if self.carrier is not None:
            document["carrier"] = [self.carrier.frequency, self.carrier.step_rad]
        return document


@dataclass(frozen=True)
class ProfileSequence:
    """Patterns of any profile along one axis that are captured, checked and repeated together.

    Parameters
    ----------
    axis
        As in `FringeSequence`.
    name
        Short name for messages, such as ``XOR code``.
    profiles
        (N, extent) for each pattern its light at every projector pixel along the axis: -1 the darkest, 1 the brightest.
        A pattern that is another's inverse lets the sequence's check see more.

    Raises
    ------
    ValueError
        No patterns, patterns of different lengths, or values outside -1..1.
    """

    axis: Axis
    name: str
    profiles: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        if len({len(p) for p in self.profiles}) != 1:
            raise ValueError(f"{self.name}: a sequence needs patterns, and all of the same length")
        if not all(-1 <= v <= 1 for p in self.profiles for v in p):
            raise ValueError(f"{self.name}: a profile lies within -1..1")

    def __len__(self) -> int:
        return len(self.profiles)

    @property
    def frequency(self) -> None:
        """None: these are no fringes of one frequency."""
        return

    @property
    def label(self) -> str:
        """Short name for messages, such as ``x XOR code``."""
        return f"{self.axis} {self.name}"

    def light(self, size: tuple[int, int], mean: float, amplitude: float) -> list[NDArray[np.float64]]:
        """As `FringeSequence.light`.

        Raises
        ------
        ValueError
            The profiles do not have the projector's length.
        """
        if len(self.profiles[0]) != _extent(size, self.axis):
            raise ValueError(f"{self.label}: profiles of {len(self.profiles[0])} px for a projector of {size} px")
        return [_along(self.axis, mean + amplitude * np.array(p)) for p in self.profiles]

    def to_json(self) -> dict[str, Any]:
        """JSON-ready document; every profile as its runs [value, px]."""
        runs = [[[value, len(list(same))] for value, same in groupby(p)] for p in self.profiles]
        return {"axis": self.axis, "name": self.name, "profiles": runs}


PatternSequence = FringeSequence | ProfileSequence
"""What a plan consists of: both have ``axis``, ``label``, ``frequency``, a length, ``light`` and ``to_json``."""


def patterns_in(document: Mapping[str, Any]) -> int:
    """Number of patterns in the document of a sequence."""
    return len(document["profiles"] if "profiles" in document else document["fringes"])


def sequence_from_json(document: Mapping[str, Any]) -> PatternSequence:
    """Inverse of both ``to_json``."""
    if "profiles" in document:
        profiles = tuple(tuple(v for value, px in runs for v in [value] * px) for runs in document["profiles"])
        return ProfileSequence(document["axis"], document["name"], profiles)
    carrier = document.get("carrier")
    return FringeSequence(
        document["axis"],
        tuple(Fringe(f, step) for f, step in document["fringes"]),
        None if carrier is None else Fringe(*carrier),
    )


def _extent(size: tuple[int, int], axis: Axis) -> int:
    return size[0] if axis == "x" else size[1]


def _along(axis: Axis, line: NDArray[np.float64]) -> NDArray[np.float64]:
    return line[None] if axis == "x" else line[:, None]


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
    sequences: tuple[PatternSequence, ...]
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
        return sum(len(s) for s in self.sequences)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes that are measured, x first."""
        return tuple(a for a in ("x", "y") if any(s.axis == a for s in self.sequences))

    def first_slot(self, sequence: int) -> int:
        """Plan index of the first pattern of sequence ``sequence``."""
        return sum(len(s) for s in self.sequences[:sequence])

    def extent(self, axis: Axis) -> int:
        """Projector pixels along ``axis``."""
        return _extent(self.size, axis)

    def fringes(self, axis: Axis) -> tuple[FringeSequence, ...]:
        """The sequences of ``axis`` in plan order.

        Raises
        ------
        ValueError
            One of them shows no fringes.
        """
        chosen = tuple(s for s in self.sequences if s.axis == axis)
        if others := [s.label for s in chosen if not isinstance(s, FringeSequence)]:
            raise ValueError(f"{', '.join(others)}: a phasor needs fringes")
        return chosen  # type: ignore[return-value]

    def grey(self, light: ArrayLike) -> NDArray[np.uint8]:
        """Grey levels that come nearest to ``light`` (fractions of full scale, any shape)."""
        if self.response is None:
            return np.rint(255 * np.asarray(light, np.float64)).astype(np.uint8)
        return nearest_levels(self.response, light)

    def rounding(self) -> dict[tuple[Axis, float], NDArray[np.complex128]]:
        """What whole grey levels add to the phasor of each projector pixel, as a share of its modulus.

        By axis and frequency, (extent,); of fringes of one frequency without a carrier.
        """
        found: dict[tuple[Axis, float], NDArray[np.complex128]] = {}
        for s in self.sequences:
            if isinstance(s, ProfileSequence) or s.frequency is None or s.carrier is not None:
                continue
            light = np.stack([line.ravel() for line in s.light(self.size, self.mean, self.amplitude)])
            levels = self.grey(light)
            shown = levels / 255 if self.response is None else np.array(self.response)[levels]
            transform = 2 / len(s) * np.exp(-1j * s.steps_rad)
            found[s.axis, s.frequency] = transform @ (shown - light) / self.amplitude
        return found

    def render(self, sequence: int) -> list[NDArray[np.uint8]]:
        """(height, width) 8-bit pictures of one sequence, in the grey levels whose light comes nearest."""
        width, height = self.size
        pictures = []
        for light in self.sequences[sequence].light(self.size, self.mean, self.amplitude):
            picture = np.broadcast_to(self.grey(light), (height, width))
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
            "sequences": [s.to_json() for s in self.sequences],
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
            sequences=tuple(sequence_from_json(s) for s in document["sequences"]),
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
