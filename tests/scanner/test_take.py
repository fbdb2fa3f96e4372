"""The recording, cut, flipped, killed and filled up; the truth is always the pixels that the test itself made."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import FrameFormat, FrameStamp, NoiseModel, OperatorError
from scanner.patterns import Plan, phase_steps
from scanner.take import Resumption, Take, TakeError, TakeRefusedError, TakeWriter

SIZE = (16, 8)
LENGTHS = {1: (3, 4), 2: (3,)}
"""Frames of each sequence, by round."""
PLANS = {
    1: Plan(SIZE, tuple(phase_steps("x", 1 / 8, n) for n in LENGTHS[1])).to_json(),
    2: Plan(SIZE, (phase_steps("y", 1 / 4, 3),), mask=np.arange(128).reshape(8, 16) > 99).to_json(),
}
SLOTS = sum(LENGTHS[1])
GREY8, GREY12 = FrameFormat(5, 3, 8), FrameFormat(5, 3, 12)
MANIFEST: dict[str, Any] = {
    "method": "mfs",
    "bench": {"name": "test bench", "latency_s": 0.1},
    "config": {"method": "mfs", "steps": {3: 1, 20: 2}},
    "plans": [PLANS[1]],
    "simulated": True,
    "noise": {"read_dn": 1.5, "dn_per_electron": 0.25},
}


@cache
def picture(fmt: FrameFormat, round: int, sequence: int, attempt: int, index: int) -> Any:
    """What the camera saw: different in every frame of every attempt."""
    seed = [round, sequence, attempt, index]
    return np.random.default_rng(seed).integers(0, 2**fmt.bits, fmt.shape, dtype=fmt.dtype)


@cache
def pictures(fmt: FrameFormat, round: int, sequence: int, attempt: int) -> Any:
    """(N, height, width) what the camera saw in one sequence."""
    return np.stack([picture(fmt, round, sequence, attempt, index) for index in range(LENGTHS[round][sequence])])


def stamp(round: int, sequence: int, index: int) -> FrameStamp:
    number = 100 * round + 10 * sequence + index
    return FrameStamp(number, number / 7, number / 3, math.nan if index == 0 else number / 9)


def create(path: Path, fmt: FrameFormat = GREY8, slots: int = SLOTS, **kwargs: Any) -> TakeWriter:
    return TakeWriter.create(path, frame_format=fmt, slots=slots, manifest=MANIFEST, **kwargs)


def write_sequence(writer: TakeWriter, round: int, sequence: int, attempt: int) -> None:
    fmt = writer.frame_format
    for index in range(LENGTHS[round][sequence]):
        pixels = picture(fmt, round, sequence, attempt, index)
        writer.write_frame(round, sequence, attempt, index, pixels, stamp(round, sequence, index))


Committed = dict[tuple[int, int], int]
"""(round, sequence) → the attempt that counts."""


def record(
    writer: TakeWriter, committed: Committed, attempt: int = 0, retry: tuple[int, int] | None = (1, 1)
) -> Committed:
    """Record what is not committed yet, with one sequence failing its first attempt; adds to ``committed`` what is."""
    for round, lengths in LENGTHS.items():
        writer.state(f"ROUND {round}")
        writer.begin_round(round, PLANS[round])
        for sequence in range(len(lengths)):
            if (round, sequence) in committed:
                continue
            good = attempt
            if (round, sequence) == retry:
                write_sequence(writer, round, sequence, attempt)
                writer.abort_sequence(round, sequence, attempt, "steps out of order")
                good = attempt + 1
            write_sequence(writer, round, sequence, good)
            writer.commit_sequence(round, sequence, good)
            committed[round, sequence] = good
    return committed


ALL: Committed = {(1, 0): 0, (1, 1): 1, (2, 0): 0}


def whole_take(path: Path, fmt: FrameFormat = GREY8) -> Path:
    with create(path, fmt) as writer:
        writer.note("a fine day")
        assert record(writer, {}) == ALL
    return path


def contents(take: Take) -> set[tuple[int, int]]:
    return {(r, s) for r in LENGTHS for s in take.sequences(r)}


def assert_true(take: Take, attempts: Callable[[int, int], int], verify: bool = True) -> None:
    """Whatever the take gives out are the pixels that were written."""
    for r, s in contents(take):
        attempt = attempts(r, s)
        assert take.sequences(r)[s].attempt == attempt
        got, want = take.frames(r, s, verify=verify), pictures(take.frame_format, r, s, attempt)
        assert got.dtype == want.dtype
        assert np.array_equal(got, want), (r, s)


def all_attempts(r: int, s: int) -> int:
    return ALL[r, s]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "take"


@contextmanager
def no_superuser() -> Iterator[None]:
    """The superuser, who may write everywhere, is nobody for a while."""
    if os.getuid() != 0:
        yield
        return
    os.setresuid(65534, 65534, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


class TestRoundTrip:
    @pytest.mark.parametrize("fmt", [GREY8, FrameFormat(7, 2, 10), GREY12, FrameFormat(70, 60, 16)], ids=str)
    def test_pixels_and_everything_beside_them(self, path: Path, fmt: FrameFormat) -> None:
        take = Take.open(whole_take(path, fmt))
        assert contents(take) == set(ALL)
        assert_true(take, all_attempts)
        assert take.frame_format == fmt
        assert take.problems == ()
        assert take.status == "completed"
        assert take.rounds == PLANS
        assert Plan.from_json(take.rounds[2]).mask is not None
        assert take.simulated
        assert take.noise == NoiseModel(1.5, 0.25)
        assert take.manifest["rig"] is None
        assert take.notes == ("a fine day",)
        assert take.states == ("ROUND 1", "ROUND 2")
        assert take.missing(1) == take.missing(2) == ()
        for (r, s), attempt in ALL.items():
            recorded = take.sequences(r)[s]
            assert recorded.attempt == attempt
            for index, frame in enumerate(recorded.frames):
                assert frame.index == index
                want = stamp(r, s, index)
                assert (frame.stamp.frame_id, frame.stamp.t_device_s) == (want.frame_id, want.t_device_s)
                np.testing.assert_equal([frame.stamp.t_host_s, frame.stamp.t_shown_s], [want.t_host_s, want.t_shown_s])

    def test_frames_are_a_view_of_the_file_that_cannot_be_written(self, path: Path) -> None:
        frames = Take.open(whole_take(path, GREY12)).frames(1, 1)
        assert frames.strides == (4096, 10, 2)
        assert not frames.flags.owndata
        with pytest.raises(ValueError, match="read-only"):
            frames[0, 0, 0] = 0

    @pytest.mark.parametrize("fmt", [GREY8, GREY12], ids=["uint8", "uint16"])
    def test_files_as_a_stranger_reads_them(self, path: Path, fmt: FrameFormat) -> None:
        whole_take(path, fmt)
        assert sorted(p.name for p in path.iterdir()) == ["frames.bin", "journal.jsonl", "manifest.json"]
        manifest = json.loads((path / "manifest.json").read_text())
        assert manifest["schema"] == 1
        assert manifest["shape"] == [3, 5]
        assert manifest["stride"] % 4096 == 0
        lines = (path / "journal.jsonl").read_bytes().splitlines()
        records = []
        for line in lines:
            body = line[: line.rindex(b',"record_xxh3"')]
            records.append(json.loads(line))
            assert records[-1]["record_xxh3"] == xxhash.xxh3_64(body).hexdigest()
        kinds = ["note", "state", "round_begun", *["frame"] * 3, "sequence_committed", *["frame"] * 4]
        kinds += ["sequence_aborted", *["frame"] * 4, "sequence_committed"]
        kinds += ["state", "round_begun", *["frame"] * 3, "sequence_committed", "end"]
        assert [r["kind"] for r in records] == kinds
        data = (path / "frames.bin").read_bytes()
        for r in records:
            if r["kind"] != "frame":
                continue
            pixels = np.frombuffer(data, manifest["dtype"], 15, r["slot"] * manifest["stride"]).reshape(3, 5)
            want = picture(fmt, r["round"], r["sequence"], r["attempt"], r["index"])
            np.testing.assert_array_equal(pixels, want)
            assert r["pixels_xxh3"] == xxhash.xxh3_64(want.tobytes()).hexdigest()

    def test_unused_room_is_given_back(self, path: Path) -> None:
        with create(path, slots=50) as writer:
            assert (path / "frames.bin").stat().st_size == 50 * 4096
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 0, 0)
            writer.commit_sequence(1, 0, 0)
        assert (path / "frames.bin").stat().st_size == 3 * 4096

    def test_pixels_are_handed_to_the_system_without_a_copy(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        handed: list[bool] = []
        pixels = picture(GREY12, 1, 0, 0, 0)

        def pwrite(fd: int, data: Any, offset: int) -> int:
            handed.append(np.shares_memory(np.frombuffer(data, np.uint8), pixels))
            return len(data)

        writer = create(path, GREY12)
        writer.begin_round(1, PLANS[1])
        monkeypatch.setattr(os, "pwrite", pwrite)
        writer.write_frame(1, 0, 0, 0, pixels, stamp(1, 0, 0))
        assert handed == [True]

    def test_pixels_with_gaps_in_memory(self, path: Path) -> None:
        wide = np.arange(72, dtype=np.uint8).reshape(6, 12)
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            for index in range(3):
                writer.write_frame(1, 0, 0, index, wide[::2, index : index + 10 : 2], stamp(1, 0, index))
            writer.commit_sequence(1, 0, 0)
        for index, pixels in enumerate(Take.open(path).frames(1, 0)):
            assert pixels.tolist() == [[row + index + column for column in (0, 2, 4, 6, 8)] for row in (0, 24, 48)]

    def test_times_of_the_benchs_clock(self, path: Path) -> None:
        class Clock:
            t = 0.0

            def now(self) -> float:
                self.t += 0.5
                return self.t

            def sleep(self, seconds: float) -> None:
                raise AssertionError

        with create(path, clock=Clock()) as writer:
            writer.state("A")
            writer.note("b")
        records = [json.loads(line) for line in (path / "journal.jsonl").read_text().splitlines()]
        assert [r["t_s"] for r in records] == [0.5, 1.0, 1.5]

    def test_description(self, path: Path) -> None:
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 1, 0)
            writer.commit_sequence(1, 1, 0)
            writer.end("cancelled", "lens cap on")
        text = "\n".join(Take.open(path).describe())
        assert "round 1: 1 of 2 sequences, 4 frames; missing: 0" in text
        assert "status: cancelled (lens cap on)" in text
        assert "simulated" in text
        assert "problem" not in text


class TestOrder:
    """Interleaved and concurrent sequences, retries, rounds begun again."""

    def test_interleaved_sequences(self, path: Path) -> None:
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            for index in (3, 2, 1, 0):
                for sequence in (1, 0):
                    if index < LENGTHS[1][sequence]:
                        pixels = picture(GREY8, 1, sequence, 0, index)
                        writer.write_frame(1, sequence, 0, index, pixels, stamp(1, sequence, index))
            writer.commit_sequence(1, 1, 0)
            writer.commit_sequence(1, 0, 0)
        take = Take.open(path)
        assert take.sequences(1)[1].slots == (5, 3, 1, 0)
        assert list(take.sequences(1)) == [0, 1]
        assert_true(take, lambda r, s: 0)
        assert not take.frames(1, 1).flags.writeable

    def test_one_thread_writes_while_another_commits(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        syncing, written = threading.Event(), threading.Event()
        real = os.fdatasync

        def slow(fd: int) -> None:
            syncing.set()
            assert written.wait(10), "writing waits for the disk"
            real(fd)

        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 0, 0)
            monkeypatch.setattr(os, "fdatasync", slow)
            commit = threading.Thread(target=writer.commit_sequence, args=(1, 0, 0))
            commit.start()
            assert syncing.wait(10)
            write_sequence(writer, 1, 1, 0)
            written.set()
            commit.join()
            writer.commit_sequence(1, 1, 0)
        take = Take.open(path)
        assert contents(take) == {(1, 0), (1, 1)}
        assert_true(take, lambda r, s: 0)

    def test_the_last_committed_attempt_counts(self, path: Path) -> None:
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            for attempt in range(3):
                write_sequence(writer, 1, 0, attempt)
                writer.commit_sequence(1, 0, attempt)
            write_sequence(writer, 1, 1, 0)
            writer.commit_sequence(1, 1, 0)
            writer.abort_sequence(1, 1, 0, "seen too late")
        take = Take.open(path)
        assert contents(take) == {(1, 0)}
        assert_true(take, lambda r, s: 2)

    def test_room_grows_for_retries(self, path: Path) -> None:
        with create(path, slots=1) as writer:
            writer.begin_round(1, PLANS[1])
            sizes = []
            for attempt in range(5):
                write_sequence(writer, 1, 0, attempt)
                sizes.append((path / "frames.bin").stat().st_size // 4096)
                writer.abort_sequence(1, 0, attempt, "vibration")
            # Seven for the plan; then, whenever a frame finds no room, what its sequence still needs.
            assert sizes == [7, 7, 9, 12, 15]
            write_sequence(writer, 1, 0, 5)
            writer.commit_sequence(1, 0, 5)
        assert_true(Take.open(path), lambda r, s: 5)
        assert contents(Take.open(path)) == {(1, 0)}

    def test_a_round_begun_again(self, path: Path) -> None:
        other = {**PLANS[1], "mean": 0.6, "amplitude": 0.4}
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 0, 0)
            writer.commit_sequence(1, 0, 0)
            before = (path / "journal.jsonl").read_bytes()
            writer.begin_round(1, PLANS[1])
            assert (path / "journal.jsonl").read_bytes() == before
            assert contents(Take.open(path)) == {(1, 0)}
            writer.begin_round(1, other)
            assert contents(Take.open(path)) == set()
            write_sequence(writer, 1, 1, 0)
            writer.commit_sequence(1, 1, 0)
        take = Take.open(path)
        assert take.rounds[1] == other
        assert contents(take) == {(1, 1)}

    def test_a_round_begun_again_whose_record_is_damaged(self, path: Path) -> None:
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 0, 0)
            writer.commit_sequence(1, 0, 0)
            writer.begin_round(1, {**PLANS[1], "mean": 0.6, "amplitude": 0.4})
            write_sequence(writer, 1, 1, 0)
            writer.commit_sequence(1, 1, 0)
        flip(path / "journal.jsonl", (path / "journal.jsonl").read_bytes().rindex(b'"round_begun"'), 0)
        take = Take.open(path)
        # Frames of the second plan must not pass for frames of the first.
        assert take.rounds == {1: PLANS[1]}
        assert contents(take) == {(1, 0)}
        assert "sequence 1 of round 1 is lost: the record of its plan is damaged" in take.problems[1]

    def test_calls_out_of_order_are_refused(self, path: Path) -> None:
        pixels = picture(GREY8, 1, 0, 0, 0)
        with create(path) as writer:
            with pytest.raises(ValueError, match="round 1 has not begun"):
                writer.write_frame(1, 0, 0, 0, pixels, stamp(1, 0, 0))
            writer.begin_round(1, PLANS[1])
            writer.write_frame(1, 0, 0, 0, pixels, stamp(1, 0, 0))
            for index in (0, 3, -1):
                with pytest.raises(ValueError, match="not in the plan, or written already"):
                    writer.write_frame(1, 0, 0, index, pixels, stamp(1, 0, 0))
            with pytest.raises(ValueError, match=r"lacks its frames \[1, 2\]"):
                writer.commit_sequence(1, 0, 0)
            for wrong in (pixels[:2], pixels.astype(np.uint16)):
                with pytest.raises(TakeError, match="the take holds") as caught:
                    writer.write_frame(1, 0, 0, 1, wrong, stamp(1, 0, 1))
                assert caught.value.exit_code == 3
            with pytest.raises(ValueError, match="not 'over'"):
                writer.end("over")  # type: ignore[arg-type]
            writer.end("completed")
            for call in (lambda: writer.note("late"), lambda: writer.end("failed"), lambda: writer.state("LATE")):
                with pytest.raises(ValueError, match="has ended"):
                    call()
        assert Take.open(path).status == "completed"


class TestEnd:
    @pytest.mark.parametrize(
        ("error", "status", "reason"),
        [
            (KeyboardInterrupt(), "cancelled", "interrupted by the operator"),
            (ValueError("no light"), "failed", "ValueError: no light"),
            (OperatorError("camera lost", "plug it in"), "failed", "OperatorError: camera lost"),
            (SystemExit(1), "failed", "SystemExit: 1"),
        ],
        ids=lambda v: type(v).__name__ if isinstance(v, BaseException) else None,
    )
    def test_an_exception_ends_the_take(self, path: Path, error: BaseException, status: str, reason: str) -> None:
        with pytest.raises(type(error)), create(path) as writer:  # noqa: PT012
            writer.begin_round(1, PLANS[1])
            write_sequence(writer, 1, 0, 0)
            writer.commit_sequence(1, 0, 0)
            writer.write_frame(1, 1, 0, 0, picture(GREY8, 1, 1, 0, 0), stamp(1, 1, 0))
            raise error
        take = Take.open(path)
        assert (take.status, take.reason) == (status, reason)
        assert contents(take) == {(1, 0)}
        aborted = json.loads((path / "journal.jsonl").read_text().splitlines()[-2])
        assert (aborted["kind"], aborted["sequence"], aborted["reason"]) == ("sequence_aborted", 1, reason)

    def test_an_end_that_was_said_stays(self, path: Path) -> None:
        with pytest.raises(ValueError, match="later"), create(path) as writer:  # noqa: PT012
            writer.end("completed")
            raise ValueError("later")
        assert Take.open(path).status == "completed"


@pytest.fixture
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that make hundreds of takes: what a synchronisation is worth shows only when power fails."""
    monkeypatch.setattr(os, "fdatasync", lambda fd: None)
    monkeypatch.setattr(os, "fsync", lambda fd: None)


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole take that tests copy."""
    return whole_take(tmp_path_factory.mktemp("sample") / "take")


@pytest.fixture
def copy(sample: Path, path: Path) -> Path:
    return Path(shutil.copytree(sample, path))


def committed_lines(journal: bytes) -> list[tuple[int, tuple[int, int] | None]]:
    """(end of the line without line feed, the sequence it commits) of every record, read by eye and hand."""
    lines, end = [], 0
    for line in journal.splitlines():
        end += len(line)
        record = json.loads(line)
        commits = record["kind"] == "sequence_committed"
        lines.append((end, (record["round"], record["sequence"]) if commits else None))
        end += 1
    return lines


class TestCut:
    def test_journal_cut_at_every_byte(self, copy: Path) -> None:
        journal = (copy / "journal.jsonl").read_bytes()
        lines = committed_lines(journal)
        assert [s for _, s in lines if s] == [(1, 0), (1, 1), (2, 0)]
        for length in range(len(journal), -1, -1):
            os.truncate(copy / "journal.jsonl", length)
            take = Take.open(copy)
            assert contents(take) == {s for end, s in lines if s and end <= length}, length
            assert_true(take, all_attempts, verify=length % 97 == 0)
            assert take.problems == ()
            assert take.status == ("completed" if length >= lines[-1][0] else "cut off")
            whole = max((end for end, _ in lines if end <= length), default=-1) + 1
            assert take.torn_bytes == max(0, length - whole), length

    @pytest.mark.parametrize("fmt", [GREY8, GREY12], ids=["uint8", "uint16"])
    def test_frames_cut_at_every_byte(self, path: Path, fmt: FrameFormat) -> None:
        whole_take(path, fmt)
        frame = 15 * fmt.dtype.itemsize
        slots = {(1, 0): (0, 1, 2), (1, 1): (7, 8, 9, 10), (2, 0): (11, 12, 13)}
        assert {key: Take.open(path).sequences(key[0])[key[1]].slots for key in slots} == slots
        # Beyond the pixels of a slot only padding is cut.
        lengths = {slot * 4096 + byte for slot in range(14) for byte in (*range(frame + 2), 4094, 4095)}
        for length in sorted(lengths, reverse=True):
            os.truncate(path / "frames.bin", length)
            take = Take.open(path)
            there = {key for key, used in slots.items() if max(used) * 4096 + frame <= length}
            assert contents(take) == there, length
            assert_true(take, all_attempts, verify=False)
            assert len(take.problems) == len(ALL) - len(there)
            assert all("frames.bin is cut" in problem for problem in take.problems)
            lost = sum(slot * 4096 + frame > length for slot in slots[1, 1])
            assert (f"sequence 1 of round 1 has lost {lost} of its 4 frames" in str(take.problems)) == (lost > 0)
            if (1, 1) not in there:
                with pytest.raises(TakeError, match="no complete sequence 1 of round 1"):
                    take.frames(1, 1)


def flip(file: Path, byte: int, bit: int) -> None:
    with file.open("r+b") as f:
        f.seek(byte)
        old = f.read(1)[0]
        f.seek(byte)
        f.write(bytes([old ^ 1 << bit]))


class TestFlippedBits:
    def test_journal(self, copy: Path) -> None:
        """One flipped bit is noticed, costs at most what that record says, and yields no wrong pixel."""
        journal = copy / "journal.jsonl"
        data = journal.read_bytes()
        lines = data.splitlines()
        kinds = [json.loads(line)["kind"] for line in lines]
        ends = np.cumsum([len(line) + 1 for line in lines])
        dice = random.Random(5)
        # Every third byte, and all that ends a line: separators are where a parser would be fooled.
        places = {*range(0, len(data), 3), *(int(end) - k for end in ends for k in (1, 2, 3))}
        for byte in sorted(places):
            bit = dice.randrange(8)
            flip(journal, byte, bit)
            take = Take.open(copy)
            number = int(np.searchsorted(ends, byte, side="right"))
            if number == len(lines) - 1:
                assert take.status == "cut off"
                assert take.problems or take.torn_bytes
            else:
                assert f"line {number + 1} " in take.problems[0]
            touched = kinds[number : number + 1 + (data[byte] == 0x0A)]
            worst = 1 if {"frame", "sequence_committed", "round_begun"} & set(touched) else 0
            assert len(ALL) - len(contents(take)) <= worst
            assert_true(take, all_attempts, verify=False)
            flip(journal, byte, bit)

    def test_the_manifests_copy_of_a_plan_saves_its_round(self, copy: Path) -> None:
        journal = (copy / "journal.jsonl").read_bytes()
        flip(copy / "journal.jsonl", journal.index(b'"round_begun"'), 3)
        take = Take.open(copy)
        assert contents(take) == set(ALL)
        assert take.rounds == PLANS
        assert "line 3 " in take.problems[0]

    def test_pixels(self, copy: Path) -> None:
        """One bit of every pixel byte of one sequence, and a sample of the others; padding is nobody's."""
        frames = copy / "frames.bin"
        # The view follows the file, so one opening is enough.
        take = Take.open(copy)
        dice = random.Random(6)
        for slot in range(14):
            for byte in (*range(15), 15, 4095):
                bit = dice.randrange(8)
                flip(frames, 4096 * slot + byte, bit)
                found = [f for r in LENGTHS for f in take.damaged(r)]
                owner = {**dict.fromkeys(range(3), (1, 0)), **dict.fromkeys(range(7, 11), (1, 1))}
                owner |= dict.fromkeys(range(11, 14), (2, 0))
                if byte < 15 and slot in owner:
                    (frame,) = found
                    r, s = owner[slot]
                    index = slot - min(k for k, v in owner.items() if v == (r, s))
                    assert (frame.round, frame.sequence, frame.index, frame.slot) == (r, s, index, slot)
                    with pytest.raises(TakeError, match=rf"sequence {s} of round {r}.*frame {index} \(slot {slot}\)"):
                        take.frames(r, s)
                else:
                    assert found == []
                    assert_true(take, all_attempts)
                flip(frames, 4096 * slot + byte, bit)

    def test_manifest(self, copy: Path) -> None:
        manifest = copy / "manifest.json"
        dice = random.Random(7)
        for byte in range(manifest.stat().st_size):
            bit = dice.randrange(8)
            flip(manifest, byte, bit)
            try:
                said = str(Take.open(copy).problems)
            except TakeError as error:
                said = error.message
            assert "manifest.json" in said or "newer version" in said
            flip(manifest, byte, bit)

    @settings(max_examples=60, deadline=None, database=None, derandomize=True)
    @given(
        cut=st.tuples(st.floats(0, 1), st.floats(0, 1)),
        flips=st.lists(st.tuples(st.booleans(), st.floats(0, 0.999), st.integers(0, 7)), max_size=6),
    )
    def test_cuts_and_flips_together(
        self,
        sample: Path,
        tmp_path_factory: pytest.TempPathFactory,
        cut: tuple[float, float],
        flips: list[tuple[bool, float, int]],
    ) -> None:
        take_path = Path(shutil.copytree(sample, tmp_path_factory.mktemp("both") / "take"))
        files = take_path / "journal.jsonl", take_path / "frames.bin"
        for file, part in zip(files, cut, strict=True):
            os.truncate(file, int(part * file.stat().st_size))
        for which, place, bit in flips:
            size = files[which].stat().st_size
            if size:
                # In frames.bin the pixels are what matters: 15 bytes at the start of each slot.
                byte = int(place * size)
                flip(files[which], byte // 4096 * 4096 + byte % min(15, size) if which else byte, bit)
        take = Take.open(take_path)
        damaged = {(f.round, f.sequence) for r in LENGTHS for f in take.damaged(r)}
        for r, s in contents(take):
            if (r, s) in damaged:
                with pytest.raises(TakeError):
                    take.frames(r, s)
            else:
                assert np.array_equal(take.frames(r, s), pictures(GREY8, r, s, ALL[r, s]))


@dataclass
class Disk:
    """The system calls of the writer, recorded, counted, and failing on demand."""

    fail_at: int = -1
    error: int = errno.ENOSPC
    half: bool = False
    """Write half of the data before failing."""
    lasting: bool = False
    trace: list[tuple[str, str, int, bytes]] = field(default_factory=list)

    def install(self, patch: pytest.MonkeyPatch) -> None:
        self.real = {name: getattr(os, name) for name in ("pwrite", "write", "fdatasync", "posix_fallocate")}
        patch.setattr(os, "pwrite", lambda fd, data, at: self.call("pwrite", fd, at, data))
        patch.setattr(os, "write", lambda fd, data: self.call("write", fd, 0, data))
        patch.setattr(os, "fdatasync", lambda fd: self.call("fdatasync", fd, 0, b""))
        patch.setattr(os, "posix_fallocate", lambda fd, at, n: self.call("posix_fallocate", fd, at, n))

    def call(self, name: str, fd: int, at: int, data: Any) -> Any:
        file = os.path.basename(os.readlink(f"/proc/self/fd/{fd}"))
        number = len(self.trace)
        kept = bytes(data) if isinstance(data, bytes | memoryview) else b""
        self.trace.append((name, file, at, kept))
        arguments = {"pwrite": (data, at), "write": (data,), "fdatasync": (), "posix_fallocate": (at, data)}[name]
        if number == self.fail_at or (self.lasting and 0 <= self.fail_at < number):
            if self.half and name in ("pwrite", "write") and number == self.fail_at:
                # As a full disk does it: first a short count, then the error.
                self.fail_at, self.half = number + 1, False
                done = data[: len(data) // 2]
                return self.real[name](fd, done, *arguments[1:])
            raise OSError(self.error, os.strerror(self.error))
        return self.real[name](fd, *arguments)


@pytest.fixture
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


class TestPowerLoss:
    def test_pixels_are_on_the_disk_before_the_records_that_claim_them(
        self, path: Path, patch: pytest.MonkeyPatch
    ) -> None:
        disk = Disk()
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            disk.install(patch)
            write_sequence(writer, 1, 0, 0)
            writer.commit_sequence(1, 0, 0)
            calls = [(name, file) for name, file, _, _ in disk.trace]
            patch.undo()
        records = ("write", "journal.jsonl")
        assert calls == [
            *[("pwrite", "frames.bin")] * 3,
            ("fdatasync", "frames.bin"),
            *[records] * 4,
            ("fdatasync", "journal.jsonl"),
        ]
        assert all(data.count(b"\n") == 1 for name, _, _, data in disk.trace if name == "write")

    def test_at_every_moment(self, path: Path, tmp_path: Path, patch: pytest.MonkeyPatch) -> None:
        """Power fails after each system call, and the disk has done its worst with what was not synchronised.

        Unlucky: pixels that were not synchronised are gone, records that were not synchronised are there.
        Forgetful: neither is there, and every commit that returned must be.
        """
        disk, returned = Disk(), []
        disk.install(patch)
        with create(path) as writer:
            real = writer.commit_sequence

            def commit(round: int, sequence: int, attempt: int) -> None:
                real(round, sequence, attempt)
                returned.append((len(disk.trace), (round, sequence)))

            patch.setattr(writer, "commit_sequence", commit)
            record(writer, {})
        patch.undo()
        assert len(disk.trace) > 50
        lost = tmp_path / "lost"
        lost.mkdir()
        shutil.copy(path / "manifest.json", lost)
        for calls in range(len(disk.trace) + 1):
            frames, pending = bytearray(14 * 4096), []
            journal, durable_journal = b"", b""
            for name, file, at, data in disk.trace[:calls]:
                if name == "pwrite":
                    pending.append((at, data))
                elif name == "write":
                    journal += data
                elif name == "fdatasync" and file == "frames.bin":
                    for begin, pixels in pending:
                        frames[begin : begin + len(pixels)] = pixels
                    pending.clear()
                elif name == "fdatasync":
                    durable_journal = journal
            acknowledged = {s for number, s in returned if number <= calls}
            (lost / "frames.bin").write_bytes(frames)
            for text in (journal, durable_journal):
                (lost / "journal.jsonl").write_bytes(text)
                take = Take.open(lost)
                assert acknowledged <= contents(take)
                assert_true(take, all_attempts, verify=False)
                assert take.problems == ()


def finish(take_path: Path, attempt: int = 5) -> tuple[Resumption, Committed]:
    """Resume and record all that is missing, with pixels of another attempt."""
    resumption = TakeWriter.resume(take_path)
    there = dict.fromkeys(resumption.committed, -1)
    with resumption.writer as writer:
        done = record(writer, there, attempt=attempt, retry=None)
    return resumption, done


def assert_finished(take_path: Path, before: Committed, done: Committed) -> Take:
    """The take equals an uninterrupted one, but for the attempts that the rest took."""
    take = Take.open(take_path)
    assert contents(take) == set(ALL)
    assert take.rounds == PLANS
    assert take.status == "completed"
    assert_true(take, lambda r, s: done[r, s] if done[r, s] >= 0 else before[r, s])
    assert take.missing(1) == take.missing(2) == ()
    return take


@pytest.mark.usefixtures("no_waiting")
class TestFullDisk:
    @pytest.mark.parametrize(
        ("error", "half", "lasting"),
        [(errno.ENOSPC, False, True), (errno.ENOSPC, True, False), (errno.EIO, False, False), (errno.EIO, True, True)],
        ids=["full", "short write", "once", "gone"],
    )
    def test_failing_at_every_call(
        self, path: Path, patch: pytest.MonkeyPatch, error: int, half: bool, lasting: bool
    ) -> None:
        """Whichever call fails: an error for operators, all that was committed kept, and the rest recorded later."""
        for number in range(1000):
            shutil.rmtree(path, ignore_errors=True)
            disk, done = Disk(number, error, half, lasting), Committed()
            failure: TakeError | None = None
            try:
                with patch.context() as inner:
                    disk.install(inner)
                    with create(path) as writer:
                        record(writer, done)
            except TakeError as raised:
                failure = raised
            if failure is None:
                # No call is left to fail.
                assert len(disk.trace) == number > 40
                break
            assert failure.remedy
            if isinstance(failure, TakeRefusedError):
                assert "nothing was recorded" in failure.message
                assert not path.exists()
                continue
            assert failure.exit_code == 3
            safe = sum(LENGTHS[r][s] for r, s in done)
            assert f"{path}: " in failure.message
            assert f"{safe} frames of {len(done)} sequences are safe" in failure.message
            assert ("Free some space" in failure.remedy) == (error == errno.ENOSPC)
            take = Take.open(path)
            assert set(done) <= contents(take)
            assert_true(take, all_attempts)
            assert take.problems == ()
            if not lasting and "ending the recording" not in failure.message:
                assert (take.status, take.reason) == ("failed", f"TakeError: {failure.message}")
            if take.status != "completed":
                before = {key: ALL[key] for key in contents(take)}
                _, later = finish(path)
                assert assert_finished(path, before, later).problems == ()
        else:
            pytest.fail("the recording never ends")

    def test_a_failed_synchronisation_is_not_believed_when_it_succeeds_later(
        self, path: Path, patch: pytest.MonkeyPatch
    ) -> None:
        writer = create(path)
        writer.begin_round(1, PLANS[1])
        write_sequence(writer, 1, 0, 0)
        disk = Disk(fail_at=0, error=errno.EIO)
        disk.install(patch)
        with pytest.raises(TakeError, match="0 frames of 0 sequences are safe"):
            writer.commit_sequence(1, 0, 0)
        with pytest.raises(TakeError, match="an earlier write did not reach the disk"):
            writer.commit_sequence(1, 0, 0)
        with pytest.raises(TakeError):
            writer.end("failed")
        patch.undo()
        assert b"pixels_xxh3" not in (path / "journal.jsonl").read_bytes()

    def test_a_limit_of_the_system_itself(self, path: Path) -> None:
        """A real EFBIG in place of a full disk."""
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        done: Committed = {}
        try:
            with pytest.raises(TakeError, match="7 frames of 2 sequences are safe"), create(path) as writer:  # noqa: PT012
                resource.setrlimit(resource.RLIMIT_FSIZE, (11 * 4096 + 7, hard))
                record(writer, done)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, before)
        take = Take.open(path)
        assert contents(take) == set(done) == {(1, 0), (1, 1)}
        assert take.status == "failed"
        assert_true(take, all_attempts)
        _, later = finish(path)
        assert_finished(path, ALL, later)


CHILD = """
import sys
sys.path.insert(0, sys.argv[2])
import test_take as t
from pathlib import Path
from tempfile import TemporaryDirectory
with t.create(Path(sys.argv[1])) as writer:
    print("begun", flush=True)
    for round, lengths in t.LENGTHS.items():
        writer.begin_round(round, t.PLANS[round])
    for attempt in range(10_000):
        for round, lengths in t.LENGTHS.items():
            for sequence in range(len(lengths)):
                t.write_sequence(writer, round, sequence, attempt)
                writer.commit_sequence(round, sequence, attempt)
                print(round, sequence, attempt, flush=True)
"""


class TestKill:
    @pytest.mark.parametrize("seed", range(4))
    def test_at_a_random_moment(self, path: Path, seed: int) -> None:
        dice = random.Random(seed)
        here = Path(__file__)
        with subprocess.Popen(
            [sys.executable, "-c", CHILD, str(path), str(here.parent)],
            cwd=here.parents[2],
            stdout=subprocess.PIPE,
            text=True,
        ) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "begun\n"
            with pytest.raises(TakeRefusedError, match="is being recorded by another process"):
                TakeWriter.resume(path)
            acknowledged: Committed = {}
            lines = [child.stdout.readline() for _ in range(dice.randrange(12))]
            threading.Event().wait(dice.uniform(0, 0.01))
            child.kill()
            lines += child.stdout.readlines()
        for line in lines:
            # The last line may be torn, too.
            if line.endswith("\n"):
                r, s, attempt = map(int, line.split())
                acknowledged[r, s] = attempt
        take = Take.open(path)
        assert take.status == "cut off"
        assert take.problems == ()
        assert set(acknowledged) <= contents(take)
        attempts = {(r, s): take.sequences(r)[s].attempt for r, s in contents(take)}
        assert all(attempts[key] >= attempt for key, attempt in acknowledged.items())
        assert_true(take, lambda r, s: attempts[r, s])
        _, done = finish(path, attempt=20_000)
        assert assert_finished(path, attempts, done).problems == ()


@pytest.mark.usefixtures("no_waiting")
class TestResume:
    def test_after_a_cut_at_any_byte(self, sample: Path, path: Path) -> None:
        journal = (sample / "journal.jsonl").read_bytes()
        line_ends = [i for i, byte in enumerate(journal) if byte == 0x0A]
        edges = {end + k for end in line_ends[:-1] for k in (-1, 0, 1, 2)}
        for length in sorted({*edges, *range(0, line_ends[-2], 101)}):
            shutil.rmtree(path, ignore_errors=True)
            shutil.copytree(sample, path)
            os.truncate(path / "journal.jsonl", length)
            before = Take.open(path)
            resumption, done = finish(path)
            assert resumption.committed == contents(before)
            used = [f.slot for r in LENGTHS for s in before.sequences(r).values() for f in s.frames]
            assert resumption.next_slot > max(used, default=-1)
            take = assert_finished(path, ALL, done)
            assert take.problems == (), length
            assert (path / "journal.jsonl").read_bytes()[:length] == journal[:length]

    def test_only_free_slots_are_written(self, copy: Path) -> None:
        journal = (copy / "journal.jsonl").read_bytes()
        # Cut in round two, before its commit: the frame records there claim their slots already.
        os.truncate(copy / "journal.jsonl", journal.rindex(b'{"kind":"sequence_committed"'))
        before = (copy / "frames.bin").read_bytes()
        resumption, done = finish(copy)
        assert resumption.next_slot == 14
        assert resumption.committed == {(1, 0), (1, 1)}
        assert done[2, 0] == 5
        assert (copy / "frames.bin").read_bytes()[: len(before)] == before

    def test_again_and_again(self, path: Path) -> None:
        """Interrupted after every single sequence, with a torn record each time."""
        with pytest.raises(KeyboardInterrupt), create(path) as writer:  # noqa: PT012
            writer.begin_round(1, PLANS[1])
            raise KeyboardInterrupt
        assert Take.open(path).status == "cancelled"
        for (r, s), attempt in ALL.items():
            resumption = TakeWriter.resume(path)
            assert Take.open(path).status == "cut off"
            resumption.writer.begin_round(r, PLANS[r])
            write_sequence(resumption.writer, r, s, attempt)
            resumption.writer.commit_sequence(r, s, attempt)
            resumption.writer.end("cancelled", "tea")
            with (path / "journal.jsonl").open("ab") as file:
                file.write(b'{"kind":"note","text":"torn')
        take = Take.open(path)
        assert contents(take) == set(ALL)
        assert_true(take, all_attempts)
        assert take.problems == ()
        assert take.torn_bytes == 27

    def test_damaged_and_lost_sequences_are_recorded_again(self, copy: Path) -> None:
        journal = (copy / "journal.jsonl").read_bytes()
        os.truncate(copy / "journal.jsonl", journal.rindex(b'{"kind":"end"'))
        os.truncate(copy / "frames.bin", 12 * 4096)
        flip(copy / "frames.bin", 4096, 2)
        resumption, done = finish(copy)
        assert resumption.committed == {(1, 1)}
        take = assert_finished(copy, ALL, done)
        assert take.damaged(1) == take.damaged(2) == ()
        assert done == {(1, 0): 5, (1, 1): -1, (2, 0): 5}

    def test_a_damaged_sequence_that_was_revoked_does_not_come_back(self, copy: Path) -> None:
        journal = (copy / "journal.jsonl").read_bytes()
        os.truncate(copy / "journal.jsonl", journal.rindex(b'{"kind":"end"'))
        os.truncate(copy / "frames.bin", 12 * 4096)
        TakeWriter.resume(copy).writer.end("cancelled")
        take = Take.open(copy)
        assert contents(take) == {(1, 0), (1, 1)}
        assert_true(take, all_attempts)

    def test_refusals(self, copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(TakeRefusedError, match="is complete"):
            TakeWriter.resume(copy)
        with pytest.raises(TakeRefusedError, match="is not a take"):
            TakeWriter.resume(tmp_path)
        with create(tmp_path / "other") as writer:
            with pytest.raises(TakeRefusedError, match="is being recorded by another process") as caught:
                TakeWriter.resume(writer.path)
            assert caught.value.exit_code == 2

        def denied(*_: Any, **__: Any) -> int:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

        monkeypatch.setattr(os, "open", denied)
        with pytest.raises(TakeRefusedError, match="cannot be written: Permission denied"):
            TakeWriter.resume(copy)

    def test_a_refused_resume_leaves_no_lock(self, copy: Path) -> None:
        for _ in range(2):
            with pytest.raises(TakeRefusedError, match="is complete"):
                TakeWriter.resume(copy)


class TestRevoking:
    def test_a_committed_sequence_is_revoked_and_taken_again(self, path: Path) -> None:
        with create(path) as writer:
            writer.begin_round(1, PLANS[1])
            for sequence in (0, 1):
                write_sequence(writer, 1, sequence, 1)
                writer.commit_sequence(1, sequence, 1)
            assert np.array_equal(writer.committed_frames(1, 0), pictures(GREY8, 1, 0, 1))
            writer.abort_sequence(1, 0, 1, "at odds with the others")
            assert writer.committed_frames(1, 0) is None
            assert Take.open(path).missing(1) == (0,)
            write_sequence(writer, 1, 0, 2)
            writer.commit_sequence(1, 0, 2)
            assert np.array_equal(writer.committed_frames(1, 0), pictures(GREY8, 1, 0, 2))
            assert np.array_equal(writer.committed_frames(1, 1), pictures(GREY8, 1, 1, 1))
        take = Take.open(path)
        assert {s: recorded.attempt for s, recorded in take.sequences(1).items()} == {0: 2, 1: 1}
        assert np.array_equal(take.frames(1, 0), pictures(GREY8, 1, 0, 2))


class TestRefusals:
    def test_an_existing_folder(self, path: Path) -> None:
        path.mkdir()
        (path / "mine").touch()
        with pytest.raises(TakeRefusedError, match="exists already") as caught:
            create(path)
        assert caught.value.exit_code == 2
        assert [p.name for p in path.iterdir()] == ["mine"]

    def test_a_folder_that_may_not_be_written(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(os, "access", lambda *_: False)
        with pytest.raises(TakeRefusedError, match="is not a folder that may be written"):
            create(path / "deep" / "down")
        assert not path.exists()

    def test_a_read_only_folder(self) -> None:
        with TemporaryDirectory() as folder, no_superuser():
            if os.getuid() == os.stat(folder).st_uid:
                Path(folder).chmod(0o500)
            with pytest.raises(TakeRefusedError, match=f"{folder} is not a folder that may be written"):
                create(Path(folder) / "take")

    def test_a_read_only_disk(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def read_only(*_: Any, **__: Any) -> None:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

        monkeypatch.setattr(Path, "mkdir", read_only)
        with pytest.raises(TakeRefusedError, match="cannot be made: Read-only file system"):
            create(path)

    def test_a_file_in_place_of_a_folder(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(TakeRefusedError, match="file is not a folder that may be written"):
            create(tmp_path / "file" / "take")

    def test_too_little_room(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        usage = namedtuple("usage", "total used free")
        needed = 7 * 4096 * 1.1
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(0, 0, int(needed)))
        with pytest.raises(TakeRefusedError, match=r"needs 0.000 GB, the disk has 0.000 GB left"):
            create(path)
        assert not path.exists()
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(0, 0, int(needed) + 1))
        create(path).end("completed")

    def test_a_bench_that_does_not_describe_itself_in_json(self, path: Path) -> None:
        for bad in (object(), math.nan, {1, 2}):
            with pytest.raises(TakeError, match="is not JSON"):
                TakeWriter.create(path, frame_format=GREY8, slots=1, manifest={**MANIFEST, "bench": {"gain": bad}})
        with pytest.raises(ValueError, match="lacks plans, simulated"):
            TakeWriter.create(path, frame_format=GREY8, slots=1, manifest={"method": "mfs", "bench": {}, "config": {}})
        assert not path.exists()

    def test_no_take(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        for wrong in (tmp_path, tmp_path / "file", tmp_path / "nowhere"):
            with pytest.raises(TakeRefusedError, match="is not a take") as caught:
                Take.open(wrong)
            assert caught.value.exit_code == 2
        for text in ("[]", "{}", '{"schema": "new"}'):
            (tmp_path / "manifest.json").write_text(text)
            with pytest.raises(TakeRefusedError, match="is not the manifest of a take"):
                Take.open(tmp_path)
        (tmp_path / "manifest.json").write_text('{"schema": 1')
        with pytest.raises(TakeError, match="is no JSON document"):
            Take.open(tmp_path)

    def test_a_newer_version(self, copy: Path) -> None:
        (copy / "manifest.json").write_text('{"schema": 2, "pictures": {}}')
        with pytest.raises(TakeRefusedError, match="reads up to 1") as caught:
            Take.open(copy)
        assert "Update" in caught.value.remedy

    def test_a_manifest_with_a_member_missing_or_wrong(self, copy: Path) -> None:
        manifest = json.loads((copy / "manifest.json").read_text())
        for name in set(manifest) - {"schema", "shape", "manifest_xxh3"}:
            for value in (None, object):
                changed = {k: v for k, v in manifest.items() if k != name}
                if value is None:
                    changed[name] = [1] if name != "plans" else {}
                (copy / "manifest.json").write_text(json.dumps(changed))
                with pytest.raises(TakeError, match="missing or of the wrong type"):
                    Take.open(copy)
        for wrong in ({"stride": 4095}, {"stride": 0}, {"stride": 4096, "width": 5000}):
            (copy / "manifest.json").write_text(json.dumps({**manifest, **wrong}))
            with pytest.raises(TakeError, match="does not hold a frame"):
                Take.open(copy)

    def test_files_that_are_gone(self, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("frames.bin", "journal.jsonl"):
            (copy / name).rename(copy / "aside")
            with pytest.raises(TakeError, match=f"has lost its {name}"):
                Take.open(copy)
            (copy / "aside").rename(copy / name)

        def broken(self: Path) -> bytes:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

        monkeypatch.setattr(Path, "read_bytes", broken)
        with pytest.raises(TakeError, match="cannot be read: Input/output error"):
            Take.open(copy)

    @pytest.mark.parametrize(
        ("record", "problem"),
        [
            ({"kind": "weather", "sun": True}, "kind 'weather' is not understood"),
            ({"kind": "note", "text": 7}, "kind 'note' is not understood"),
            ({"kind": "sequence_committed", "slots": [1, 0, 2]}, "sequence 0 of round 1 is lost"),
            ({"kind": "sequence_committed", "slots": [7, 8, 9, 10]}, "sequence 0 of round 1 is lost"),
            ({"kind": "sequence_committed", "slots": [0, 1, 99]}, "sequence 0 of round 1 is lost"),
        ],
        ids=lambda v: v["kind"] if isinstance(v, dict) else None,
    )
    def test_sound_records_that_make_no_sense(self, copy: Path, record: dict[str, Any], problem: str) -> None:
        """What a later version or another program may have written."""
        journal = copy / "journal.jsonl"
        plan = next(line for line in journal.read_text().splitlines() if '"sequence_committed"' in line)
        record = {"round": 1, "sequence": 0, "attempt": 0, "plan_xxh3": json.loads(plan)["plan_xxh3"], **record}
        body = json.dumps(record).encode()[:-1]
        with journal.open("ab") as file:
            file.write(body + b',"record_xxh3":"' + xxhash.xxh3_64(body).hexdigest().encode() + b'"}\n')
        take = Take.open(copy)
        assert contents(take) == set(ALL)
        assert_true(take, all_attempts)
        assert problem in take.problems[0]
