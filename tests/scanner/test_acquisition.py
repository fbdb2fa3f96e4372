"""The state machine on a bench whose truth is an array: order, retries, faults, interruption, and the result itself."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import DeviceLostError, DeviceSettingError, FrameLossError, FrameTimeoutError, OperatorError
from scanner.acquisition import (
    TRANSITIONS,
    Acquisition,
    AcquisitionError,
    ScanState,
)
from scanner.config import GatesSection, ScanSection
from scanner.decoding import Decoder
from scanner.methods import METHODS
from scanner.preflight import ExposureError, check_exposure
from scanner.processing import process_take
from scanner.result import Flag
from scanner.take import Take, TakeWriter


class Recorder:
    def __init__(self) -> None:
        self.states: list[ScanState] = []
        self.frames = []
        self.notes = []

    def state(self, state, what):
        self.states.append(state)

    def frame(self, progress):
        self.frames.append(progress)

    def note(self, text):
        self.notes.append(text)


def acquisition(bench, folder, method="mfs", **scan):
    section = ScanSection(method=method, **({"steps": 6} | scan))
    chosen = METHODS[method]
    plan = chosen.first_round(section, bench.projector_size)
    take = TakeWriter.create(
        folder / "take",
        frame_format=bench.frame_format,
        slots=plan.frame_count,
        manifest={"method": method, "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True},
    )
    decoder = Decoder(chosen, section, bench.noise, None)
    return Acquisition(bench, chosen, section, decoder, take, Recorder())


def run(job):
    with job.take:
        return job.run()


def test_two_rounds_remove_the_bounce(array_bench, tmp_path):
    bench = array_bench()
    job = acquisition(bench, tmp_path, steps=12)
    maps = run(job)
    region, clean = bench.alpha > 0, bench.alpha == 0
    found = maps.interreflection
    # The rectangle's border is sharp to a pixel: 60 × 50 pixels.
    assert (found & region).sum() / region.sum() > 0.98
    assert (found & clean).sum() / found.sum() < 0.02
    error_x, error_y = np.abs(maps.x_p - bench.x), np.abs(maps.y_p - bench.y)
    assert np.isfinite(error_x[region]).mean() > 0.97
    for error in (error_x, error_y):
        assert np.nanmedian(error[region]) <= 1.2 * np.nanmedian(error[clean])
        assert (error[region & np.isfinite(error)] < 0.25).mean() > 0.98
    first = np.abs(maps.x_p_round1 - bench.x)
    assert np.nanmedian(first[region]) > 10 * np.nanmedian(error_x[region])
    assert (maps.flags[region & np.isfinite(error_x)] & (Flag.SECOND_ROUND | Flag.SEPARATED)).all()
    # What was lit in round two is what the region sees directly, and no more than the margin beside it.
    lit_x = np.flatnonzero(maps.lit.any(axis=0))
    assert lit_x.min() > bench.x[region].min() - 10
    assert lit_x.max() < bench.x[region].max() + 10


def test_states_journal_and_progress(array_bench, tmp_path):
    bench = array_bench()
    job = acquisition(bench, tmp_path)
    run(job)
    states = job.listener.states
    s = ScanState
    assert states == [s.PREFLIGHT, s.CAPTURING, s.DECODING, s.CAPTURING, s.DECODING, s.COMPLETED]
    assert bench.dark
    take = Take.open(tmp_path / "take")
    assert take.status == "completed"
    assert list(take.states) == [str(x) for x in states]
    assert len(take.sequences(1)) == len(take.sequences(2)) == 18
    done = [p.done for p in job.listener.frames]
    assert done == list(range(1, 2 * 108 + 1))
    assert job.listener.frames[-1].done == job.listener.frames[-1].total


@pytest.mark.parametrize("method", ["tps", "mps", "mps_gn"])
def test_one_round_methods_use_the_same_machine(array_bench, tmp_path, method):
    bench = array_bench(alpha=np.zeros((120, 160)))
    job = acquisition(bench, tmp_path, method)
    maps = run(job)
    assert job.listener.states[-2:] == [ScanState.DECODING, ScanState.COMPLETED]
    known = np.isfinite(maps.x_p) & np.isfinite(maps.y_p)
    assert known.mean() > (0.9 if method == "mps_gn" else 0.999)
    z = ((maps.x_p - bench.x) / maps.sigma_x)[known]
    # Cubic interpolation between projector pixels is good to 1e-3 px, a tenth of σ.
    assert np.std(z) == pytest.approx(1, abs=0.06)


def test_no_bounce_no_second_round(array_bench, tmp_path):
    bench = array_bench(alpha=np.zeros((120, 160)))
    job = acquisition(bench, tmp_path)
    maps = run(job)
    assert not maps.interreflection.any()
    assert bench.exposures == 2 + 108
    assert 2 not in Take.open(tmp_path / "take").rounds


def far_bounce(array_bench):
    """A bench whose bounce comes from far away on both axes: one round separates it."""
    bench = array_bench()
    bench.y_bounce = bench.y + 70
    return bench


def test_second_round_is_skipped_where_the_first_suffices(array_bench, tmp_path):
    bench = far_bounce(array_bench)
    job = acquisition(bench, tmp_path, steps=12, rounds="auto")
    maps = run(job)
    assert bench.exposures == 2 + 216
    take = Take.open(tmp_path / "take")
    assert 2 not in take.rounds
    assert "round two is not needed, 216 frames are saved" in job.decoder.decision
    assert job.decoder.decision in job.listener.notes
    assert maps.lit is None
    region = bench.alpha > 0
    for error in (np.abs(maps.x_p - bench.x)[region], np.abs(maps.y_p - bench.y)[region]):
        # Coordinates that are there are right, and nearly all are there.
        assert np.isfinite(error).mean() > 0.97
        assert (error[np.isfinite(error)] < 0.25).mean() > 0.99
    assert (maps.flags[region & maps.valid & maps.interreflection] & Flag.SEPARATED).all()


def test_second_round_follows_where_the_first_leaves_doubt(array_bench, tmp_path):
    # 11 px apart on the axis y: without a rig these are as good as one path.
    bench = array_bench()
    job = acquisition(bench, tmp_path, rounds="auto")
    maps = run(job)
    assert bench.exposures == 2 + 108 + 2 + 108
    assert job.decoder.decision.startswith("round two follows: ")
    assert "more than 2 times the noise of direct light alone" in job.decoder.decision
    assert maps.lit is not None


def test_one_round_if_it_is_asked_for(array_bench, tmp_path):
    bench = array_bench()
    job = acquisition(bench, tmp_path, rounds=1)
    maps = run(job)
    assert bench.exposures == 2 + 108
    assert all(p.rounds == 1 for p in job.listener.frames)
    # What is in doubt is left out, and says why.
    lost = maps.interreflection & ~maps.valid
    assert lost.any()
    assert (maps.flags[lost] != 0).all()


def test_bad_sequence_is_repeated_and_the_result_is_good(array_bench, tmp_path):
    # Two preflight pictures, then sequence 3 (frames 14..19): its fourth frame shows the third pattern again.
    bench = array_bench(on_expose=lambda number, index: 2 if number == 2 + 12 + 3 else None)
    job = acquisition(bench, tmp_path)
    maps = run(job)
    assert ScanState.REPEATING in job.listener.states
    assert any("frame 4 shows step 3" in note for note in job.listener.notes)
    assert job.repeats == 6
    assert (np.abs(maps.x_p - bench.x)[bench.alpha == 0] < 0.25).mean() > 0.99
    take = Take.open(tmp_path / "take")
    assert take.status == "completed"
    assert not take.missing(1)


def flickering(bench, at, excess):
    """Make the light brighter by ``excess`` DN at the exposures ``at``."""
    ambient = bench.ambient
    bench.on_expose = lambda number, index: setattr(bench, "ambient", ambient + excess * (number in at))
    return bench


def test_a_fault_that_only_the_whole_round_shows_is_mended_after_it(array_bench, tmp_path):
    # 1.2 times the noise of a phase in frame 8 of 54, which three steps cannot tell from a fringe a bit brighter.
    bench = flickering(array_bench(), {2 + 3 * 2 + 1}, 3.2)
    job = acquisition(bench, tmp_path, steps=3)
    maps = run(job)
    assert job.repeats == 3
    assert any("at odds with what the other frequencies of axis x" in note for note in job.listener.notes)
    take = Take.open(tmp_path / "take")
    assert {s: r.attempt for s, r in take.sequences(1).items()} == {s: 2 if s == 2 else 1 for s in range(18)}
    journal = [json.loads(line) for line in (tmp_path / "take/journal.jsonl").read_text().splitlines()]
    fate = [(r["kind"], r["attempt"]) for r in journal if r.get("round") == 1 and r.get("sequence") == 2]
    assert [f for f in fate if f[0] != "frame"] == [
        ("sequence_committed", 1),
        ("sequence_aborted", 1),
        ("sequence_committed", 2),
    ]
    # What was wrong left no trace in the result: it is that of the frames that count.
    again = process_take(take, job.scan, GatesSection(), None)
    np.testing.assert_array_equal(again.maps.x_p, maps.x_p)
    np.testing.assert_allclose(again.maps.brightness, maps.brightness, rtol=1e-6)


def test_what_is_the_same_on_two_takes_is_no_fault(array_bench, tmp_path):
    # All attempts at sequence 3 have it: the scene or the bench makes the difference, and the scan goes on.
    bench = flickering(array_bench(), {2 + 3 * 2 + 1, 2 + 54 + 1}, 3.2)
    job = acquisition(bench, tmp_path, steps=3)
    run(job)
    assert job.repeats == 3
    assert Take.open(tmp_path / "take").status == "completed"


def test_gives_up_after_the_allowed_attempts(array_bench, tmp_path):
    bench = array_bench(on_expose=lambda number, index: 2 if number >= 2 and index == 3 else None)
    job = acquisition(bench, tmp_path, attempts=2)
    with pytest.raises(AcquisitionError, match="failed its check on 2 attempts") as caught:
        run(job)
    assert caught.value.exit_code == 3
    assert "settle time" in caught.value.remedy
    assert bench.dark
    assert Take.open(tmp_path / "take").status == "failed"


FAILURES = {
    "timeout": FrameTimeoutError("camera: no frame", "look at the trigger"),
    "loss": FrameLossError("camera: frame 17 is incomplete", "look at the cable"),
    "lost": DeviceLostError("camera: gone", "plug it in"),
}


@pytest.mark.parametrize(
    ("error", "at"),
    [("lost", 1), ("lost", 2), ("lost", 2 + 107), ("lost", 2 + 108 + 40), ("timeout", 17), ("loss", 17)],
)
def test_device_that_fails_once_costs_one_sequence(array_bench, tmp_path, at, error):
    error = FAILURES[error]

    def fail(number, index):
        if number == at:
            raise error

    bench = array_bench(on_expose=fail)
    job = acquisition(bench, tmp_path)
    maps = run(job)
    assert (np.abs(maps.x_p - bench.x)[bench.alpha == 0] < 0.25).mean() > 0.99
    assert [note for note in job.listener.notes if error.message in note]
    take = Take.open(tmp_path / "take")
    assert take.status == "completed"
    assert not take.missing(1)
    assert not take.missing(2)
    # In the exposure check nothing is recorded yet.
    assert job.repeats == (0 if at < 2 else 6)
    journal = (tmp_path / "take" / "journal.jsonl").read_text()
    assert journal.count("sequence_aborted") == (0 if at < 2 else 1)


def test_device_that_cannot_be_used_ends_the_scan_at_once(array_bench, tmp_path):
    refusal = DeviceSettingError("camera: no such feature", "correct it")

    def fail(number, index):
        if number == 17:
            raise refusal

    job = acquisition(array_bench(on_expose=fail), tmp_path)
    with pytest.raises(DeviceSettingError):
        run(job)
    assert job.bench.exposures == 18
    assert job.bench.dark


def test_trouble_with_darkening_does_not_hide_what_went_wrong(array_bench, tmp_path, monkeypatch):
    def fail(number, index):
        if number >= 17:
            raise DeviceLostError("camera: gone", "plug it in")

    bench = array_bench(on_expose=fail)
    monkeypatch.setattr(type(bench), "darken", _darken_that_fails_later())
    with pytest.raises(DeviceLostError, match="camera: gone"):
        run(acquisition(bench, tmp_path))


def _darken_that_fails_later():
    def darken(self):
        if self.exposures > 3:
            raise DeviceLostError("projector: gone as well", "plug it in")

    return darken


@pytest.mark.parametrize("at", [0, 1, 2, 50, 2 + 108, 2 + 108 + 40, 2 + 215])
@pytest.mark.parametrize("error", [DeviceLostError("camera: gone", "plug it in"), KeyboardInterrupt()])
def test_whatever_ends_a_scan_the_projector_is_dark_and_the_take_opens(array_bench, tmp_path, at, error):
    def fail(number, index):
        if number >= at:
            raise error

    bench = array_bench(on_expose=fail)
    job = acquisition(bench, tmp_path)
    with pytest.raises(type(error)):
        run(job)
    assert bench.dark
    expected = ScanState.CANCELLED if isinstance(error, KeyboardInterrupt) else ScanState.FAILED
    assert job.state is expected
    take = Take.open(tmp_path / "take")
    assert take.status == str(expected)
    complete = max(0, (min(at, 110) - 2) // 6)
    # The sequence before the one that broke may still have been in its check.
    assert complete - 1 <= len(take.sequences(1) if 1 in take.rounds else {}) <= complete
    assert not [t for t in threading.enumerate() if t.name.startswith("decode")]


def test_too_bright_and_too_dark_are_refused_before_anything_is_measured(array_bench, tmp_path):
    job = acquisition(array_bench(gain=1.4), tmp_path / "bright")
    with pytest.raises(ExposureError, match="saturated") as caught:
        run(job)
    assert caught.value.exit_code == 2
    assert job.bench.exposures == 2
    job = acquisition(array_bench(gain=0.0), tmp_path / "dark")
    with pytest.raises(ExposureError, match="brighter"):
        run(job)
    assert job.bench.dark


def test_exposure_limits_are_what_they_say():
    bright = np.full((100, 100), 200, np.uint8)
    dark = np.full((100, 100), 5, np.uint8)
    bright.ravel()[:200] = 255
    check_exposure(bright, dark, 255, 0.02)
    bright.ravel()[:201] = 255
    with pytest.raises(ExposureError):
        check_exposure(bright, dark, 255, 0.02)


@given(st.lists(st.sampled_from(list(ScanState)), max_size=12))
@settings(max_examples=200, deadline=None)
def test_no_way_leads_out_of_an_end(path):
    state = ScanState.IDLE
    for wanted in path:
        if wanted in TRANSITIONS[state]:
            state = wanted
    if state in (ScanState.COMPLETED, ScanState.CANCELLED, ScanState.FAILED):
        assert not TRANSITIONS[state]
    else:
        assert ScanState.FAILED in TRANSITIONS[state]
        assert ScanState.CANCELLED in TRANSITIONS[state]


def test_disk_full_in_the_middle_ends_with_a_word_and_a_dark_projector(array_bench, tmp_path, monkeypatch):
    bench = array_bench()
    job = acquisition(bench, tmp_path)
    import os

    real, count = os.pwrite, [0]

    def full(*args):
        count[0] += 1
        if count[0] > 40:
            raise OSError(28, "No space left on device")
        return real(*args)

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OperatorError, match=r"space|safe") as caught:
        run(job)
    assert getattr(caught.value, "exit_code", None) == 3
    assert bench.dark
    monkeypatch.undo()
    assert len(Take.open(tmp_path / "take").sequences(1)) >= 5
