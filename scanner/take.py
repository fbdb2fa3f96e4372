"""A take: the recording on disk, which survives being cut off anywhere.

Layout of the folder, a contract with tools outside of this repository::

    manifest.json   written once, atomically, when everything else is in place
    frames.bin      preallocated slots of ``stride`` bytes, a multiple of 4096; slot n begins at n · stride
    journal.jsonl   append-only, one write per record

**manifest.json** holds ``schema`` (1), ``uid``, ``created`` (ISO 8601, UTC), ``method``, ``bench``, ``config``,
``plans`` (those known at the start, round one first), ``simulated``, ``rig``, ``noise``, ``width``, ``height``,
``bits``, ``dtype`` (NumPy's, with byte order), ``shape`` (height, width), ``stride`` and ``manifest_xxh3``, the
checksum of all the rest as sorted, compact JSON.

**journal.jsonl** holds one JSON object per line. Its last member, ``record_xxh3``, is the checksum of all bytes
of the line before ``,"record_xxh3"``. Checksums are XXH3, 64 bits, in hexadecimal. The other members, by ``kind``:

=================== =========================================================================================
round_begun         ``round`` (1, 2), ``plan``. Begun again with another plan, its former sequences are void.
frame               ``round``, ``sequence``, ``attempt``, ``index`` (place in the sequence), ``slot``,
                    ``frame_id``, ``t_device_s``, ``t_host_s``, ``t_shown_s`` (null where unknown),
                    ``pixels_xxh3``
sequence_committed  ``round``, ``sequence``, ``attempt``, ``plan_xxh3`` (of the plan as sorted, compact JSON),
                    ``slots`` in the order of the plan. Of several attempts the last committed one counts.
sequence_aborted    ``round``, ``sequence``, ``attempt``, ``reason``. Revokes the attempt, also a committed one.
note, state         ``text``; ``name``: the operator's log and the scan's state machine
resumed             The recording goes on after it was cut off or ended.
end                 ``status`` (completed, cancelled, failed), ``reason``
=================== =========================================================================================

A record with ``torn`` follows so many bytes that are what is left of a record that was not written whole; it
begins with a line feed of its own, so that empty lines may occur. All records but ``frame`` carry ``t_s``, s on
the bench's clock, where the writer knows it.

The truth is in the journal: a slot that no record claims holds nothing, and a claimed slot is never written
again. Pixels reach the disk before the record that claims them: the frame records of a sequence are held back
until it ends, then the pixels are synchronised, then the records are written and synchronised.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import mmap
import os
import shutil
import threading
import uuid
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, get_args

import numpy as np
import xxhash

from drivers.devices import Clock, FrameFormat, FrameStamp, NoiseModel, Pixels
from drivers.errors import OperatorError

SCHEMA = 1
MANIFEST, FRAMES, JOURNAL = "manifest.json", "frames.bin", "journal.jsonl"

EndStatus = Literal["completed", "cancelled", "failed"]
Status = Literal["completed", "cancelled", "failed", "cut off"]
Document = Mapping[str, Any]

_PAGE = 4096
_SEAL = b',"record_xxh3":"%s"}'
_SEAL_BYTES = len(_SEAL % bytes(16))
_GIVEN = ("method", "bench", "config", "plans", "simulated")


class TakeError(OperatorError):
    """A recording cannot be written or read back; what was safely recorded stays."""

    exit_code = 3


class TakeRefusedError(TakeError):
    """The folder is not what was asked for: no take, exists already, too new, in use, not writable."""

    exit_code = 2


@dataclass(frozen=True)
class FrameRecord:
    """What the journal says about one frame.

    Parameters
    ----------
    round, sequence, attempt
        What it was recorded for; rounds count from 1, the others from 0.
    index
        Place of its pattern in the sequence.
    slot
        Place of its pixels in frames.bin.
    stamp
        Device id and time stamps.
    checksum
        XXH3 (64 bits) of the pixels, hexadecimal.
    """

    round: int
    sequence: int
    attempt: int
    index: int
    slot: int
    stamp: FrameStamp
    checksum: str


@dataclass(frozen=True)
class RecordedSequence:
    """A committed sequence; ``frames`` are in the order of the plan."""

    round: int
    sequence: int
    attempt: int
    frames: tuple[FrameRecord, ...]

    @property
    def slots(self) -> tuple[int, ...]:
        """Slots in the order of the plan."""
        return tuple(f.slot for f in self.frames)


def _compact(document: Any) -> bytes:
    return json.dumps(document, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()


def _checksum(data: bytes | memoryview) -> str:
    return xxhash.xxh3_64_hexdigest(data)


def _seal(record: Document) -> bytes:
    """Turn a record into a line of the journal, with its checksum."""
    body = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()[:-1]
    return body + _SEAL % _checksum(body).encode() + b"\n"


def _unseal(line: bytes) -> dict[str, Any] | None:
    """Inverse of `_seal`, without the line feed; None where the line is not what was written."""
    body, seal = line[:-_SEAL_BYTES], line[-_SEAL_BYTES:]
    if seal != _SEAL % _checksum(body).encode():
        return None
    record: dict[str, Any] = json.loads(body + b"}")
    return record


@dataclass
class _Ledger:
    """What the records of a journal, applied in order, add up to."""

    known_plans: Sequence[Document]
    rounds: dict[int, Document] = field(default_factory=dict)
    plan_checksums: dict[int, str] = field(default_factory=dict)
    frames: dict[int, FrameRecord] = field(default_factory=dict)
    sequences: dict[tuple[int, int], RecordedSequence] = field(default_factory=dict)
    next_slot: int = 0
    status: Status = "cut off"
    reason: str = ""
    notes: list[str] = field(default_factory=list)
    states: list[str] = field(default_factory=list)
    torn_bytes: int = 0

    def read(self, journal: bytes) -> list[str]:
        """Apply a whole journal; returns what is wrong with it, in the operator's words."""
        problems: list[tuple[int, str]] = []
        start = 0
        for number, line in enumerate(journal.split(b"\n"), 1):
            record = _unseal(line)
            if record is not None:
                # What a record calls torn was noticed when it was written, and is no damage.
                problems = [p for p in problems if p[0] < start - record.get("torn", 0)]
                if problem := self._apply(record):
                    problems.append((start, f"{JOURNAL} line {number}: {problem}"))
            elif start + len(line) == len(journal):
                self.torn_bytes = len(line)
            elif line:
                problems.append((start, f"{JOURNAL} line {number} (byte {start}) is damaged and was skipped"))
            start += len(line) + 1
        return [text for _, text in problems]

    def _apply(self, record: Document) -> str | None:
        match record:
            case {"kind": "round_begun", "round": int(r), "plan": {"sequences": [*_]} as plan}:
                if r in self.rounds and self.rounds[r] != plan:
                    self.sequences = {key: s for key, s in self.sequences.items() if key[0] != r}
                self._know(r, plan)
            case {
                "kind": "frame",
                "round": int(r),
                "sequence": int(s),
                "attempt": int(a),
                "index": int(index),
                "slot": int(slot),
                "frame_id": int(frame_id),
                "t_device_s": float() | int() | None as t_device,
                "t_host_s": float() | int() | None as t_host,
                "t_shown_s": float() | int() | None as t_shown,
                "pixels_xxh3": str(checksum),
            } if slot >= 0:
                times = (math.nan if t is None else float(t) for t in (t_device, t_host, t_shown))
                self.frames[slot] = FrameRecord(r, s, a, index, slot, FrameStamp(frame_id, *times), checksum)
                self.next_slot = max(self.next_slot, slot + 1)
            case {
                "kind": "sequence_committed",
                "round": int(r),
                "sequence": int(s),
                "attempt": int(a),
                "plan_xxh3": str(plan_checksum),
                "slots": [int(), *_] as slots,
            }:
                self.next_slot = max(self.next_slot, *(slot + 1 for slot in slots))
                return self._commit(r, s, a, plan_checksum, slots)
            case {"kind": "sequence_aborted", "round": int(r), "sequence": int(s), "attempt": int(a)}:
                if (r, s) in self.sequences and self.sequences[r, s].attempt == a:
                    del self.sequences[r, s]
            case {"kind": "note", "text": str(text)}:
                self.notes.append(text)
            case {"kind": "state", "name": str(name)}:
                self.states.append(name)
            case {"kind": "resumed"}:
                self.status, self.reason = "cut off", ""
            case {"kind": "end", "status": "completed" | "cancelled" | "failed" as status, "reason": str(why)}:
                self.status, self.reason = status, why
            case _:
                return f"a record of kind {record.get('kind')!r} is not understood and was skipped"
        return None

    def _know(self, r: int, plan: Document) -> None:
        self.rounds[r], self.plan_checksums[r] = plan, _checksum(_compact(plan))

    def _commit(self, r: int, s: int, a: int, plan_checksum: str, slots: Sequence[int]) -> str | None:
        if r not in self.rounds and r > 0:
            # The record of the round is damaged, but the manifest may know the same plan.
            for plan in self.known_plans[r - 1 : r]:
                if _checksum(_compact(plan)) == plan_checksum:
                    self._know(r, plan)
        if self.plan_checksums.get(r) != plan_checksum:
            return f"sequence {s} of round {r} is lost: the record of its plan is damaged"
        frames = []
        for index, slot in enumerate(slots):
            frame = self.frames.get(slot)
            if frame is None or (frame.round, frame.sequence, frame.attempt, frame.index) != (r, s, a, index):
                return f"sequence {s} of round {r} is lost: the record of its frame {index} is damaged"
            frames.append(frame)
        self.sequences[r, s] = RecordedSequence(r, s, a, tuple(frames))
        return None


def _read_manifest(file: Path) -> tuple[dict[str, Any], list[str]]:
    """Read and check a manifest; returns it and what is wrong with it."""
    restore = f"Restore {MANIFEST} from a copy; the frames themselves are not touched."
    try:
        manifest = json.loads(file.read_bytes())
    except ValueError as error:
        raise TakeError(f"{file} is damaged, it is no JSON document: {error}", restore) from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("schema"), int):
        raise TakeRefusedError(f"{file} is not the manifest of a take", "Name a folder that a scan recorded.")
    if manifest["schema"] > SCHEMA:
        raise TakeRefusedError(
            f"{file.parent} was recorded by a newer version of this program: its schema is {manifest['schema']}, "
            f"this version reads up to {SCHEMA}",
            "Update this program to process it.",
        )
    match manifest:
        case {
            "uid": str(),
            "created": str(),
            "method": str(),
            "bench": {},
            "config": {},
            "plans": [*_],
            "simulated": bool(),
            "rig": None | {},
            "noise": None | {"read_dn": float() | int(), "dn_per_electron": float() | int()},
            "width": int(width),
            "height": int(height),
            "bits": int(bits),
            "dtype": str(dtype),
            "stride": int(stride),
        } if min(width, height, bits) > 0 and dtype[1:] == f"u{1 if bits <= 8 else 2}":
            if stride % _PAGE or stride < width * height * int(dtype[2:]):
                raise TakeError(f"{file} is damaged: a stride of {stride} bytes does not hold a frame", restore)
        case _:
            raise TakeError(f"{file} is damaged: members are missing or of the wrong type", restore)
    checksum = manifest.pop("manifest_xxh3", None)
    intact = checksum == _checksum(_compact(manifest))
    return manifest, [] if intact else [f"{MANIFEST} is not as it was written: check its settings and rig"]


@dataclass(frozen=True, eq=False)
class Take:
    """A recording, read-only: what a folder held when `Take.open` read it.

    Parameters
    ----------
    path
        The folder.
    manifest
        The document of manifest.json.
    frame_format
        Size and depth of the frames.
    rounds
        {round: plan document} of the rounds that were begun.
    status, reason
        How the recording ended: ``completed``, ``cancelled`` or ``failed``, and why; or ``cut off``, which is
        also what a take looks like while it is being recorded.
    problems
        What is damaged, as sentences for the operator.
    notes, states
        The operator's log, and the states that the scan went through, in order.
    torn_bytes
        Length of what is left of a last record that was not written whole; it was dropped.
    """

    path: Path
    manifest: Document
    frame_format: FrameFormat
    rounds: Mapping[int, Document]
    status: Status
    reason: str
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    states: tuple[str, ...]
    torn_bytes: int
    _sequences: Mapping[tuple[int, int], RecordedSequence] = field(repr=False)
    _lost: tuple[RecordedSequence, ...] = field(repr=False)
    _next_slot: int = field(repr=False)
    _pixels: mmap.mmap | bytes = field(repr=False)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Take:
        """Read what a folder holds, as far as it goes.

        Raises
        ------
        TakeRefusedError
            The folder is no take, or one of a newer version.
        TakeError
            The take cannot be read at all: a file is missing, or the manifest is damaged.
        """
        path = Path(path)
        try:
            if not (path / MANIFEST).is_file():
                raise TakeRefusedError(
                    f"{path} is not a take: it has no {MANIFEST}",
                    "Name a folder that a scan recorded; one that was cut off before its first frame holds nothing.",
                )
            manifest, problems = _read_manifest(path / MANIFEST)
            for name in (FRAMES, JOURNAL):
                if not (path / name).is_file():
                    raise TakeError(f"{path} has lost its {name}", f"Restore {name} from a copy of the take.")
            ledger = _Ledger(manifest["plans"])
            problems += ledger.read((path / JOURNAL).read_bytes())
            with (path / FRAMES).open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                pixels = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError as error:
            raise TakeError(
                f"{path} cannot be read: {error.strerror}", "Check the disk and the permissions of the folder."
            ) from error

        frame_format = FrameFormat(manifest["width"], manifest["height"], manifest["bits"])
        frame_bytes = math.prod(frame_format.shape) * frame_format.dtype.itemsize
        kept, lost = {}, []
        for key, recorded in sorted(ledger.sequences.items()):
            beyond = [s for s in recorded.slots if s * manifest["stride"] + frame_bytes > size]
            if not beyond:
                kept[key] = recorded
                continue
            lost.append(recorded)
            problems.append(
                f"{FRAMES} is cut: sequence {recorded.sequence} of round {recorded.round} has lost "
                f"{len(beyond)} of its {len(recorded.frames)} frames, in slots {min(beyond)} to {max(beyond)}"
            )
        return cls(
            path=path,
            manifest=manifest,
            frame_format=frame_format,
            rounds=dict(sorted(ledger.rounds.items())),
            status=ledger.status,
            reason=ledger.reason,
            problems=tuple(problems),
            notes=tuple(ledger.notes),
            states=tuple(ledger.states),
            torn_bytes=ledger.torn_bytes,
            _sequences=kept,
            _lost=tuple(lost),
            _next_slot=ledger.next_slot,
            _pixels=pixels,
        )

    @property
    def simulated(self) -> bool:
        """True where no light was involved."""
        return bool(self.manifest["simulated"])

    @property
    def noise(self) -> NoiseModel | None:
        """Noise model of the frames, where the bench knew it."""
        noise = self.manifest["noise"]
        return None if noise is None else NoiseModel(noise["read_dn"], noise["dn_per_electron"])

    def sequences(self, round: int) -> dict[int, RecordedSequence]:
        """Return {sequence: its frames} of the committed sequences of a round, in the order of the plan."""
        return {s: recorded for (r, s), recorded in self._sequences.items() if r == round}

    def missing(self, round: int) -> tuple[int, ...]:
        """Return the sequences of a round's plan that are not there."""
        planned = len(self.rounds[round]["sequences"]) if round in self.rounds else 0
        return tuple(s for s in range(planned) if (round, s) not in self._sequences)

    def frames(self, round: int, sequence: int, *, verify: bool = True) -> Pixels:
        """Return the frames of a committed sequence in the order of the plan.

        Parameters
        ----------
        round, sequence
            Which.
        verify
            Compare every frame with its checksum first.

        Returns
        -------
        (N, height, width), read-only; a view of the file where the slots are consecutive, else a copy.

        Raises
        ------
        TakeError
            The sequence is not there, or pixels have changed since they were written.
        """
        recorded = self._sequences.get((round, sequence))
        if recorded is None:
            raise TakeError(
                f"{self.path} holds no complete sequence {sequence} of round {round}",
                "Process what is there, or resume the recording.",
            )
        if verify and (changed := self._changed(recorded.frames)):
            places = ", ".join(f"frame {f.index} (slot {f.slot})" for f in changed)
            raise TakeError(
                f"{self.path}: sequence {sequence} of round {round} is damaged: "
                f"the pixels of {places} do not match their checksums",
                "Leave this sequence out, resume the recording to take it again, or restore the take from a copy.",
            )
        first, *_ = slots = recorded.slots
        if slots == tuple(range(first, first + len(slots))):
            return self._view(first, len(slots))
        copy: Pixels = np.concatenate([self._view(slot, 1) for slot in slots])
        copy.flags.writeable = False
        return copy

    def damaged(self, round: int) -> tuple[FrameRecord, ...]:
        """Return the committed frames of a round whose pixels do not match their checksums; reads all pixels."""
        return self._changed([f for recorded in self.sequences(round).values() for f in recorded.frames])

    def describe(self) -> list[str]:
        """Return plain lines that say what the take holds."""
        fmt, simulated = self.frame_format, ", simulated" if self.simulated else ""
        lines = [
            f"take {self.manifest['uid']} of {self.manifest['created']}, method {self.manifest['method']}{simulated}",
            f"frames of {fmt.width} × {fmt.height} px, {fmt.bits} bits",
            f"status: {self.status}" + (f" ({self.reason})" if self.reason else ""),
        ]
        for number, plan in self.rounds.items():
            there, missing = self.sequences(number), self.missing(number)
            lines.append(
                f"round {number}: {len(there)} of {len(plan['sequences'])} sequences, "
                f"{sum(len(recorded.frames) for recorded in there.values())} frames"
                + (f"; missing: {', '.join(map(str, missing))}" if missing else "")
            )
        if not self.rounds:
            lines.append("no round was begun")
        if self.torn_bytes:
            lines.append(f"the journal's last {self.torn_bytes} bytes are a torn record and were dropped")
        return lines + [f"problem: {problem}" for problem in self.problems]

    def _view(self, slot: int, count: int) -> Pixels:
        dtype, stride = np.dtype(self.manifest["dtype"]), self.manifest["stride"]
        height, width = self.frame_format.shape
        return np.ndarray(
            (count, height, width),
            dtype,
            buffer=self._pixels,
            offset=slot * stride,
            strides=(stride, width * dtype.itemsize, dtype.itemsize),
        )

    def _changed(self, frames: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
        """Return those whose pixels do not match their checksums."""
        # Hashing and page faults leave the interpreter's lock, so threads help.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            sums = pool.map(lambda f: _checksum(self._view(f.slot, 1).data), frames)
            return tuple(f for f, found in zip(frames, sums, strict=True) if found != f.checksum)


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
        self._stride = -(-math.prod(frame_format.shape) * frame_format.dtype.itemsize // _PAGE) * _PAGE
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
        if lacking := [key for key in _GIVEN if key not in manifest]:
            raise ValueError(f"the manifest of a take lacks {', '.join(lacking)}")
        self = cls(Path(path), frame_format, clock)
        document = {
            "schema": SCHEMA,
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
        document["manifest_xxh3"] = _checksum(_compact(document))
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
                self._open_files(os.O_WRONLY)
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
            self._plan_checksums = {r: _checksum(_compact(plan)) for r, plan in take.rounds.items()}
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
            1 or 2.
        plan
            `scanner.patterns.Plan.to_json`. Another plan than before makes the round's former sequences void.
        """
        text = _compact(plan)
        plan = json.loads(text)
        with self._lock, self._guard(f"beginning round {round}"):
            self._check_open()
            if self._rounds.get(round) == plan:
                return
            self._reserve(self._next_slot + sum(len(s["fringes"]) for s in plan["sequences"]))
            self._append("round_begun", round=round, plan=plan)
            self._sync(self._journal_fd)
            self._rounds[round], self._plan_checksums[round] = plan, _checksum(text)
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
        checksum = _checksum(data)
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
            self._open_files(os.O_WRONLY | os.O_CREAT | os.O_EXCL)
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
        line = (b"" if self._torn_bytes is None else b"\n") + _seal(record)
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
        return len(self._rounds[round]["sequences"][sequence]["fringes"])

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
