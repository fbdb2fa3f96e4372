"""The state machine that runs a method on a bench: all rounds, every sequence checked, everything journalled.

    IDLE → PREFLIGHT → CAPTURING ⇄ REPEATING
                          ↓  ↑ (regional rounds)
                        DECODING → COMPLETED          any state → CANCELLED | FAILED

While one sequence is photographed, a second thread checks, commits and demodulates the one before it. A sequence that
fails its check, or in which a device failed, is taken again, at most as often as the scan allows; the bench brings a
device back that was lost. When all sequences of a round are there, they are compared: one that is at odds with the
others is revoked and taken again as well. On every way out the projector is dark.

With several exposures a round is several such passes, one after the other, whose frames are then fused.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Protocol, cast

import numpy as np

from drivers import Bench, ExposureControl, HardwareError, NoiseModel, OperatorError, Pixels
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.exposures import ExposurePass, ExposureSeries, agree, fuse
from scanner.integrity import SequenceHistory, check_sequence
from scanner.methods import Method, RoundFrames
from scanner.patterns import Plan
from scanner.preflight import check_exposure, check_exposures
from scanner.result import Maps
from scanner.take import TakeWriter


class ScanState(StrEnum):
    """Where a scan is."""

    IDLE = "idle"
    PREFLIGHT = "preflight"
    CAPTURING = "capturing"
    REPEATING = "repeating"
    DECODING = "decoding"
    COMPLETED = "completed"
    CANCELLED = "cancelled"
    FAILED = "failed"


_ENDS = frozenset({ScanState.COMPLETED, ScanState.CANCELLED, ScanState.FAILED})
_LOST = frozenset({ScanState.CANCELLED, ScanState.FAILED})
TRANSITIONS: Mapping[ScanState, frozenset[ScanState]] = {
    ScanState.IDLE: frozenset({ScanState.PREFLIGHT}) | _LOST,
    ScanState.PREFLIGHT: frozenset({ScanState.CAPTURING}) | _LOST,
    ScanState.CAPTURING: frozenset({ScanState.REPEATING, ScanState.DECODING}) | _LOST,
    ScanState.REPEATING: frozenset({ScanState.CAPTURING}) | _LOST,
    ScanState.DECODING: frozenset({ScanState.CAPTURING, ScanState.COMPLETED}) | _LOST,
    **{end: frozenset() for end in _ENDS},
}
"""The moves that a scan may make."""


class AcquisitionError(HardwareError):
    """The bench does not deliver frames that show the patterns."""


@dataclass(frozen=True)
class Progress:
    """How far a scan has come.

    Parameters
    ----------
    round, rounds
        From 1.
    sequence, sequences
        From 1; ``label`` names the sequence.
    frame, frames
        Within the sequence, from 1.
    done, total
        Frames of the whole scan as far as its rounds are known.
    attempt
        From 1.
    """

    round: int
    rounds: int
    sequence: int
    sequences: int
    label: str
    frame: int
    frames: int
    done: int
    total: int
    attempt: int


class Listener(Protocol):
    """Who wants to know how a scan goes: the terminal, a window, a test."""

    def state(self, state: ScanState, what: str) -> None:
        """A new state was entered; ``what`` says it in words."""
        ...

    def frame(self, progress: Progress) -> None:
        """A frame was taken."""
        ...

    def note(self, text: str) -> None:
        """Something the operator should read."""
        ...


class Silence:
    """A listener that ignores everything."""

    def state(self, state: ScanState, what: str) -> None:
        """Ignore."""

    def frame(self, progress: Progress) -> None:
        """Ignore."""

    def note(self, text: str) -> None:
        """Ignore."""


@dataclass
class Acquisition:
    """One scan on an open bench.

    Parameters
    ----------
    bench
        Open; the caller closes it.
    method, scan
        What to do.
    decoder
        Decodes the rounds; knows noise and rig.
    take
        Where everything is recorded; the caller ends it.
    listener
        Is told how it goes.
    response
        Light of the projector's grey levels that the patterns are corrected for, as `scanner.patterns.Plan`.
    exposures
        What the bench has agreed to of ``scan.exposures``; None for a single one.
    """

    bench: Bench
    method: Method
    scan: ScanSection
    decoder: Decoder
    take: TakeWriter
    listener: Listener = field(default_factory=Silence)
    response: tuple[float, ...] | None = None
    exposures: ExposureSeries | None = None
    state: ScanState = field(default=ScanState.IDLE, init=False)
    timings_s: dict[str, float] = field(default_factory=dict, init=False)
    frames: dict[int, int] = field(default_factory=dict, init=False)
    repeats: int = field(default=0, init=False)
    notes: list[str] = field(default_factory=list, init=False)
    exposure_figures: list[dict[str, Any]] = field(default_factory=list, init=False)
    _done: int = field(default=0, init=False)
    _histories: list[SequenceHistory] = field(default_factory=list, init=False)
    _exposure: int = field(default=0, init=False)

    def run(self) -> Maps:
        """All rounds; returns the fused maps.

        Raises
        ------
        ExposureError
            The preflight pictures are too bright or too dark.
        AcquisitionError
            A sequence failed its check on every attempt.
        HardwareError
            A device failed.
        """
        try:
            with self._dark_afterwards():
                planned = self.method.first_round(self.scan, self.bench.projector_size)
                first_plan = replace(planned, response=self.response)
                self._enter(ScanState.PREFLIGHT, "exposure check")
                if self.exposures is None:
                    self.exposures = agree(self.bench, self.scan.exposures)
                self._histories = [SequenceHistory() for _ in range(self._passes)]
                levels = self._preflight(first_plan)
                first, noise = self._round(1, first_plan, first_plan.frame_count, levels)
                self._enter(ScanState.DECODING, "decoding round 1")
                with self._timed("decode round 1"):
                    regional = self.decoder.first(first, noise)
                self._tell_decision("")
                number, before = 1, first_plan.frame_count
                while regional is not None:
                    number += 1
                    to_come = (self.decoder.rounds - number + 1) * regional.frame_count
                    frames, noise = self._round(number, regional, before + to_come, None)
                    before += regional.frame_count
                    self._enter(ScanState.DECODING, f"decoding round {number}")
                    told = self.decoder.decision
                    with self._timed(f"decode round {number}"):
                        regional = self.decoder.regional(frames, noise)
                    self._tell_decision(told)
            self._enter(ScanState.COMPLETED, "done")
            return self.decoder.maps
        except KeyboardInterrupt:
            self._enter(ScanState.CANCELLED, "interrupted by the operator")
            raise
        except BaseException:
            self._enter(ScanState.FAILED, "failed")
            raise

    def _tell_decision(self, told: str) -> None:
        """Say what was decided about further rounds, unless that was ``told`` before."""
        if self.decoder.decision != told:
            self.listener.note(self.decoder.decision)
            self.take.note(self.decoder.decision)

    @property
    def _rounds(self) -> int:
        """Rounds, as far as is known."""
        return max(self.scan.rounds_at_most(self.method.rounds), self.decoder.rounds)

    @property
    def _passes(self) -> int:
        """Exposures of a round."""
        return 1 if self.exposures is None else len(self.exposures)

    @property
    def _history(self) -> SequenceHistory:
        """Of the present exposure: at another, a picture looks different."""
        return self._histories[self._exposure]

    @contextmanager
    def _dark_afterwards(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._darken_if_possible()
            raise
        self.bench.darken()
        # Not on the way out of trouble, where it would wait for a lost camera once more; and what is measured counts.
        if self.exposures is not None and isinstance(self.bench, ExposureControl):
            with suppress(HardwareError):
                self.bench.set_exposure(self.exposures.reference_s)

    def _darken_if_possible(self) -> None:
        """Switch the light off on the way out of trouble, which a projector that fails as well must not hide."""
        with suppress(HardwareError):
            self.bench.darken()

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.timings_s[what] = self.timings_s.get(what, 0.0) + time.perf_counter() - began

    def _enter(self, state: ScanState, what: str) -> None:
        if state not in TRANSITIONS[self.state]:
            if self.state in _ENDS:
                return
            raise AssertionError(f"{self.state} → {state} is no move of a scan")
        self.state = state
        # A disk that failed must not hide why the scan ends.
        if state in _LOST:
            try:
                self.take.state(state)
            except (OperatorError, OSError):
                self.listener.note("the last state could not be written to the recording")
        else:
            self.take.state(state)
        self.listener.state(state, what)

    def _note(self, text: str) -> None:
        self.notes.append(text)
        self.listener.note(text)

    def _preflight(self, plan: Plan) -> list[tuple[Pixels, Pixels]]:
        """Look at the brightest and the darkest picture before anything is measured; returns their frames.

        With several exposures the shortest must not be too bright, and the longest not too dark.
        """
        levels = []
        for exposure in range(self._passes):
            self._expose_for(exposure)
            levels.append(self._levels(plan))
        saturated_dn, share = self.bench.frame_format.saturated_dn, self.scan.max_saturated_share
        if self.exposures is None:
            check_exposure(*levels[0], saturated_dn, share)
        else:
            check_exposures(levels, self.exposures, saturated_dn, share)
        return levels

    def _expose_for(self, exposure: int) -> None:
        """Have the sequences from now on taken at this exposure of the series."""
        self._exposure = exposure
        if self.exposures is None:
            return
        assert isinstance(self.bench, ExposureControl)
        for attempt in range(1, self.scan.attempts + 1):
            try:
                self.bench.set_exposure(self.exposures.made_s[exposure])
                return
            except HardwareError as error:
                if not error.repeatable or attempt == self.scan.attempts:
                    raise
                self._note(f"{self.exposures.label(exposure)}: {error.message}; it was set again")

    def _round(
        self, number: int, plan: Plan, planned: int, levels: list[tuple[Pixels, Pixels]] | None
    ) -> tuple[RoundFrames, NoiseModel | None]:
        """Take a round at all exposures; returns what the method collected, and the noise where it was fused.

        Parameters
        ----------
        number, plan
            Of the round.
        planned
            Frames of all rounds so far, at one exposure.
        levels
            Frames of the brightest and the darkest picture at each exposure; None takes them now.
        """
        series = self.exposures
        passes: list[RoundFrames] = []
        for exposure in range(self._passes):
            self._expose_for(exposure)
            found = self.decoder.maps if number > 1 else None
            self._history.begin_round(
                plan.size,
                levels=self._levels(plan) if levels is None else levels[exposure],
                saturated_dn=self.bench.frame_format.saturated_dn,
                coordinates=(None, None) if found is None else (found.x_p, found.y_p),
                lit=plan.mask,
            )
            if not passes:
                self.take.begin_round(number, plan.to_json() if series is None else series.recorded(plan))
                self._enter(ScanState.CAPTURING, f"round {number} of {self._rounds}")
            passes.append(self._capture(number, plan, planned * self._passes))
        self.frames[number] = plan.frame_count * self._passes
        if series is None:
            return passes[0], None
        with self._timed(f"fuse round {number}"):
            fused = fuse(
                self.method,
                plan,
                series,
                cast("list[ExposurePass]", passes),
                lambda exposure, sequence: self._recorded(number, exposure * len(plan.sequences) + sequence),
                self.decoder.noise_at,
            )
        for warning in fused.warnings:
            self._note(f"round {number}: {warning}")
        self.exposure_figures = self.exposure_figures or fused.figures
        return fused.frames, fused.noise

    def _recorded(self, number: int, sequence: int) -> Pixels:
        """Frames of a sequence that was committed, as the recording numbers it."""
        frames = self.take.committed_frames(number, sequence)
        assert frames is not None
        return frames

    def _in_take(self, plan: Plan, sequence: int) -> int:
        """Number of a sequence of the plan in the recording, where every exposure has its own."""
        return self._exposure * len(plan.sequences) + sequence

    def _collection(self, plan: Plan) -> RoundFrames:
        """An empty collection for the frames of a pass."""
        if self.exposures is None:
            return self.method.collect(plan, self.bench.frame_format)
        return ExposurePass(plan, self.bench.frame_format, self.method)

    def _label(self, plan: Plan, sequence: int) -> str:
        """Short name of a sequence, with its exposure where there are several."""
        label = plan.sequences[sequence].label
        return label if self.exposures is None else f"{label}, {self.exposures.label(self._exposure)}"

    def _levels(self, plan: Plan) -> tuple[Pixels, Pixels]:
        """Frames under the brightest and the darkest level of the fringes, where the plan lights at all."""
        width, height = self.bench.projector_size
        levels = (plan.mean + plan.amplitude, plan.mean - plan.amplitude)
        pictures = [np.full((height, width), plan.grey(level), np.uint8) for level in levels]
        if plan.mask is not None:
            pictures = [np.where(plan.mask, picture, np.uint8(0)) for picture in pictures]
        fmt = self.bench.frame_format
        bright, dark = (np.empty(fmt.shape, fmt.dtype) for _ in range(2))
        for attempt in range(1, self.scan.attempts + 1):
            try:
                self.bench.prepare(pictures)
                self.bench.expose(0, bright)
                self.bench.expose(1, dark)
                break
            except HardwareError as error:
                if not error.repeatable or attempt == self.scan.attempts:
                    raise
                self._note(f"exposure check: {error.message}; it was made again")
        self.bench.darken()
        return bright, dark

    def _capture(self, number: int, plan: Plan, total: int) -> RoundFrames:
        """Photograph all sequences of a round at the present exposure; returns what was collected of them."""
        collected = self._collection(plan)
        fmt = self.bench.frame_format
        longest = max(len(s) for s in plan.sequences)
        # Two buffers take turns: one is being filled while the other is checked and demodulated.
        buffers = [np.zeros((longest, *fmt.shape), fmt.dtype) for _ in range(2)]
        queue = [(sequence, 1) for sequence in range(len(plan.sequences))]
        attempts: dict[int, int] = {}
        pending: tuple[int, int, Future[list[str]]] | None = None
        turn = 0
        with ThreadPoolExecutor(1, thread_name_prefix="decode") as worker, self._timed(f"capture round {number}"):
            try:
                while True:
                    if not queue and pending is None:
                        queue = self._at_odds(number, plan, attempts)
                        if not queue:
                            break
                        collected = self._collect_again(number, plan)
                    launched = None
                    if queue:
                        sequence, attempt = queue.pop(0)
                        attempts[sequence] = attempt
                        frames = buffers[turn % 2][: len(plan.sequences[sequence])]
                        try:
                            self._expose_sequence(number, plan, sequence, attempt, frames, total)
                        except HardwareError as error:
                            queue[:0] = self._broken(number, plan, sequence, attempt, error)
                        else:
                            turn += 1
                            job = self._finish_sequence(number, plan, sequence, attempt, frames, collected)
                            launched = (sequence, attempt, worker.submit(job))
                    if pending is not None:
                        again = self._settle(number, plan, *pending)
                        queue[:0] = again
                    pending = launched
            except BaseException:
                # Before the worker is waited for: whatever went wrong, the light goes out at once.
                self._darken_if_possible()
                raise
        self.bench.darken()
        self._note_counters(number)
        return collected

    def _note_counters(self, number: int) -> None:
        """Write what the devices have counted so far into the recording."""
        devices = self.bench.describe()
        counters = {n: d["counters"] for n, d in devices.items() if isinstance(d, Mapping) and "counters" in d}
        if counters:
            self.take.note(f"counters after round {number}: {json.dumps(counters)}")

    def _expose_sequence(
        self, number: int, plan: Plan, sequence: int, attempt: int, frames: Pixels, total: int
    ) -> None:
        self.bench.prepare(plan.render(sequence))
        for index in range(len(frames)):
            stamp = self.bench.expose(index, frames[index])
            self.take.write_frame(number, self._in_take(plan, sequence), attempt, index, frames[index], stamp)
            self._done += 1
            self.listener.frame(
                Progress(
                    round=number,
                    rounds=self._rounds,
                    sequence=self._in_take(plan, sequence) + 1,
                    sequences=len(plan.sequences) * self._passes,
                    label=self._label(plan, sequence),
                    frame=index + 1,
                    frames=len(frames),
                    done=self._done,
                    total=total + self.repeats,
                    attempt=attempt,
                )
            )

    def _finish_sequence(
        self, number: int, plan: Plan, sequence: int, attempt: int, frames: Pixels, collected: RoundFrames
    ) -> Callable[[], list[str]]:
        """Check, record and demodulate; returns what is wrong with the sequence."""
        recorded = self._in_take(plan, sequence)

        def job() -> list[str]:
            found = check_sequence(
                frames, plan.sequences[sequence], self.bench.frame_format.saturated_dn, self._history
            )
            if not found.good:
                reasons = [f.message for f in found.findings]
                self.take.abort_sequence(number, recorded, attempt, "; ".join(reasons))
                return reasons
            self.take.commit_sequence(number, recorded, attempt)
            collected.add(sequence, frames)
            return []

        return job

    def _settle(
        self, number: int, plan: Plan, sequence: int, attempt: int, job: Future[list[str]]
    ) -> list[tuple[int, int]]:
        """Wait for a sequence's check; returns it again, with the next attempt, where it failed."""
        reasons = job.result()
        return self._refused(number, plan, sequence, attempt, reasons) if reasons else []

    def _refused(
        self, number: int, plan: Plan, sequence: int, attempt: int, reasons: list[str]
    ) -> list[tuple[int, int]]:
        """Return a sequence that failed its check again, with the next attempt, where there is one."""
        if attempt >= self.scan.attempts:
            raise AcquisitionError(
                f"round {number}, sequence {sequence + 1} ({self._label(plan, sequence)}) failed its check on "
                f"{attempt} attempts: " + "; ".join(reasons),
                "Raise the bench's settle time (display latency), and check that nothing moves and no light flickers.",
            )
        return self._again(number, plan, sequence, attempt, reasons[0])

    def _at_odds(self, number: int, plan: Plan, attempts: Mapping[int, int]) -> list[tuple[int, int]]:
        """Revoke sequences that the rest of their round contradicts; returns them, each with its next attempt."""
        again = []
        for found in self._history.at_odds(self.bench.frame_format.shape, plan.rounding()):
            places = [(s.axis, s.frequency) for s in plan.sequences]
            sequence = places.index((found.axis, found.frequency))
            attempt = attempts[sequence]
            self.take.abort_sequence(number, self._in_take(plan, sequence), attempt, found.message)
            again += self._refused(number, plan, sequence, attempt, [found.message])
        return again

    def _collect_again(self, number: int, plan: Plan) -> RoundFrames:
        """Collect what still counts of a round from the recording: no trace is left of what was revoked."""
        collected = self._collection(plan)
        for sequence in range(len(plan.sequences)):
            frames = self.take.committed_frames(number, self._in_take(plan, sequence))
            if frames is not None:
                collected.add(sequence, frames)
        return collected

    def _broken(
        self, number: int, plan: Plan, sequence: int, attempt: int, error: HardwareError
    ) -> list[tuple[int, int]]:
        """Record that a device failed within a sequence; returns it again, with the next attempt, where that helps."""
        self._darken_if_possible()
        self.take.abort_sequence(number, self._in_take(plan, sequence), attempt, error.message)
        if not error.repeatable or attempt >= self.scan.attempts:
            raise error
        return self._again(number, plan, sequence, attempt, error.message)

    def _again(self, number: int, plan: Plan, sequence: int, attempt: int, reason: str) -> list[tuple[int, int]]:
        label = self._label(plan, sequence)
        self.repeats += len(plan.sequences[sequence])
        self._enter(ScanState.REPEATING, f"{label}, attempt {attempt + 1}")
        self._note(f"round {number}, {label}: {reason}; the sequence was taken again")
        self._enter(ScanState.CAPTURING, f"round {number} of {self._rounds}")
        return [(sequence, attempt + 1)]
