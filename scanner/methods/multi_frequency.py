"""Phase shifting with several frequencies and one round: TPS and MPS, both with N steps of every frequency.

*Temporal phase shifting* (TPS) goes from one fringe over the whole picture down to the fine one; *micro phase shifting*
(MPS; Gupta & Nayar, CVPR 2012) uses high frequencies only, whose diffuse bounces average out. The defaults are those
that Optics Express 27(20) 28293 ran, method.md §2. Both are decoded by maximum likelihood. Neither detects bounces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat
from scanner.config import ScanSection
from scanner.interreflection import misfit_statistic
from scanner.methods.base import (
    FirstRound,
    OneRound,
    PlanError,
    RoundFrames,
    Setup,
    first_flags,
    keep_clear,
    refuse_off_epipolar,
    stepped_plan,
    usable_pixels,
)
from scanner.patterns import Axis, Plan, unambiguous_range
from scanner.phasors import RoundPhasors
from scanner.result import Maps
from scanner.unwrapping import Coordinates, modulation, modulation_trend, unwrap

MPS_PERIODS_PX = (14.57, 16.09, 16.24, 16.67, 16.60)


@dataclass(frozen=True)
class MultiFrequency(OneRound):
    """N steps of each of several frequencies, one round.

    Parameters
    ----------
    name, title
        Name of the method, and in words.
    own_frequencies
        Frequencies (1/px) for an axis of so many projector pixels.
    """

    name: str
    title: str
    own_frequencies: Callable[[int], Sequence[float]]

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """Plan of the only round."""
        own: dict[Axis, Sequence[float]] = {"x": self.own_frequencies(size[0]), "y": self.own_frequencies(size[1])}
        return stepped_plan(scan, size, own)

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundPhasors:
        """Phasors of the frames."""
        return RoundPhasors(plan, frame_format)

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Maximum-likelihood coordinates of every axis that is there."""
        assert isinstance(frames, RoundPhasors)
        decoded = decode_axes(frames, setup)
        maps, _ = one_path_maps(frames, decoded, setup)
        return FirstRound(refuse_off_epipolar(maps, setup.rig), frames.plan)


temporal_phase_shifting = MultiFrequency(
    "tps", "Temporal phase shifting", lambda extent: (1 / 16, 10 / extent, 1 / extent)
)
micro_phase_shifting = MultiFrequency(
    "mps",
    "Micro phase shifting, N steps of every frequency (as Opt. Express 27, 28293 ran it)",
    lambda extent: tuple(1 / p for p in MPS_PERIODS_PX),
)


@dataclass(frozen=True)
class DecodedAxis:
    """One axis of a round: coordinates, modulation, noise of the phasors and the trend of the modulation."""

    coordinates: Coordinates
    modulation: NDArray[np.float32]
    sigma_z: NDArray[np.float32]
    gain: NDArray[np.float64]


def decode_axes(
    frames: RoundPhasors, setup: Setup, gains: Mapping[Axis, NDArray[np.float64]] | None = None
) -> dict[Axis, DecodedAxis]:
    """Coordinates of every axis of which enough sequences are there to tell the projector's whole extent.

    ``gains`` are the modulation trends where they are known; otherwise they are measured.

    Raises
    ------
    PlanError
        No axis can be told.
    """
    decoded: dict[Axis, DecodedAxis] = {}
    for axis in frames.plan.axes:
        phasors = frames.axis(axis)
        extent = frames.plan.extent(axis)
        if phasors is None or unambiguous_range(phasors.frequency.tolist()) < extent * (1 - 1e-6):
            continue
        sigma_z = phasors.sigma_z(setup.noise, frames.mean)
        gain = gains[axis] if gains and axis in gains else modulation_trend(phasors, sigma_z)
        decoded[axis] = DecodedAxis(unwrap(phasors, sigma_z, extent, gain), modulation(phasors, sigma_z), sigma_z, gain)
    if not decoded:
        there = ", ".join(frames.plan.sequences[i].label for i in sorted(frames.added)) or "none"
        raise PlanError(
            f"the frames hold {len(frames.added)} of {len(frames.plan.sequences)} sequences ({there}): "
            "no axis can be told over the whole projector from them",
            "Record the missing sequences; `scan process` needs all frequencies of at least one axis.",
        )
    return decoded


def one_path_maps(
    frames: RoundPhasors, decoded: dict[Axis, DecodedAxis], setup: Setup
) -> tuple[Maps, NDArray[np.bool_]]:
    """Maps of a round without any detection, and the pixels that could be used."""
    modulations = [d.modulation for d in decoded.values()]
    sigma_z = next(iter(decoded.values())).sigma_z
    usable = usable_pixels(np.minimum.reduce(modulations), sigma_z, frames.saturated, setup.scan)
    kept = {a: keep_clear(d.coordinates, usable) for a, d in decoded.items()}
    x, sigma_x = kept.get("x", (None, None))
    y, sigma_y = kept.get("y", (None, None))
    total, dof = misfit_statistic([d.coordinates for d in decoded.values()])
    maps = Maps(
        x_p=x,
        y_p=y,
        sigma_x=sigma_x,
        sigma_y=sigma_y,
        modulation=np.asarray(np.mean(modulations, axis=0), np.float32),
        brightness=frames.mean,
        variation=None,
        misfit=total / np.float32(max(dof, 1)),
        misfit_dof=dof,
        interreflection=np.zeros(usable.shape, bool),
        flags=first_flags(usable, frames.saturated, [u for u, _ in kept.values()]),
    )
    return maps, usable
