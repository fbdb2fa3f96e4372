"""Reading a take, as far as it goes."""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.devices import FrameFormat, NoiseModel, Pixels
from scanner.take.journal import (
    FRAMES,
    JOURNAL,
    MANIFEST,
    Document,
    FrameRecord,
    Ledger,
    RecordedSequence,
    Status,
    TakeError,
    TakeRefusedError,
    digest,
    read_manifest,
)


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
            manifest, problems = read_manifest(path / MANIFEST)
            for name in (FRAMES, JOURNAL):
                if not (path / name).is_file():
                    raise TakeError(f"{path} has lost its {name}", f"Restore {name} from a copy of the take.")
            ledger = Ledger(manifest["plans"])
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
            sums = pool.map(lambda f: digest(self._view(f.slot, 1).data), frames)
            return tuple(f for f, found in zip(frames, sums, strict=True) if found != f.checksum)
