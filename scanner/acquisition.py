"""The state machine that runs a method on a bench: all rounds, every sequence checked, everything journalled.

    IDLE → PREFLIGHT → CAPTURING ⇄ REPEATING
                          ↓  ↑ (regional rounds)
                        DECODING → COMPLETED          any state → CANCELLED | FAILED

While one sequence is photographed, a second thread checks, commits and demodulates the one before it. A sequence that
fails its check, or in which a device failed, is taken again, at most as often as the scan allows; the bench brings a
device back that was lost. When all sequences of a round are there, they are compared: one that is at odds with the
others is revoked and taken again as well. On every way out the projector is dark.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol

import cv2
import numpy as np

from drivers import Bench, HardwareError, OperatorError, Pixels
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.integrity import SequenceHistory, check_sequence
from scanner.methods import Method, RoundFrames
from scanner.patterns import Plan
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


class ExposureError(OperatorError):
    """The picture is too bright or too dark to measure with."""


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
    """

    bench: Bench
    method: Method
    scan: ScanSection
    decoder: Decoder
    take: TakeWriter
    listener: Listener = field(default_factory=Silence)
    response: tuple[float, ...] | None = None
    state: ScanState = field(default=ScanState.IDLE, init=False)
    timings_s: dict[str, float] = field(default_factory=dict, init=False)
    frames: dict[int, int] = field(default_factory=dict, init=False)
    repeats: int = field(default=0, init=False)
    notes: list[str] = field(default_factory=list, init=False)
    _done: int = field(default=0, init=False)
    _history: SequenceHistory = field(default_factory=SequenceHistory, init=False)

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
                levels = self._preflight(first_plan)
                self._history.begin_round(
                    first_plan.size, levels=levels, saturated_dn=self.bench.frame_format.saturated_dn
                )
                first = self._capture(1, first_plan, first_plan.frame_count)
                self._enter(ScanState.DECODING, "decoding round 1")
                with self._timed("decode round 1"):
                    regional = self.decoder.first(first)
                self._tell_decision("")
                number, before = 1, first_plan.frame_count
                while regional is not None:
                    number += 1
                    found = self.decoder.maps
                    self._history.begin_round(
                        regional.size,
                        levels=self._levels(regional),
                        saturated_dn=self.bench.frame_format.saturated_dn,
                        coordinates=(found.x_p, found.y_p),
                        lit=regional.mask,
                    )
                    to_come = (self.decoder.rounds - number + 1) * regional.frame_count
                    frames = self._capture(number, regional, before + to_come)
                    before += regional.frame_count
                    self._enter(ScanState.DECODING, f"decoding round {number}")
                    told = self.decoder.decision
                    with self._timed(f"decode round {number}"):
                        regional = self.decoder.regional(frames)
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

    @contextmanager
    def _dark_afterwards(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._darken_if_possible()
            raise
        self.bench.darken()

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

    def _preflight(self, plan: Plan) -> tuple[Pixels, Pixels]:
        """Look at the brightest and the darkest picture before anything is measured; returns their frames."""
        bright, dark = self._levels(plan)
        check_exposure(bright, dark, self.bench.frame_format.saturated_dn, self.scan.max_saturated_share)
        return bright, dark

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
        """Photograph all sequences of a round; returns what the method collected of them."""
        self.take.begin_round(number, plan.to_json())
        collected = self.method.collect(plan, self.bench.frame_format)
        self._enter(ScanState.CAPTURING, f"round {number} of {self._rounds}")
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
        self.frames[number] = plan.frame_count
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
        fringes = plan.sequences[sequence]
        self.bench.prepare(plan.render(sequence))
        for index in range(len(frames)):
            stamp = self.bench.expose(index, frames[index])
            self.take.write_frame(number, sequence, attempt, index, frames[index], stamp)
            self._done += 1
            self.listener.frame(
                Progress(
                    round=number,
                    rounds=self._rounds,
                    sequence=sequence + 1,
                    sequences=len(plan.sequences),
                    label=fringes.label,
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

        def job() -> list[str]:
            found = check_sequence(
                frames, plan.sequences[sequence], self.bench.frame_format.saturated_dn, self._history
            )
            if not found.good:
                reasons = [f.message for f in found.findings]
                self.take.abort_sequence(number, sequence, attempt, "; ".join(reasons))
                return reasons
            self.take.commit_sequence(number, sequence, attempt)
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
            label = plan.sequences[sequence].label
            raise AcquisitionError(
                f"round {number}, sequence {sequence + 1} ({label}) failed its check on {attempt} attempts: "
                + "; ".join(reasons),
                "Raise the bench's settle time (display latency), and check that nothing moves and no light flickers.",
            )
        return self._again(number, plan, sequence, attempt, reasons[0])

    def _at_odds(self, number: int, plan: Plan, attempts: Mapping[int, int]) -> list[tuple[int, int]]:
        """Revoke sequences that the rest of their round contradicts; returns them, each with its next attempt."""
        again = []
        for found in self._history.at_odds(self.bench.frame_format.shape):
            places = [(s.axis, s.frequency) for s in plan.sequences]
            sequence = places.index((found.axis, found.frequency))
            attempt = attempts[sequence]
            self.take.abort_sequence(number, sequence, attempt, found.message)
            again += self._refused(number, plan, sequence, attempt, [found.message])
        return again

    def _collect_again(self, number: int, plan: Plan) -> RoundFrames:
        """Collect what still counts of a round from the recording: no trace is left of what was revoked."""
        collected = self.method.collect(plan, self.bench.frame_format)
        for sequence in range(len(plan.sequences)):
            frames = self.take.committed_frames(number, sequence)
            if frames is not None:
                collected.add(sequence, frames)
        return collected

    def _broken(
        self, number: int, plan: Plan, sequence: int, attempt: int, error: HardwareError
    ) -> list[tuple[int, int]]:
        """Record that a device failed within a sequence; returns it again, with the next attempt, where that helps."""
        self._darken_if_possible()
        self.take.abort_sequence(number, sequence, attempt, error.message)
        if not error.repeatable or attempt >= self.scan.attempts:
            raise error
        return self._again(number, plan, sequence, attempt, error.message)

    def _again(self, number: int, plan: Plan, sequence: int, attempt: int, reason: str) -> list[tuple[int, int]]:
        fringes = plan.sequences[sequence]
        self.repeats += len(fringes)
        self._enter(ScanState.REPEATING, f"{fringes.label}, attempt {attempt + 1}")
        self._note(f"round {number}, {fringes.label}: {reason}; the sequence was taken again")
        self._enter(ScanState.CAPTURING, f"round {number} of {self._rounds}")
        return [(sequence, attempt + 1)]


def check_exposure(bright: Pixels, dark: Pixels, saturated_dn: int, max_saturated_share: float) -> None:
    """Refuse pictures that cannot be measured with.

    Parameters
    ----------
    bright, dark
        (H, W) frames of the brightest and the darkest level of the fringes.
    saturated_dn
        Grey value from which a pixel is saturated.
    max_saturated_share
        Share of the pixels that may be.

    Raises
    ------
    ExposureError
        Too many saturated pixels, or hardly any that the projector makes brighter.
    """
    share = float((bright >= saturated_dn).mean())
    if share > max_saturated_share:
        raise ExposureError(
            f"exposure check: {100 * share:.1f} % of the pixels are saturated under full light, "
            f"at most {100 * max_saturated_share:g} % may be",
            "Shorten bench.camera.exposure_us, close the aperture, or allow more with scan.max_saturated_share.",
        )
    # Averaged over 8 × 8 pixels, so that noise does not pass for light.
    contrast = cv2.blur(bright.astype(np.float32) - dark, (8, 8))
    lit = float((contrast > max(0.02 * saturated_dn, 4)).mean())
    if lit < 0.001:
        raise ExposureError(
            f"exposure check: the projector makes {100 * lit:.2f} % of the pixels brighter "
            f"(brightest grey value {int(bright.max())} of {saturated_dn})",
            "Take the lens caps off, switch the projector on, point both at the object, or lengthen the exposure.",
        )
