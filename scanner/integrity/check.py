"""Did these frames show these patterns? Checks that need no extra pattern."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xxhash
from numpy.typing import NDArray

from drivers import Pixels
from scanner.integrity.codes import wrong_codes
from scanner.integrity.findings import SEQUENCE, Finding, SequenceCheck
from scanner.integrity.frame_errors import formed_excess
from scanner.integrity.history import SequenceHistory
from scanner.integrity.naming import culprits
from scanner.integrity.profiles import check_pairs
from scanner.integrity.sampling import Grid, grid, unsaturated
from scanner.integrity.steps import wrong_steps
from scanner.integrity.waveform import (
    FEWEST,
    Reference,
    Waveform,
    excess,
    fit,
    free_harmonics,
    harmonic_excess,
    of_own_fringe,
    other_mean,
)
from scanner.patterns import FringeSequence, PatternSequence, ProfileSequence

_OWN_REDUNDANCY = 8
"""Steps from which the frames of a sequence tell every error of a single one by themselves."""


_FEW_STEPS_ERROR = 0.6
"""Of four or five steps that nothing else is known of: an error that is believed, in units of B."""


def repeated_frames(frames: Sequence[Pixels] | Pixels) -> list[tuple[int, int]]:
    """Pairs (earlier, later) of frames that are equal to the last bit, which noise does not allow for two exposures.

    Frames without any variation (all black, all saturated) are no evidence and are left out.
    """
    seen: dict[int, int] = {}
    pairs = []
    for i, frame in enumerate(frames):
        digest = xxhash.xxh3_64_intdigest(np.ascontiguousarray(frame).data)
        if digest in seen and frame.min() != frame.max():
            pairs.append((seen[digest], i))
        seen.setdefault(digest, i)
    return pairs


def check_sequence(
    frames: Pixels, planned: PatternSequence, saturated_dn: int, history: SequenceHistory | None = None
) -> SequenceCheck:
    """Compare what (N, H, W) ``frames`` show with what ``planned`` asks for.

    Parameters
    ----------
    frames
        (N, H, W) grey values.
    planned
        The plan of the sequence. Of fringes under a carrier, whose mean and modulation are not those of other
        sequences, and of what shows no fringes (`scanner.integrity.profiles`) the history neither tells nor learns.
    saturated_dn
        Grey value from which a pixel is left out.
    history
        Of the scan that the sequence is part of; it learns from a good one. Without it a sequence is judged alone: then
        it may belong to another pattern altogether or begin at another step, and with three steps, or one of each
        frequency, only repeated frames are found.
    """
    if history and (isinstance(planned, ProfileSequence) or planned.carrier is not None):
        history.ended(grid(frames.shape[1:]).take_all(frames[-1:])[0], good=False)
        history = None
    count = len(planned)
    findings = [
        Finding(j, f"frame {j + 1} is frame {i + 1} over again, to the last bit") for i, j in repeated_frames(frames)
    ]
    if isinstance(planned, ProfileSequence):
        more, share, blind = check_pairs(frames, planned, saturated_dn)
        return SequenceCheck(tuple(findings + more), np.full(count, np.nan), share, blind)
    fringes = planned
    cells = grid(frames.shape[1:])
    values = cells.take_all(frames)
    valid = unsaturated(values, saturated_dn)
    stepped = sum(f.frequency == fringes.fringes[0].frequency for f in fringes.fringes)
    steps = fringes.steps_rad[:stepped]
    reference = None
    if history and stepped < _OWN_REDUNDANCY:
        reference = history.reference(values[:stepped], valid)
    waveform = fit(
        values[:stepped],
        valid,
        steps,
        reference,
        history.noise_dn if history else np.inf,
        history.round_noise if history else None,
    )
    found = np.full(count, np.nan)
    if not findings and reference is None and 3 < stepped < 6 and np.count_nonzero(valid) >= FEWEST:
        findings += wrong_steps(values[:stepped, valid], steps)
    if np.count_nonzero(waveform.usable) >= FEWEST:
        if not findings:
            findings += _errors(
                values[:stepped],
                steps,
                waveform,
                reference,
                cells,
                found,
                bool(history and history.linear),
                history.latest if history else None,
            )
            if history and reference and findings and history.doubt_former(fringes, waveform, valid, cells, stepped):
                findings = []
        if history and not findings:
            findings += _among_others(values, valid, fringes, waveform, history, cells)
    elif history and not findings and (lost := history.lost_light(values[:stepped], waveform, valid)):
        findings.append(Finding(SEQUENCE, lost))
    if history:
        if findings and history.begins_with_the_former(values[:stepped], steps, waveform, valid):
            findings.insert(0, Finding(0, "frame 1 is still the last picture of the sequence before"))
        history.ended(values[-1], not findings)
        if not findings:
            history.accept(fringes, waveform, valid)
    blind = "" if stepped >= 6 or reference else _blind_to(stepped)
    return SequenceCheck(tuple(sorted(findings, key=lambda f: f.frame)), found, waveform.share, blind)


def _errors(
    values: NDArray[np.float32],
    steps: NDArray[np.float64],
    waveform: Waveform,
    reference: Reference | None,
    cells: Grid,
    found: NDArray[np.float64],
    linear: bool,
    former: NDArray[np.float32] | None,
) -> list[Finding]:
    """Errors of single frames; ``found`` takes the steps that the frames had."""
    found[: len(steps)] = steps
    if free_harmonics(len(steps)) > 1:
        beyond = excess(waveform, cells)
        beyond = np.concatenate([beyond, formed_excess(waveform, steps, cells, former)])
        if linear:
            beyond = np.concatenate([beyond, harmonic_excess(waveform, cells)])
        if beyond.max() > 1:
            return _named(values, steps, waveform, beyond, cells, found)
    elif len(steps) > 3 and reference is None:
        alone = of_own_fringe(waveform)
        if alone.max() > _FEW_STEPS_ERROR:
            return _named(values, steps, waveform, alone[:, None] / _FEW_STEPS_ERROR, cells, found)
    if reference is not None:
        mean = other_mean(waveform, reference, len(steps), cells)
        if mean.max() > 1:
            where = cells.rows(mean[:-1] > 1, mean[:-1] != 0)
            what = f"the mean of the {len(steps)} steps is not that of the sequences before{where}"
            return [Finding(SEQUENCE, f"{what}: a stale, torn, mixed, dark or flickering frame among them")]
    return []


def _named(
    values: NDArray[np.float32],
    steps: NDArray[np.float64],
    waveform: Waveform,
    beyond: NDArray[np.float64],
    cells: Grid,
    found: NDArray[np.float64],
) -> list[Finding]:
    there, where = waveform.usable, ""
    tile = int(beyond.max(axis=0).argmax())
    if tile < beyond.shape[1] - 1:
        there = there & (cells.tile == tile)
        where = cells.rows(beyond[:, :-1].max(axis=0) > 1, np.abs(beyond[:, :-1]).max(axis=0) > 0)
    named = culprits(values[:, there], steps, waveform.sigma_dn, free_harmonics(len(steps)))
    for culprit in named:
        found[culprit.frame] = culprit.step_rad
    if named:
        return [Finding(c.frame, c.message(steps) + where) for c in named]
    return [
        Finding(
            SEQUENCE,
            f"the frames do not show the planned steps{where}: several are stale, swapped, torn or mixed, something "
            "moved, or the light flickers",
        )
    ]


def _among_others(
    values: NDArray[np.float32],
    valid: NDArray[np.bool_],
    fringes: FringeSequence,
    waveform: Waveform,
    history: SequenceHistory,
    cells: Grid,
) -> list[Finding]:
    """What only the sequences before, or the code of several frequencies, can tell."""
    few = fringes.frequency is None or len(fringes.fringes) < 6
    stepped = values[: np.count_nonzero([f.frequency == fringes.fringes[0].frequency for f in fringes.fringes])]
    if few and history.begins_with_the_former(stepped, fringes.steps_rad[: len(stepped)], waveform, valid):
        return [Finding(0, "frame 1 is still the last picture of the sequence before")]
    told = [history.lost_light(stepped, waveform, valid)]
    extent = history.extent(fringes.axis)
    if fringes.frequency is not None:
        told += [history.shown_before(fringes, waveform), history.elsewhere(fringes, waveform)]
    elif extent is not None:
        return [Finding(SEQUENCE, t) for t in told if t] + wrong_codes(values, fringes, extent, waveform, cells)
    return [Finding(SEQUENCE, t) for t in told if t][:1]


def _blind_to(steps: int) -> str:
    if steps == 3:
        return (
            "three steps fit any three frames, and no picture before tells their mean: only repeated frames would show"
        )
    return f"{steps} steps, and no picture before that tells their mean: only large errors of whole frames would show"
