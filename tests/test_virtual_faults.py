"""Faults in the middle of whole scans through the real drivers, on the virtual bench (one small world for all).

Each scan ends in one of two ways: it took the broken sequence again and its coordinates are as good as without a
fault, or it says what is wrong and what to do. Either way the take opens, the projector is dark, nothing is left over.
Run with -s to see the table: fault, what was seen, what the operator reads, how long it took.
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import signal
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest
from desktop import Desktop
from leftovers import shared_memory
from requirements import require
from windows import within

from drivers import DeviceBusyError, DeviceLostError, HardwareError, OperatorError
from scanner.acquisition import Acquisition, ScanState
from scanner.config import ScanSection
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.rig import Rig
from scanner.take import Take, TakeWriter
from sim_backend.gentl import Fault, plug, unplug
from sim_backend.virtual_bench import CAMERA_SERIAL, open_bench, open_world
from sim_backend.virtual_settings import VirtualSettings

SETTINGS = {
    "scene": {"name": "mirror"},
    "camera": {"width_px": 160, "height_px": 120, "exposure_us": 5000, "white_dn": 600, "readout_s": 0.001},
    "projector": {"width_px": 320, "height_px": 200, "refresh_hz": 100, "latency_s": 0.004},
    "transport": {"photons": 100_000, "supersample": 1},
    "trigger": "box",
    "reconnect_s": 30,
}
SCAN = {"steps": 4, "attempts": 6, "axes": ["x"], "frequencies_per_px": [n / 320 for n in range(16, 21)]}
TABLE: list[tuple[str, str, float, float | None, str]] = []


@pytest.fixture(scope="module")
def world(transport_cache):
    require(shutil.which("Xvfb"), "needs a virtual X server: apt-get install xvfb libgl1-mesa-dri")
    require(shutil.which(os.environ.get("CC", "cc")), "needs a C compiler: apt-get install gcc libc6-dev")
    settings = VirtualSettings.model_validate(SETTINGS)
    with open_world(settings) as (process, ends):
        yield World(settings, process, ends)
    print_table()


def print_table():
    print("\n| fault | seen after | then | goes on after | the operator reads |\n|---|---|---|---|---|")
    for fault, ends, seen, again, reads in TABLE:
        goes_on = "–" if again is None else f"{again:.2f} s"
        print(f"| {fault} | {seen:.2f} s | {ends} | {goes_on} | {' '.join(reads.split())} |")


@dataclass
class World:
    settings: VirtualSettings
    process: object
    ends: object

    @property
    def bus(self) -> Path:
        """Folder that stands for the camera's bus."""
        return Path(os.environ["MFS_SIM_GENTL_DIR"])

    def upset_camera(self, fault, count=1):
        assert self.process.call("upset_camera", fault, count)

    def call(self, *args):
        return self.process.call(*args)


@dataclass
class Saboteur:
    """Listens to a scan and strikes when frame ``at`` of round ``round`` was taken."""

    strike: object
    mend: object = None
    """Done once the scan has noticed."""
    round: int = 1
    at: int = 7
    notes: list = field(default_factory=list)
    states: list = field(default_factory=list)
    struck: float | None = None
    noticed: float | None = None
    again: float | None = None

    def state(self, state, what):
        self.states.append(state)
        if state is ScanState.REPEATING and self.noticed is None:
            self.noticed = time.monotonic()
            if self.mend is not None:
                self.mend()

    def frame(self, progress):
        if self.noticed is not None and self.again is None:
            self.again = time.monotonic()
        done = (progress.sequence - 1) * progress.frames + progress.frame
        if self.struck is None and progress.round == self.round and done == self.at:
            self.struck = time.monotonic()
            self.strike()

    def note(self, text):
        self.notes.append(text)


@contextmanager
def opened(world, **changes):
    """The real drivers, ready to scan."""
    with open_bench(world.settings.model_copy(update=changes), world.ends) as bench:
        bench.timeout_s = 1.5  # the world's pictures are small
        yield bench


def scan(bench, folder, listener):
    """Scan on an open bench; returns (acquisition, maps)."""
    section, method = ScanSection.model_validate({"method": "mfs"} | SCAN), METHODS["mfs"]
    plan = method.first_round(section, bench.projector_size)
    manifest = {"method": "mfs", "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True}
    with TakeWriter.create(
        folder / "take", frame_format=bench.frame_format, slots=2 * plan.frame_count, manifest=manifest
    ) as take:
        decoder = Decoder(method, section, bench.noise, Rig.from_json(bench.rig))
        job = Acquisition(bench, method, section, decoder, take, listener)
        return job, job.run()


def leftovers():
    """Processes below this one, without those that Python keeps for itself."""
    found = set()
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it has just gone
            if "resource_tracker" not in " ".join([process.name(), *process.cmdline()]).replace("-", "_"):
                found.add(process.pid)
    return found


@pytest.fixture(scope="class")
def clean(world):
    """Nothing that a scan has started is left when it is over, and the surface is dark."""
    before, shared = leftovers(), shared_memory()
    yield
    assert leftovers() <= before
    assert within(20.0, lambda: shared_memory() <= shared)
    assert within(10.0, lambda: world.call("shown").max() == 0)


@pytest.fixture(scope="class")
def bench(world, clean):
    """One bench for all faults that a scan survives: what one of them leaves behind, the next would stumble over."""
    with opened(world) as bench:
        yield bench


def undisturbed(scanned):
    """Maps of a scan in which nothing was taken again, as a busy machine may require; such a scan is made again."""
    for _ in range(5):
        job, maps = scanned()
        if not job.repeats:
            return maps
    raise AssertionError("something is taken again in every scan")


@pytest.fixture(scope="class")
def sound(bench, tmp_path_factory):
    """Coordinates of a scan without a fault."""
    maps = undisturbed(lambda: scan(bench, tmp_path_factory.mktemp("sound"), Saboteur(lambda: None)))
    assert np.isfinite(maps.x_p).mean() > 0.5
    assert maps.lit.any()  # there is a second round
    return maps


def agree(maps, sound):
    """Two scans of one scene differ by noise, three pixels in a thousand by more than 3 σ; some edges by their side."""
    difference = np.abs(maps.x_p - sound.x_p)
    noise = np.hypot(maps.sigma_x, sound.sigma_x)
    both = np.isfinite(difference)
    assert both.sum() > 0.97 * np.isfinite(sound.x_p).sum()
    assert (difference[both] > 3 * noise[both]).mean() < 0.01


RECOVERED = {
    "no frame": lambda w: w.upset_camera(Fault.MISS_TRIGGER),
    "frame lost": lambda w: w.upset_camera(Fault.DROP),
    "frame incomplete": lambda w: w.upset_camera(Fault.INCOMPLETE),
    "frame cut short, unsaid": lambda w: w.upset_camera(Fault.TRUNCATE),
    "frame of wrong size": lambda w: w.upset_camera(Fault.WRONG_SIZE),
    "frame delivered twice": lambda w: w.upset_camera(Fault.DUPLICATE),
    "pixels of the frame before": lambda w: w.upset_camera(Fault.REPEAT),
    "torn frame": lambda w: w.upset_camera(Fault.TEAR),
    "frame ids jump": lambda w: w.upset_camera(Fault.ID_JUMP),
    "camera unplugged and back": lambda w: unplug(w.bus, CAMERA_SERIAL, away_s=1.0),
    "producer crashes": lambda w: w.upset_camera(Fault.CRASH),
    "display shows the former picture": lambda w: w.call("freeze", 600.0),
    "lamp off for a moment": lambda w: w.call("black_out", True),
    "trigger box: garbled reply": lambda w: w.call("upset_box_wire", "garble_replies", 9),
    "trigger box: reboots": lambda w: w.call("reboot_box", 0.5),
    "trigger box: unplugged and back": lambda w: (w.call("unplug_box"), w.call("plug_in_box")),
}


MENDED = {
    "display shows the former picture": lambda w: w.call("freeze", 0.0),
    "lamp off for a moment": lambda w: w.call("black_out", False),
}
"""What does not pass by itself; it passes as soon as the scan has noticed."""


MEDDLING = {
    "closed": Desktop.ask_to_close,
    "hidden": Desktop.hide,
    "destroyed": Desktop.destroy,
    "moved": lambda desktop: desktop.move(10, 5),
    "covered for a moment": lambda desktop: desktop.uncover(desktop.cover(10, 10, 80, 60)),
}


class TestSequenceIsTakenAgain:
    @pytest.mark.parametrize("fault", RECOVERED)
    def test_and_the_result_is_as_good(self, world, bench, sound, tmp_path, fault):
        mend = MENDED.get(fault, lambda world: None)
        self.survive(fault, lambda: RECOVERED[fault](world), bench, sound, tmp_path, lambda: mend(world))

    @staticmethod
    def survive(fault, strike, bench, sound, tmp_path, mend=None):
        saboteur = Saboteur(strike, mend, round=2 if "unplugged" in fault else 1)
        _, maps = scan(bench, tmp_path, saboteur)
        assert saboteur.struck is not None
        agree(maps, sound)
        take = Take.open(tmp_path / "take")
        assert take.status == "completed"
        assert not take.missing(1)
        assert not take.missing(2)
        assert ScanState.REPEATING in saboteur.states, saboteur.notes
        assert "sequence_aborted" in (tmp_path / "take" / "journal.jsonl").read_text()
        struck, noticed, again = saboteur.struck, saboteur.noticed, saboteur.again
        TABLE.append((fault, "taken again", noticed - struck, again - noticed, saboteur.notes[0]))

    @pytest.mark.parametrize("deed", MEDDLING)
    def test_when_somebody_meddles_with_the_window(self, world, bench, sound, tmp_path, deed):
        with Desktop(world.ends.display) as desktop:
            self.survive(f"window {deed}", lambda: MEDDLING[deed](desktop), bench, sound, tmp_path)

    def test_when_the_window_s_process_dies(self, bench, sound, tmp_path):
        kill = lambda: os.kill(bench.projector.pid, signal.SIGKILL)  # noqa: E731
        self.survive("window's process dies", kill, bench, sound, tmp_path)

    def test_slow_disk_only_takes_longer(self, bench, sound, tmp_path, monkeypatch):
        write = os.pwrite

        def slow(fd, data, offset):
            time.sleep(0.05)
            return write(fd, data, offset)

        monkeypatch.setattr(os, "pwrite", slow)
        takes = itertools.count()
        maps = undisturbed(lambda: scan(bench, tmp_path / str(next(takes)), Saboteur(lambda: None)))
        agree(maps, sound)


ENDED = {
    "camera unplugged for good": (lambda w: unplug(w.bus, CAMERA_SERIAL), DeviceLostError, "camera SIM0001 was lost"),
    "trigger box silent": (lambda w: w.call("upset_box_wire", "silent", True), HardwareError, "box"),
    "projector dark for good": (lambda w: w.call("black_out", True), HardwareError, "failed its check"),
}


class TestScanEndsAndSaysWhy:
    @pytest.mark.parametrize("fault", ENDED)
    def test_it(self, world, clean, tmp_path, fault):
        strike, kind, says = ENDED[fault]
        saboteur = Saboteur(lambda: strike(world))
        try:
            with pytest.raises(kind, match=says) as caught, opened(world, reconnect_s=1.0) as bench:
                scan(bench, tmp_path, saboteur)
            seconds = time.monotonic() - saboteur.struck
        finally:
            plug(world.bus, CAMERA_SERIAL)
            world.call("upset_box_wire", "silent", False)
            world.call("black_out", False)
        assert caught.value.exit_code == 3
        assert caught.value.remedy
        take = Take.open(tmp_path / "take")
        assert take.status == "failed"
        assert take.sequences(1)  # what was sound before is kept
        TABLE.append((fault, "error, exit code 3", seconds, None, str(caught.value)))

    def test_full_disk(self, world, clean, tmp_path, monkeypatch):
        write = os.pwrite

        def full(fd, data, offset):
            if saboteur.struck is not None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return write(fd, data, offset)

        saboteur = Saboteur(lambda: monkeypatch.setattr(os, "pwrite", full))
        with pytest.raises(OperatorError, match="No space left") as caught, opened(world) as bench:
            scan(bench, tmp_path, saboteur)
        seconds = time.monotonic() - saboteur.struck
        assert Take.open(tmp_path / "take").sequences(1)
        TABLE.append(("disk full", f"error, exit code {caught.value.exit_code}", seconds, None, str(caught.value)))

    def test_camera_that_another_process_holds(self, world, clean):
        with (
            opened(world),
            pytest.raises(DeviceBusyError, match=CAMERA_SERIAL) as caught,
            opened(world),
        ):
            pass
        TABLE.append(("another process holds the camera", "error before the scan", 0.0, None, str(caught.value)))
