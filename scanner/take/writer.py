"""Recording a take, so that it survives being cut off anywhere."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import shutil
import threading
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, get_args

import numpy as np

from drivers.devices import Clock, FrameFormat, FrameStamp, Pixels
from drivers.errors import OperatorError
from scanner.patterns import patterns_in
from scanner.take.journal import (
    FRAMES,
    GIVEN,
    JOURNAL,
    MANIFEST,
    PAGE,
    Document,
    EndStatus,
    FrameRecord,
    RecordedSequence,
    TakeError,
    TakeRefusedError,
    compact,
    digest,
    schema_of,
    seal,
)
from scanner.take.reader import Take


@dataclass(frozen=True)
class Resumption:
    """A take that goes on.

    Parameters
    ----------
    writer
        Appends to it.
    take
        What was there, for its plans, frames and rig.
    committed
        (round, sequence) that are there with sound pixels; all others are to be recorded.
    next_slot
        The first free slot.
    """

    writer: TakeWriter
    take: Take
    committed: frozenset[tuple[int, int]]
    next_slot: int


class TakeWriter:
    """Records a take; made by `create` or `resume`, and used as a context manager.

    Leaving the context always writes the end record, unless `end` was called: ``completed``; ``cancelled`` after
    `KeyboardInterrupt`; ``failed``, with the reason, after any other exception.

    One thread may write frames while another commits the sequence before: the disk does not hold up the writing.
    Every method raises `TakeError` when the disk does not take the data, and says how many frames are safe.
    """

    def __init__(self, path: Path, frame_format: FrameFormat, clock: Clock | None) -> None:
        self.path = path
        self.frame_format = frame_format
        self._clock = clock
        self._stride = -(-math.prod(frame_format.shape) * frame_format.dtype.itemsize // PAGE) * PAGE
        self._lock = threading.RLock()
        self._files = ExitStack()
        self._frames_fd = self._journal_fd = -1
        self._capacity = self._next_slot = 0
        self._torn_bytes: int | None = None
        self._rounds: dict[int, Document] = {}
        self._plan_checksums: dict[int, str] = {}
        self._unclaimed: dict[tuple[int, int, int], dict[int, FrameRecord]] = {}
        self._safe: dict[tuple[int, int], RecordedSequence] = {}
        self._sync_failed = self._ended = False

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        frame_format: FrameFormat,
        slots: int,
        manifest: Document,
        clock: Clock | None = None,
    ) -> TakeWriter:
        """Begin a new take.

        Parameters
        ----------
        path
            The folder; it must not exist.
        frame_format
            Size and depth of the frames.
        slots
            Frames to make room for; more is added when a retry or the second round needs it.
        manifest
            JSON-ready ``method`` (name), ``bench`` and ``config`` (documents), ``plans`` (list of the plan documents
            known by now, round one first), ``simulated``; where known ``rig`` (document) and ``noise``
            (``read_dn``, ``dn_per_electron``). Anything else is recorded as it is.
        clock
            The bench's clock, for the time of records; None leaves it out.

        Raises
        ------
        TakeRefusedError
            The folder exists or cannot be made, or the disk has less than 1.1 × the room that the frames need.
        """
        if lacking := [key for key in GIVEN if key not in manifest]:
            raise ValueError(f"the manifest of a take lacks {', '.join(lacking)}")
        self = cls(Path(path), frame_format, clock)
        document = {
            "schema": schema_of(manifest),
            "uid": uuid.uuid4().hex,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "rig": None,
            "noise": None,
            **manifest,
            "width": frame_format.width,
            "height": frame_format.height,
            "bits": frame_format.bits,
            "dtype": frame_format.dtype.str,
            "shape": frame_format.shape,
            "stride": self._stride,
        }
        try:
            document = json.loads(json.dumps(document, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise TakeError(
                f"{path}: what the bench and the configuration say of themselves is not JSON: {error}",
                "This is a fault of the bench's describe() or of the calling program, please report it.",
            ) from None
        document["manifest_xxh3"] = digest(compact(document))
        try:
            self._preflight(slots)
            self._make_files(slots, json.dumps(document, indent=1))
        except OSError as error:
            raise TakeRefusedError(
                f"{path} cannot be made: {error.strerror}; nothing was recorded",
                "Check the folder's permissions and the space on the disk, or choose another folder.",
            ) from error
        return self

    @classmethod
    def resume(cls, path: str | os.PathLike[str], *, clock: Clock | None = None) -> Resumption:
        """Go on with a take that was cut off, cancelled or failed.

        Only adds to it: what is torn stays where it is and is marked so, and claimed slots are not touched.
        Sequences whose pixels are damaged are revoked, so that they can be recorded again.

        Raises
        ------
        TakeRefusedError
            The folder is no take, or a completed one, or may not be written, or another process is recording it.
        TakeError
            It cannot be read; see `Take.open`.
        """
        path = Path(path)
        self = cls(path, Take.open(path).frame_format, clock)
        with ExitStack() as on_error:
            on_error.callback(self._files.close)
            try:
                self._open_files(os.O_RDWR)
            except OSError as error:
                raise TakeRefusedError(
                    f"{path} cannot be written: {error.strerror}",
                    "Check the permissions of the folder and its files.",
                ) from error
            # Only now, with all others kept out, does the journal stay as it is read.
            take = Take.open(path)
            if take.status == "completed":
                raise TakeRefusedError(f"{path} is complete: there is nothing to resume", "Process it.")
            damaged = {(f.round, f.sequence) for r in take.rounds for f in take.damaged(r)}
            self._stride = take.manifest["stride"]
            self._capacity = len(take._pixels) // self._stride
            self._next_slot = take._next_slot
            self._rounds = dict(take.rounds)
            self._plan_checksums = {r: digest(compact(plan)) for r, plan in take.rounds.items()}
            self._safe = {key: s for key, s in take._sequences.items() if key not in damaged}
            self._torn_bytes = take.torn_bytes
            with self._guard("resuming"):
                self._append("resumed")
                for s in (*take._lost, *(take._sequences[key] for key in sorted(damaged))):
                    attempt = _names((s.round, s.sequence, s.attempt))
                    self._append("sequence_aborted", **attempt, reason="its pixels are damaged")
                self._sync(self._journal_fd)
            on_error.pop_all()
        return Resumption(self, take, frozenset(self._safe), self._next_slot)

    def begin_round(self, round: int, plan: Document) -> None:
        """Say what a round projects; nothing happens where this very plan was begun already.

        Parameters
        ----------
        round
            From 1; all after the first are regional.
        plan
            `scanner.patterns.Plan.to_json`. Another plan than before makes the round's former sequences void.
        """
        text = compact(plan)
        plan = json.loads(text)
        with self._lock, self._guard(f"beginning round {round}"):
            self._check_open()
            if self._rounds.get(round) == plan:
                return
            self._reserve(self._next_slot + sum(patterns_in(s) for s in plan["sequences"]))
            self._append("round_begun", round=round, plan=plan)
            self._sync(self._journal_fd)
            self._rounds[round], self._plan_checksums[round] = plan, digest(text)
            self._safe = {key: s for key, s in self._safe.items() if key[0] != round}

    def write_frame(
        self, round: int, sequence: int, attempt: int, index: int, pixels: Pixels, stamp: FrameStamp
    ) -> int:
        """Write one frame to the next free slot and return the slot; it counts once its sequence is committed.

        Parameters
        ----------
        round, sequence, attempt
            Which sequence it belongs to, and which attempt at it.
        index
            Place of its pattern in the sequence, from 0.
        pixels
            (height, width) in the take's format; not copied where its memory is contiguous.
        stamp
            Device id and time stamps.
        """
        fmt = self.frame_format
        if pixels.shape != fmt.shape or pixels.dtype != fmt.dtype:
            raise TakeError(
                f"{self.path}: a frame is {pixels.shape} {pixels.dtype}, the take holds {fmt.shape} {fmt.dtype}",
                "Let nothing change the camera's format during a scan.",
            )
        data = np.ascontiguousarray(pixels).data.cast("B")
        checksum = digest(data)
        with self._lock, self._guard(f"writing frame {index} of sequence {sequence} in round {round}"):
            self._check_open()
            length = self._length(round, sequence)
            frames = self._unclaimed.setdefault((round, sequence, attempt), {})
            if index in frames or not 0 <= index < length:
                raise ValueError(f"frame {index} of sequence {sequence}: not in the plan, or written already")
            slot = self._next_slot
            if slot >= self._capacity:
                self._reserve(slot + length - len(frames))
            offset = slot * self._stride
            while data:
                written = os.pwrite(self._frames_fd, data, offset)
                data, offset = data[written:], offset + written
            frames[index] = FrameRecord(round, sequence, attempt, index, slot, stamp, checksum)
            self._next_slot = slot + 1
        return slot

    def commit_sequence(self, round: int, sequence: int, attempt: int) -> None:
        """Make a sequence count. When this returns it is on the disk, whatever happens next."""
        key = (round, sequence, attempt)
        with self._lock:
            self._check_open()
            length = self._length(round, sequence)
            if lacking := set(range(length)) - self._unclaimed.get(key, {}).keys():
                raise ValueError(f"sequence {sequence} of round {round} lacks its frames {sorted(lacking)}")
        with self._guard(f"committing sequence {sequence} of round {round}"):
            self._sync(self._frames_fd)
            with self._lock:
                self._check_open()
                written = self._claim(key)
                frames = tuple(written[index] for index in range(length))
                plan = self._plan_checksums[round]
                slots = [f.slot for f in frames]
                self._append("sequence_committed", **_names(key), plan_xxh3=plan, slots=slots)
            self._sync(self._journal_fd)
            self._safe[round, sequence] = RecordedSequence(round, sequence, attempt, frames)

    def abort_sequence(self, round: int, sequence: int, attempt: int, reason: str) -> None:
        """Say that an attempt does not count; its frames stay, for whoever wants to know why."""
        with self._guard(f"aborting sequence {sequence} of round {round}"), self._lock:
            self._check_open()
            self._sync(self._frames_fd)
            self._abort((round, sequence, attempt), reason)
            self._sync(self._journal_fd)

    def committed_frames(self, round: int, sequence: int) -> Pixels | None:
        """Read the (N, height, width) frames of a sequence that counts, in the order of the plan; None if none does."""
        recorded = self._safe.get((round, sequence))
        if recorded is None:
            return None
        fmt = self.frame_format
        length = math.prod(fmt.shape) * fmt.dtype.itemsize
        with self._guard(f"reading sequence {sequence} of round {round}"):
            data = [os.pread(self._frames_fd, length, slot * self._stride) for slot in recorded.slots]
        return np.stack([np.frombuffer(pixels, fmt.dtype).reshape(fmt.shape) for pixels in data])

    def note(self, text: str) -> None:
        """Add a line to the operator's log."""
        with self._lock, self._guard("writing a note"):
            self._check_open()
            self._append("note", text=text)

    def state(self, name: str) -> None:
        """Log that the scan's state machine came to state ``name``."""
        with self._lock, self._guard(f"logging the state {name}"):
            self._check_open()
            self._append("state", name=name)

    def end(self, status: EndStatus, reason: str = "") -> None:
        """Write the end record, give back unused room on the disk, and close. Aborts unfinished sequences."""
        if status not in get_args(EndStatus):
            raise ValueError(f"a take ends {', '.join(get_args(EndStatus))}, not {status!r}")
        with self._lock, self._files:
            self._check_open()
            self._ended = True
            with self._guard("ending the recording"):
                if self._unclaimed and not self._sync_failed:
                    self._sync(self._frames_fd)
                    for key in tuple(self._unclaimed):
                        self._abort(key, reason or f"unfinished when the recording was {status}")
                os.ftruncate(self._frames_fd, self._next_slot * self._stride)
                self._append("end", status=status, reason=reason)
                self._sync(self._journal_fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ended:
            return
        if error is None:
            self.end("completed")
            return
        # The error on its way says more than a second one from the same disk.
        with suppress(TakeError):
            if isinstance(error, KeyboardInterrupt):
                self.end("cancelled", "interrupted by the operator")
            else:
                message = error.message if isinstance(error, OperatorError) else str(error)
                self.end("failed", f"{type(error).__name__}: {message}")

    def _preflight(self, slots: int) -> None:
        """Refuse early what would fail late."""
        if os.path.lexists(self.path):
            raise TakeRefusedError(
                f"{self.path} exists already", "Choose another folder; a recording is never overwritten."
            )
        parent = next(p for p in self.path.absolute().parents if p.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
            raise TakeRefusedError(
                f"{self.path} cannot be made: {parent} is not a folder that may be written",
                "Choose another folder, or have its permissions changed.",
            )
        needed, free = 1.1 * slots * self._stride, shutil.disk_usage(parent).free
        if free < needed:
            raise TakeRefusedError(
                f"{self.path}: the recording needs {needed / 1e9:.3f} GB, the disk has {free / 1e9:.3f} GB left",
                "Free some space on the disk, or choose a folder on another one.",
            )

    def _make_files(self, slots: int, manifest: str) -> None:
        """Make the folder; the manifest comes last and makes it a take. A failure leaves nothing behind."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.mkdir()
        with ExitStack() as on_error:
            on_error.callback(shutil.rmtree, self.path, ignore_errors=True)
            on_error.callback(self._files.close)
            self._open_files(os.O_RDWR | os.O_CREAT | os.O_EXCL)
            self._reserve(slots)
            self._sync(self._frames_fd)
            temporary = self.path / f"{MANIFEST}.tmp"
            with temporary.open("x", encoding="utf-8") as file:
                file.write(manifest)
                file.flush()
                os.fsync(file.fileno())
            temporary.rename(self.path / MANIFEST)
            for folder in (self.path, self.path.parent):
                _sync_folder(folder)
            on_error.pop_all()

    def _open_files(self, flags: int) -> None:
        """Open frames.bin and the journal, and keep other writers out until both are closed."""
        self._journal_fd = os.open(self.path / JOURNAL, flags | os.O_APPEND, 0o666)
        self._files.callback(os.close, self._journal_fd)
        try:
            fcntl.flock(self._journal_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise TakeRefusedError(
                f"{self.path} is being recorded by another process", "Wait until that one has ended, or end it."
            ) from None
        self._frames_fd = os.open(self.path / FRAMES, flags, 0o666)
        self._files.callback(os.close, self._frames_fd)

    def _reserve(self, slots: int) -> None:
        """Make sure that frames.bin has room for so many slots."""
        if slots > self._capacity:
            begin = self._capacity * self._stride
            os.posix_fallocate(self._frames_fd, begin, slots * self._stride - begin)
            self._capacity = slots

    def _sync(self, fd: int) -> None:
        """Have everything that was written to ``fd`` on the disk."""
        # Once a synchronisation has failed the kernel forgets what it could not write, and the next one proves nothing.
        if self._sync_failed:
            raise OSError(errno.EIO, "an earlier write did not reach the disk")
        try:
            os.fdatasync(fd)
        except OSError:
            self._sync_failed = True
            raise

    def _append(self, kind: str, **members: Any) -> None:
        """Write one record to the journal, on a new line after one that was not written whole."""
        record = {"kind": kind, **members}
        if self._clock is not None and kind != "frame":
            record["t_s"] = self._clock.now()
        if self._torn_bytes is not None:
            record["torn"] = self._torn_bytes + 1
        line = (b"" if self._torn_bytes is None else b"\n") + seal(record)
        written = 0
        try:
            while written < len(line):
                written += os.write(self._journal_fd, line[written:])
        except OSError:
            self._torn_bytes = (self._torn_bytes or 0) + written
            raise
        self._torn_bytes = None

    def _claim(self, attempt: tuple[int, int, int]) -> dict[int, FrameRecord]:
        """Write the frame records of an attempt, whose pixels are on the disk by now."""
        frames = self._unclaimed.pop(attempt, {})
        for frame in frames.values():
            stamp = frame.stamp
            self._append(
                "frame",
                **_names(attempt),
                index=frame.index,
                slot=frame.slot,
                frame_id=int(stamp.frame_id),
                t_device_s=_finite(stamp.t_device_s),
                t_host_s=_finite(stamp.t_host_s),
                t_shown_s=_finite(stamp.t_shown_s),
                pixels_xxh3=frame.checksum,
            )
        return frames

    def _abort(self, attempt: tuple[int, int, int], reason: str) -> None:
        self._claim(attempt)
        self._append("sequence_aborted", **_names(attempt), reason=reason)
        recorded = self._safe.get(attempt[:2])
        if recorded is not None and recorded.attempt == attempt[2]:
            del self._safe[attempt[:2]]

    def _length(self, round: int, sequence: int) -> int:
        """Return the number of frames that the plan has in a sequence."""
        if round not in self._rounds:
            raise ValueError(f"round {round} has not begun")
        return patterns_in(self._rounds[round]["sequences"][sequence])

    def _check_open(self) -> None:
        if self._ended:
            raise ValueError(f"{self.path}: the take has ended")

    @contextmanager
    def _guard(self, doing: str) -> Iterator[None]:
        """Turn an error of the disk into one that an operator can act on."""
        try:
            yield
        except OSError as error:
            safe = [len(s.frames) for s in tuple(self._safe.values())]
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            raise TakeError(
                f"{self.path}: {doing} failed: {error.strerror}; "
                f"{sum(safe)} frames of {len(safe)} sequences are safe in this folder",
                "Free some space on the disk, then resume the recording; or process what is there."
                if full
                else "Check the disk and its cable; copy the take to another disk and resume or process it there.",
            ) from error


def _names(attempt: tuple[int, int, int]) -> dict[str, int]:
    return dict(zip(("round", "sequence", "attempt"), attempt, strict=True))


def _finite(seconds: float) -> float | None:
    return float(seconds) if math.isfinite(seconds) else None


def _sync_folder(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
