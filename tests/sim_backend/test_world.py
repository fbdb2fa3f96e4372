"""One world behind the real drivers. Its light is direct: every pixel of a frame must be the pixel of its pattern."""

import os
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from virtual import HEIGHT, LATENCY, WIDTH, all_photographed, photographed, require_virtual_bench, sequence, small
from windows import within

from drivers import DeviceLostError, FrameTimeoutError, HardwareError, SequenceFaultError
from sim_backend.gentl import Fault, unplug
from sim_backend.virtual_bench import CAMERA_SERIAL, open_bench, open_world

PERIOD = 1 / 60
SEQUENCE = 12


@pytest.fixture(scope="module", autouse=True)
def _possible():
    require_virtual_bench()


@pytest.fixture(scope="module")
def world():
    """The process, and the ends of its wires."""
    with open_world(small()) as (process, ends):
        yield process, ends


@pytest.fixture
def bench(world):
    """Opens a bench of real drivers on the world."""

    @contextmanager
    def make(**changes):
        with open_bench(small(**changes), world[1]) as bench:
            yield bench

    return make


@pytest.fixture(scope="class")
def stepped(world):
    with open_bench(small(), world[1]) as bench:
        yield bench


@pytest.fixture(scope="class")
def streamed(world):
    with open_bench(small(synchronisation="stream", trigger="box"), world[1]) as bench:
        yield bench


@pytest.fixture(scope="module")
def patterns():
    random = np.random.default_rng(11)
    return list(random.integers(0, 256, (SEQUENCE, HEIGHT, WIDTH), np.uint8))


class TestStepByStep:
    """Nothing but the command triggers; faults of the display are in the next class."""

    def test_each_frame_is_its_pattern_to_the_last_bit(self, stepped, patterns):
        frames, stamps = sequence(stepped, patterns)
        for frame, pattern in zip(frames, patterns, strict=True):
            np.testing.assert_array_equal(frame, pattern)
        ids = np.array([stamp.frame_id for stamp in stamps])
        assert (np.diff(ids) == 1).all()
        for stamp in stamps:
            assert stamp.t_shown_s + LATENCY <= stamp.t_device_s <= stamp.t_host_s <= time.monotonic()

    def test_a_frozen_display_shows_the_pattern_before(self, stepped, world, patterns):
        stepped.prepare(patterns)
        photographed(stepped, 3)
        world[0].call("freeze", 600.0)
        try:
            frame, _ = photographed(stepped, 4)
        finally:
            world[0].call("freeze", 0.0)
        np.testing.assert_array_equal(frame, patterns[3])
        frame, _ = photographed(stepped, 5)
        np.testing.assert_array_equal(frame, patterns[5])

    def test_a_refresh_that_was_missed_is_within_the_settle_time(self, stepped, world, patterns):
        for _ in range(10):
            stepped.prepare(patterns)
            photographed(stepped, 3)
            before = world[0].call("counts")
            world[0].call("drop", 1)
            frame, _ = photographed(stepped, 4)
            after = world[0].call("counts")
            assert after["dropped"] == before["dropped"] + 1
            if after["skipped"] == before["skipped"]:  # nor did the machine keep the display from refreshing
                break
        np.testing.assert_array_equal(frame, patterns[4])

    def test_a_display_slower_than_the_settle_time_shows_the_pattern_before(self, stepped, world, patterns):
        for _ in range(10):
            stepped.prepare(patterns)
            photographed(stepped, 3)
            world[0].call("delay", 0.5)
            try:
                frame, stamp = photographed(stepped, 4)
            finally:
                world[0].call("delay", LATENCY)
            time.sleep(0.6)
            if stamp.t_device_s < stamp.t_shown_s + 0.45:  # exposed before the picture came, as on a machine with time
                break
        np.testing.assert_array_equal(frame, patterns[3])

    def test_an_exposure_across_a_change_mixes_both_patterns(self, stepped, world):
        dark, bright = (np.full((HEIGHT, WIDTH), level, np.uint8) for level in (20, 220))
        seen = []
        try:
            # From the flip about half a refresh passes to the scan-out; somewhere here it falls into the exposure.
            for milliseconds in [*range(0, 24, 3)] * 3:
                if {20, 220} < {int(frame.min()) for frame in seen}:
                    break
                world[0].call("delay", LATENCY)
                stepped.prepare([dark, bright])
                photographed(stepped, 0)
                world[0].call("delay", stepped.settle_s - PERIOD / 2 + milliseconds * 1e-3)
                seen.append(photographed(stepped, 1)[0])
        finally:
            world[0].call("delay", LATENCY)
        # Never torn: light adds up over the exposure, in all pixels alike.
        levels = {int(frame.min()) for frame in seen} | {int(frame.max()) for frame in seen}
        assert all(frame.min() == frame.max() for frame in seen)
        assert {20, 220} < levels

    def test_without_the_lamp_frames_are_black(self, stepped, world, patterns):
        stepped.prepare(patterns)
        world[0].call("black_out", True)
        frame, _ = photographed(stepped, 0)
        world[0].call("black_out", False)
        assert frame.max() == 0
        frame, _ = photographed(stepped, 1)
        np.testing.assert_array_equal(frame, patterns[1])

    def test_darkened_nothing_is_on_the_surface(self, stepped, world, patterns):
        stepped.prepare(patterns)
        photographed(stepped, 0)
        np.testing.assert_array_equal(world[0].call("shown"), patterns[0])
        stepped.darken()
        assert within(10.0, lambda: world[0].call("shown").max() == 0)

    def test_a_lost_frame_times_out_and_the_sequence_can_be_repeated(self, stepped, world, patterns):
        stepped.prepare(patterns)
        stepped.timeout_s, before = 0.3, stepped.timeout_s
        assert world[0].call("upset_camera", Fault.DROP, 1)
        try:
            with pytest.raises(HardwareError) as lost:
                photographed(stepped, 0)
        finally:
            stepped.timeout_s = before
        assert lost.value.repeatable
        frames, _ = sequence(stepped, patterns[:3])
        np.testing.assert_array_equal(frames[2], patterns[2])

    def test_an_unplugged_camera_comes_back(self, stepped, world, patterns):
        stepped.prepare(patterns)
        photographed(stepped, 0)
        unplug(Path(os.environ["MFS_SIM_GENTL_DIR"]), CAMERA_SERIAL, away_s=1.0)
        with pytest.raises(DeviceLostError):
            photographed(stepped, 1)
        stepped.darken()
        frames, _ = sequence(stepped, patterns[:2])
        np.testing.assert_array_equal(frames[1], patterns[1])


@pytest.mark.parametrize(("bits", "packed"), [(10, True), (12, False), (12, True)])
def test_deeper_pixels_arrive_whole(bench, patterns, bits, packed):
    with bench(camera={"bits": bits, "packed": packed}) as deep:
        assert deep.frame_format.bits == bits
        (frame,), _ = sequence(deep, patterns[:1])
    np.testing.assert_array_equal(frame, patterns[0].astype(np.uint16) << (bits - 8))


def test_the_trigger_box_exposes_and_counts_back(world, bench, patterns):
    with bench(trigger="box") as boxed:
        for attempt in range(30):
            before = world[0].call("counts")
            try:
                frames, _ = sequence(boxed, patterns, attempts=1)
                break
            except HardwareError as error:  # a busy machine may cost an attempt, as in a scan
                if not error.repeatable or attempt == 29:
                    raise
        after = world[0].call("counts")
        for what in ("pulses", "pictures", "changes"):
            assert after[what] - before[what] == SEQUENCE
        for frame, pattern in zip(frames, patterns, strict=True):
            np.testing.assert_array_equal(frame, pattern)
        counts = boxed.trigger.counts()
        assert (counts.sent, counts.exposed, counts.missed) == (SEQUENCE, SEQUENCE, 0)


class TestStreamed:
    def test_one_pattern_a_refresh_each_exposed_by_its_own_light(self, streamed, patterns):
        frames, stamps = sequence(streamed, patterns)
        x, y, width, height = small().sync_patch
        beside = np.ones((HEIGHT, WIDTH), bool)
        beside[y : y + height, x : x + width] = False
        for number, (frame, pattern) in enumerate(zip(frames, patterns, strict=True)):
            np.testing.assert_array_equal(frame[beside], pattern[beside])
            assert (frame[~beside] == (255 if number % 2 == 0 else 0)).all()
        begun = np.diff([stamp.t_device_s for stamp in stamps])
        np.testing.assert_allclose(begun, PERIOD, atol=1e-4)

    def test_an_odd_number_of_patterns(self, streamed, patterns):
        frames, _ = sequence(streamed, patterns[:5])
        assert len(frames) == 5
        again, _ = sequence(streamed, patterns[:5])
        np.testing.assert_array_equal(again[4][: HEIGHT // 2], patterns[4][: HEIGHT // 2])

    def test_a_frozen_display_is_noticed(self, streamed, world, patterns):
        sequence(streamed, patterns)
        streamed.prepare(patterns)
        streamed.timeout_s, before = 0.3, streamed.timeout_s
        world[0].call("freeze", 600.0)
        try:
            with pytest.raises((FrameTimeoutError, SequenceFaultError)) as fault:
                all_photographed(streamed, patterns)
        finally:
            world[0].call("freeze", 0.0)
            streamed.darken()
            streamed.timeout_s = before
        assert fault.value.repeatable
        frames, _ = sequence(streamed, patterns)
        np.testing.assert_array_equal(frames[-1][: HEIGHT // 2], patterns[-1][: HEIGHT // 2])

    def test_a_box_that_restarts_is_noticed_and_comes_back(self, streamed, world, patterns):
        sequence(streamed, patterns)
        streamed.prepare(patterns)
        world[0].call("reboot_box", 0.0)
        streamed.timeout_s, before = 0.3, streamed.timeout_s
        try:
            with pytest.raises(HardwareError) as fault:
                all_photographed(streamed, patterns)
        finally:
            streamed.darken()
            streamed.timeout_s = before
        assert fault.value.repeatable
        frames, _ = sequence(streamed, patterns)
        assert len(frames) == SEQUENCE


def test_the_display_refreshes_at_its_rate(world):
    def counted():
        before, counts = time.monotonic(), world[0].call("counts")
        return counts, before, time.monotonic()

    counts, began, began_at_last = counted()
    time.sleep(0.5)
    later, ended, ended_at_last = counted()
    refreshes = sum(later[what] - counts[what] for what in ("scan_outs", "skipped"))
    # Those that were skipped are counted at the next one, which may come a little late.
    assert (ended - began_at_last) / PERIOD - 3 <= refreshes <= (ended_at_last - began) / PERIOD + 3


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValidationError, match="trigger: box"):
        small(synchronisation="stream")
    with pytest.raises(ValidationError, match="at most 15000"):
        small(synchronisation="stream", trigger="box", camera={"exposure_us": 16_667})
    small(synchronisation="stream", trigger="box", camera={"exposure_us": 15_000})
    with pytest.raises(ValidationError, match="multiple of 8"):
        small(camera={"width_px": 321})
