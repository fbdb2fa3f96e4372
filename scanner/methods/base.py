"""What all methods share: the protocol, the setting they decode in, and the maps of a decoded round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from drivers import FrameFormat, NoiseModel, OperatorError, Pixels
from scanner.config import ScanSection, check_plan_covers
from scanner.patterns import Axis, Plan, phase_steps
from scanner.result import Flag, Maps
from scanner.rig import Rig
from scanner.unwrapping import Coordinates

EPIPOLAR_TOLERANCE_PX = 1.0
"""An (x, y) pair may miss its epipolar line by this much, for the calibration's sake, beside its own noise."""

_CLEAR_LEAD = 7.0
"""The best fringe order must be e⁷ ≈ 1000 times as likely as the second best."""

_CLEAR_MODULATION = 8.0
"""Least modulation in units of the phasor noise: below it, the fringe order is a guess more often than once in 100."""


class PlanError(OperatorError):
    """A plan that cannot be decoded."""


@dataclass(frozen=True)
class Setup:
    """What a method may know beside the frames.

    Parameters
    ----------
    scan
        The operator's choices.
    noise
        Noise model of a frame, DN.
    rig
        Calibrated camera and projector, or None; with both axes it tells direct paths from bounces.
    """

    scan: ScanSection
    noise: NoiseModel
    rig: Rig | None


class RoundFrames(Protocol):
    """Takes the frames of one round, sequence by sequence, and keeps what the method needs of them."""

    plan: Plan
    added: set[int]
    saturated: NDArray[np.bool_]

    def add(self, sequence: int, frames: Pixels) -> None:
        """Take over the (N, H, W) frames of a sequence; they may be overwritten afterwards."""
        ...

    def estimate_noise(self) -> NoiseModel | None:
        """Noise model that the frames themselves show; None where they have no redundancy."""
        ...


@dataclass
class FirstRound:
    """What decoding the first round leaves for the second, and all there is where no second follows.

    Parameters
    ----------
    maps
        Per-pixel results of round one.
    plan
        What round one projected.
    private
        Whatever the method's own later steps need.
    notes
        Warnings for the operator.
    decision
        Whether a second round follows and why, in words; empty where there was nothing to decide.
    regional
        Regional sequences that were taken or are planned; 1 where the method does not say.
    """

    maps: Maps
    plan: Plan
    private: object = None
    notes: list[str] = field(default_factory=list)
    decision: str = ""
    regional: int = 1


class Method(Protocol):
    """One way to scan; `OneRound` is a base for those that need no second round."""

    @property
    def name(self) -> str:
        """Name in configurations and tables."""
        ...

    @property
    def title(self) -> str:
        """Name for people, and the paper it is from."""
        ...

    @property
    def rounds(self) -> int:
        """Rounds that a complete scan takes: 1 or 2."""
        ...

    def first_round(self, scan: ScanSection, size: tuple[int, int]) -> Plan:
        """Plan of the first round for a projector of ``size`` (width, height) px; raises `PlanError`."""
        ...

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundFrames:
        """Make an empty collection for the frames of ``plan``."""
        ...

    def decode(self, frames: RoundFrames, setup: Setup) -> FirstRound:
        """Decode the first round; sequences may be missing as long as an axis can be told without them."""
        ...

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """Plan of the second round; None where there is nothing to light."""
        ...

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Join both rounds."""
        ...


@runtime_checkable
class RepeatedlyRegional(Protocol):
    """A method that may light the region more than once: each sequence is joined, and may bring about the next."""

    def join(self, first: FirstRound, regional: RoundFrames, setup: Setup) -> FirstRound:
        """Join a regional sequence to what is known; `Method.second_round` of the result is the next, if any.

        ``notes`` of the result are those that the sequence adds.
        """
        ...

    def skip(self, first: FirstRound) -> FirstRound:
        """Go on without the regional sequence that `Method.second_round` has planned."""
        ...


@dataclass
class KeptFrames:
    """The frames of each sequence as they are, for methods that take few enough of them."""

    plan: Plan
    frame_format: FrameFormat
    added: set[int] = field(default_factory=set)
    frames: dict[int, Pixels] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.saturated: NDArray[np.bool_] = np.zeros(self.frame_format.shape, bool)

    def add(self, sequence: int, frames: Pixels) -> None:
        """Take over the (N, H, W) frames of a sequence."""
        self.frames[sequence] = frames.copy()
        self.saturated |= (frames >= self.frame_format.saturated_dn).any(axis=0)
        self.added.add(sequence)

    def estimate_noise(self) -> NoiseModel | None:
        """The camera's own model is taken."""
        return None


class OneRound:
    """What methods without a second round share; they add ``name``, ``title``, ``first_round`` and ``decode``."""

    rounds: int = 1

    def collect(self, plan: Plan, frame_format: FrameFormat) -> RoundFrames:
        """Keep the frames as they are."""
        return KeptFrames(plan, frame_format)

    def second_round(self, first: FirstRound, setup: Setup) -> Plan | None:
        """Nothing follows."""
        return None

    def fuse(self, first: FirstRound, second: RoundFrames, setup: Setup) -> Maps:
        """Nothing follows, so round one stands."""
        return first.maps


@dataclass(frozen=True)
class MeasuredAxis:
    """One axis of a round of `KeptFrames`: coordinates, mean grey value and noise of the phasor, (H, W), DN."""

    coordinates: Coordinates
    mean: NDArray[np.float32]
    sigma_z: NDArray[np.float32]


def undetected_maps(axes: Sequence[MeasuredAxis], saturated: NDArray[np.bool_], setup: Setup) -> Maps:
    """Maps of a round that detects no bounces, points included where a rig is known.

    Raises
    ------
    PlanError
        There is no axis.
    """
    if not axes:
        raise PlanError("the frames hold no complete axis", "Record at least the frames of one axis.")
    amplitudes = [m.coordinates.amplitude for m in axes]
    kept = {
        m.coordinates.axis: keep_clear(
            m.coordinates, usable_pixels(m.coordinates.amplitude, m.sigma_z, saturated, setup.scan)
        )
        for m in axes
    }
    usable = usable_pixels(np.minimum.reduce(amplitudes), axes[0].sigma_z, saturated, setup.scan)
    misfits = [m.coordinates.chi2 / np.float32(m.coordinates.dof) for m in axes]
    x, sigma_x = kept.get("x", (None, None))
    y, sigma_y = kept.get("y", (None, None))
    maps = Maps(
        x_p=x,
        y_p=y,
        sigma_x=sigma_x,
        sigma_y=sigma_y,
        modulation=np.asarray(np.mean(amplitudes, axis=0), np.float32),
        brightness=np.mean([m.mean for m in axes], axis=0, dtype=np.float32),
        variation=None,
        misfit=np.mean(misfits, axis=0, dtype=np.float32),
        misfit_dof=sum(m.coordinates.dof for m in axes),
        interreflection=np.zeros(usable.shape, bool),
        flags=first_flags(usable, saturated, [u for u, _ in kept.values()]),
    )
    return refuse_off_epipolar(maps, setup.rig)


def stepped_plan(
    scan: ScanSection, size: tuple[int, int], own: dict[Axis, Sequence[float]], mask: NDArray[np.bool_] | None = None
) -> Plan:
    """Plan of N equal steps for every frequency: the operator's frequencies, or the method's ``own`` (1/px) by axis.

    Raises
    ------
    PlanError
        Aliased frequencies, too few steps, or a range that does not cover the projector.
    """
    sequences = []
    for axis in scan.axes:
        frequencies = scan.frequencies(axis) or own[axis]
        check_plan_covers(frequencies, size[0] if axis == "x" else size[1], axis)
        try:
            sequences += [phase_steps(axis, f, scan.steps) for f in frequencies]
        except ValueError as error:
            raise PlanError(f"scan, axis {axis}: {error}", "Choose periods above 2 px and at least 3 steps.") from None
    return Plan(size, tuple(sequences), scan.mean, scan.amplitude, mask)


def usable_pixels(
    modulation: NDArray[np.float32], sigma_z: NDArray[np.float32], saturated: NDArray[np.bool_], scan: ScanSection
) -> NDArray[np.bool_]:
    """Pixels with enough modulation and no saturated frame."""
    least = scan.minimum_modulation_dn or 0.0
    enough: NDArray[np.bool_] = (modulation >= np.float32(least)) & (modulation >= _CLEAR_MODULATION * sigma_z)
    return enough & ~saturated


def keep_clear(c: Coordinates, keep: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Coordinate and σ where ``keep`` holds and the fringe order is beyond doubt, NaN elsewhere."""
    ok = keep & (c.lead > _CLEAR_LEAD)
    return np.where(ok, c.u, np.float32(np.nan)), np.where(ok, c.sigma, np.float32(np.nan))


def first_flags(
    usable: NDArray[np.bool_], saturated: NDArray[np.bool_], coordinates: Sequence[NDArray[np.float32]]
) -> NDArray[np.uint16]:
    """Flags that need no detection: saturated, too dark, order not clear."""
    flags = np.zeros(usable.shape, np.uint16)
    flags[saturated] |= np.uint16(Flag.SATURATED)
    flags[~usable & ~saturated] |= np.uint16(Flag.LOW_MODULATION)
    for u in coordinates:
        flags[usable & np.isnan(u)] |= np.uint16(Flag.MISFIT)
    return flags


def refuse_off_epipolar(maps: Maps, rig: Rig | None) -> Maps:
    """Add the points, and take back (x, y) pairs that do not lie on their pixel's epipolar line.

    The second needs both axes and a rig, the first a rig alone; without one the maps come back as they are.
    """
    if rig is None or (maps.x_p is None and maps.y_p is None):
        return maps
    # The rig's geometry is compiled code of its own: a round that is decoded without a rig does not load it.
    from scanner.rig_uncertainty import sigma_rig
    from scanner.triangulation import triangulate

    found = triangulate(rig, maps.x_p, maps.sigma_x, maps.y_p, maps.sigma_y)
    flags = maps.flags.copy()
    known = maps.valid
    lost = known & ~np.isfinite(found.depth)
    flags[lost] |= np.uint16(Flag.OUT_OF_VOLUME)
    if found.epipolar_px is not None and found.epipolar_sigmas is not None:
        off = known & (np.abs(found.epipolar_px) > EPIPOLAR_TOLERANCE_PX) & (np.abs(found.epipolar_sigmas) > 5)
        flags[off] |= np.uint16(Flag.OFF_EPIPOLAR)
        lost |= off
    nan = np.float32(np.nan)
    points = found.points
    points[lost] = nan

    def without(u: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        return None if u is None else np.where(lost, nan, u)

    return replace(
        maps,
        x_p=without(maps.x_p),
        y_p=without(maps.y_p),
        sigma_x=without(maps.sigma_x),
        sigma_y=without(maps.sigma_y),
        flags=flags,
        points=points,
        depth=points[..., 2],
        sigma_point=np.where(lost, nan, found.sigma_point),
        sigma_rig=sigma_rig(rig, points[..., 2], maps.sigma_x, maps.sigma_y),
        epipolar_px=found.epipolar_px,
    )
