"""What is written: records with checksums, and what a journal of them adds up to."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import xxhash

from drivers.devices import FrameStamp
from drivers.errors import OperatorError

SCHEMA, SCHEMA_OF_EXPOSURES = 1, 2
"""Of takes with one exposure, and of those whose plans have several: an older version must not read them as one."""
MANIFEST, FRAMES, JOURNAL = "manifest.json", "frames.bin", "journal.jsonl"

EndStatus = Literal["completed", "cancelled", "failed"]
Status = Literal["completed", "cancelled", "failed", "cut off"]
Document = Mapping[str, Any]

PAGE = 4096
_SEAL = b',"record_xxh3":"%s"}'
_SEAL_BYTES = len(_SEAL % bytes(16))
GIVEN = ("method", "bench", "config", "plans", "simulated")
"""What the maker of a take must say of it."""


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


def schema_of(manifest: Document) -> int:
    """Schema that a take with these ``plans`` has."""
    plans = manifest.get("plans")
    several = isinstance(plans, list) and any(isinstance(plan, dict) and "exposures" in plan for plan in plans)
    return SCHEMA_OF_EXPOSURES if several else SCHEMA


def compact(document: Any) -> bytes:
    """Sorted, compact JSON: the form in which documents are compared."""
    return json.dumps(document, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()


def digest(data: bytes | memoryview) -> str:
    """XXH3 (64 bits) in hexadecimal."""
    return xxhash.xxh3_64_hexdigest(data)


def seal(record: Document) -> bytes:
    """Turn a record into a line of the journal, with its checksum."""
    body = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()[:-1]
    return body + _SEAL % digest(body).encode() + b"\n"


def unseal(line: bytes) -> dict[str, Any] | None:
    """Inverse of `seal`, without the line feed; None where the line is not what was written."""
    body, seal = line[:-_SEAL_BYTES], line[-_SEAL_BYTES:]
    if seal != _SEAL % digest(body).encode():
        return None
    record: dict[str, Any] = json.loads(body + b"}")
    return record


@dataclass
class Ledger:
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
            record = unseal(line)
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
        self.rounds[r], self.plan_checksums[r] = plan, digest(compact(plan))

    def _commit(self, r: int, s: int, a: int, plan_checksum: str, slots: Sequence[int]) -> str | None:
        if r not in self.rounds and r > 0:
            # The record of the round is damaged, but the manifest may know the same plan.
            for plan in self.known_plans[r - 1 : r]:
                if digest(compact(plan)) == plan_checksum:
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


def read_manifest(file: Path) -> tuple[dict[str, Any], list[str]]:
    """Read and check a manifest; returns it and what is wrong with it."""
    restore = f"Restore {MANIFEST} from a copy; the frames themselves are not touched."
    try:
        manifest = json.loads(file.read_bytes())
    except ValueError as error:
        raise TakeError(f"{file} is damaged, it is no JSON document: {error}", restore) from None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("schema"), int):
        raise TakeRefusedError(f"{file} is not the manifest of a take", "Name a folder that a scan recorded.")
    known = schema_of(manifest)
    if manifest["schema"] > known:
        raise TakeRefusedError(
            f"{file.parent} was recorded by a newer version of this program: its schema is {manifest['schema']}, "
            f"this version reads up to {known}",
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
            if stride % PAGE or stride < width * height * int(dtype[2:]):
                raise TakeError(f"{file} is damaged: a stride of {stride} bytes does not hold a frame", restore)
        case _:
            raise TakeError(f"{file} is damaged: members are missing or of the wrong type", restore)
    checksum = manifest.pop("manifest_xxh3", None)
    intact = checksum == digest(compact(manifest))
    return manifest, [] if intact else [f"{MANIFEST} is not as it was written: check its settings and rig"]
