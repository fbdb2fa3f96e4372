"""Photographs for a calibration step, recorded as takes: fringes on a board, or any pictures one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import Bench, Clock, FrameFormat, FrameStamp, HardwareError, NoiseModel, Pixels
from drivers.latency import KeepStep
from scanner.acquisition import Acquisition, Listener
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.patterns import Plan
from scanner.response import ProjectorResponse
from scanner.result import Maps
from scanner.take import TakeWriter
from scanner.take.journal import digest

_ATTEMPTS = 3


@dataclass(frozen=True)
class Occasion:
    """Why something is photographed; it goes into the manifest of the take.

    Parameters
    ----------
    step
        Of the calibration.
    config
        The whole configuration, JSON-ready.
    notes
        Anything else, JSON-ready, such as the pose that was asked for.
    """

    step: str
    config: Mapping[str, Any]
    notes: Mapping[str, Any]

    def manifest(self, bench: Bench, method: str, plans: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """What `TakeWriter.create` is told."""
        noise = bench.noise
        return {
            "method": method,
            "bench": dict(bench.describe()),
            "config": dict(self.config),
            "plans": list(plans),
            "simulated": bench.simulated,
            "noise": None if noise is None else {"read_dn": noise.read_dn, "dn_per_electron": noise.dn_per_electron},
            "calibration": {"step": self.step, **self.notes},
        }


class RecordingBench:
    """A bench that writes every frame it exposes into a take; what is prepared together is a round of its own.

    Parameters
    ----------
    bench
        Open.
    take
        Where to.
    """

    def __init__(self, bench: Bench, take: TakeWriter) -> None:
        self._bench = bench
        self._take = take
        self._round = 0
        self._pictures: list[Mapping[str, Any]] = []
        self._written: set[int] = set()
        self.name = bench.name
        self.simulated = bench.simulated
        self.rig = bench.rig

    @property
    def clock(self) -> Clock:
        """The bench's."""
        return self._bench.clock

    @property
    def projector_size(self) -> tuple[int, int]:
        """The bench's."""
        return self._bench.projector_size

    @property
    def frame_format(self) -> FrameFormat:
        """The bench's."""
        return self._bench.frame_format

    @property
    def noise(self) -> NoiseModel | None:
        """The bench's."""
        return self._bench.noise

    def prepare(self, patterns: Sequence[NDArray[np.uint8]]) -> None:
        """Prepare the bench, and begin a round of the take with these pictures."""
        self._bench.prepare(patterns)
        self._pictures = [_described(picture) for picture in patterns]
        self._begin()

    def _begin(self) -> None:
        self._round += 1
        self._written = set()
        self._take.begin_round(self._round, {"sequences": [{"fringes": self._pictures}]})

    def expose(self, index: int, out: Pixels) -> FrameStamp:
        """Photograph and record."""
        stamp = self._bench.expose(index, out)
        if index in self._written:
            self._begin()
        self._take.write_frame(self._round, 0, 1, index, out, stamp)
        self._written.add(index)
        if len(self._written) == len(self._pictures):
            self._take.commit_sequence(self._round, 0, 1)
        return stamp

    def darken(self) -> None:
        """Project black."""
        self._bench.darken()

    def describe(self) -> Mapping[str, Any]:
        """The bench's."""
        return self._bench.describe()


def _described(picture: NDArray[np.uint8]) -> dict[str, Any]:
    level = int(picture.flat[0])
    if (picture == level).all():
        return {"level": level}
    return {"picture_xxh3": digest(np.ascontiguousarray(picture).data.cast("B"))}


@contextmanager
def recorded(bench: Bench, path: Path, occasion: Occasion, slots: int) -> Iterator[RecordingBench]:
    """Record all that a bench exposes.

    Parameters
    ----------
    bench
        Open.
    path
        Folder of the take; it must not exist.
    occasion
        For its manifest.
    slots
        Frames that are expected; more find room too.
    """
    manifest = occasion.manifest(bench, "pictures", [])
    with TakeWriter.create(
        path, frame_format=bench.frame_format, slots=slots, manifest=manifest, clock=bench.clock
    ) as take:
        yield RecordingBench(bench, take)


@contextmanager
def recorded_steps(bench: Bench, path: Path, occasion: Occasion, slots: int) -> Iterator[KeepStep]:
    """Record the frames of steps between black and white; each step is a round of its own, as long as it took.

    Parameters
    ----------
    bench, path, occasion, slots
        As for `recorded`.
    """
    manifest = occasion.manifest(bench, "pictures", [])
    with TakeWriter.create(
        path, frame_format=bench.frame_format, slots=slots, manifest=manifest, clock=bench.clock
    ) as take:
        rounds = count(1)

        def keep(level: int, frames: Sequence[tuple[Pixels, FrameStamp]]) -> None:
            number = next(rounds)
            take.begin_round(number, {"sequences": [{"fringes": [{"level": level}] * len(frames)}]})
            for index, (pixels, stamp) in enumerate(frames):
                take.write_frame(number, 0, 1, index, pixels, stamp)
            take.commit_sequence(number, 0, 1)

        yield keep


def capture_fringes(
    bench: Bench,
    scan: ScanSection,
    response: ProjectorResponse | None,
    path: Path,
    occasion: Occasion,
    listener: Listener,
) -> tuple[Maps, NoiseModel]:
    """Project the fringes of a one-round method, record them, and decode them without a rig.

    Returns
    -------
    maps, noise
        Of the camera's picture, and the noise of its frames.

    Raises
    ------
    HardwareError
        A device failed.
    AcquisitionError
        A sequence failed its check on every attempt, or the exposure is wrong.
    """
    method = METHODS[scan.method]
    light = None if response is None else response.values
    plan = replace(method.first_round(scan, bench.projector_size), response=light)
    with TakeWriter.create(
        path,
        frame_format=bench.frame_format,
        slots=plan.frame_count,
        manifest=occasion.manifest(bench, method.name, [plan.to_json()]),
        clock=bench.clock,
    ) as take:
        decoder = Decoder(method, scan, bench.noise, None)
        maps = Acquisition(bench, method, scan, decoder, take, listener, light).run()
    assert decoder.used_noise is not None
    return maps, decoder.used_noise


def photographed(bench: Bench, plan: Plan) -> Iterator[tuple[int, Pixels]]:
    """Photograph the sequences of a plan one by one, without a check of their order.

    Yields
    ------
    sequence, frames
        Its number, and (N, H, W) frames, which the next one overwrites where it is as long.

    Raises
    ------
    HardwareError
        A device failed, and again when the sequence was repeated.
    """
    fmt = bench.frame_format
    frames = np.empty((0, *fmt.shape), fmt.dtype)
    for number, sequence in enumerate(plan.sequences):
        if len(frames) != len(sequence):
            frames = np.empty((len(sequence), *fmt.shape), fmt.dtype)
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                bench.prepare(plan.render(number))
                for index in range(len(frames)):
                    bench.expose(index, frames[index])
                break
            except HardwareError as error:
                if not error.repeatable or attempt == _ATTEMPTS:
                    raise
        yield number, frames
