"""How fast the real drivers take patterns, on the virtual bench with pictures that cost nothing. Figures are printed.

Window, X server, world and camera are four busy processes; on two cores nothing else may run beside.
"""

import sys
import time
from contextlib import suppress

import numpy as np
import pytest
from stalls import Watcher
from virtual import all_photographed, require_virtual_bench, sequence, small

from drivers import HardwareError
from sim_backend.virtual_bench import open_bench, open_world

pytestmark = pytest.mark.bench

REFRESH_HZ = 60.0
PATTERNS = 216
SIZE = {"width_px": 640, "height_px": 400}


@pytest.fixture(scope="module")
def world():
    require_virtual_bench()
    with open_world(settings()) as (_, ends):
        yield ends


def settings(**changes):
    return small(camera=SIZE, projector=SIZE | {"latency_s": 0.035}, **changes)


@pytest.fixture(scope="module")
def patterns():
    """As many patterns as a round has, all different."""
    columns = np.arange(SIZE["width_px"])
    phases = np.arange(PATTERNS)[:, None] * 2 * np.pi / PATTERNS
    rows = np.rint(127.5 + 127.5 * np.cos(2 * np.pi * columns / 16 + phases)).astype(np.uint8)
    return [np.tile(row, (SIZE["height_px"], 1)) for row in rows]


def report(*figures):
    print("\n   ", *figures, file=sys.stderr, flush=True)


def check(frames, patterns, patch=(0, 0, 0, 0)):
    """Each frame is its pattern: nothing was lost, repeated or swapped."""
    x, y, width, height = patch
    for frame, pattern in zip(frames, patterns, strict=True):
        seen, wanted = frame.copy(), pattern.copy()
        seen[y : y + height, x : x + width] = wanted[y : y + height, x : x + width] = 0
        np.testing.assert_array_equal(seen, wanted)


def test_step_by_step_takes_hardly_longer_than_latency_and_exposure(world, patterns):
    chosen = settings()
    with open_bench(chosen, world) as bench:
        bench.prepare(patterns[:60])
        began = time.monotonic()
        frames, stamps = all_photographed(bench, patterns[:60])
        seconds = (time.monotonic() - began) / 60
        check(frames, patterns[:60])
        own = np.median([stamp.t_host_s - stamp.t_device_s for stamp in stamps]) - chosen.camera.exposure_us * 1e-6
        bound = (bench.settle_s + chosen.camera.exposure_us * 1e-6) * REFRESH_HZ
    refreshes = seconds * REFRESH_HZ
    report(
        f"step by step: {1 / refreshes:.3f} patterns per refresh; settle {bench.settle_s * 1e3:.1f} ms and exposure "
        f"allow {1 / bound:.3f}; from the exposure's end to the frame {own * 1e3:.1f} ms"
    )
    # A pattern can begin at a refresh only, so the bound is rounded up to a whole one.
    assert refreshes < bound + 1.1


def test_hardware_triggered_takes_one_pattern_a_refresh(world, patterns):
    chosen = settings(synchronisation="stream", trigger="box")
    with open_bench(chosen, world) as bench:
        # The first run of a process meets cold memory; what counts is whether it can be done without a loss.
        for attempt in range(3):
            try:
                bench.prepare(patterns)
                began = time.monotonic()
                frames, stamps = all_photographed(bench, patterns)
                seconds = time.monotonic() - began
                break
            except HardwareError as error:
                bench.darken()
                report(f"attempt {attempt + 1}: {error.message}")
        else:
            pytest.fail("no sequence without a loss")
        check(frames, patterns, chosen.sync_patch)
        counts = bench.trigger.counts()
        assert (counts.sent, counts.exposed, counts.missed) == (PATTERNS, PATTERNS, 0)
    assert (np.diff([stamp.frame_id for stamp in stamps]) == 1).all()
    begun = [stamp.t_device_s for stamp in stamps]
    rate = (PATTERNS - 1) / (begun[-1] - begun[0]) / REFRESH_HZ
    whole = PATTERNS / seconds / REFRESH_HZ
    report(f"hardware-triggered: {rate:.4f} patterns per refresh, {whole:.4f} from play to the last frame, none lost")
    assert rate >= 0.999
    assert whole >= 0.95


def test_a_round_of_short_sequences(world, patterns):
    """For information: between sequences of 12 patterns these are handed to the window."""
    for synchronisation, trigger in (("step", "software"), ("stream", "box")):
        with open_bench(settings(synchronisation=synchronisation, trigger=trigger), world) as bench:
            began = time.monotonic()
            for first in range(0, PATTERNS, 12):
                sequence(bench, patterns[first : first + 12])
            seconds = time.monotonic() - began
            report(f"{synchronisation}: a round of {PATTERNS} patterns in {seconds:.1f} s")


def test_the_camera_holds_up_no_other_thread(world, patterns):
    """Beside the same sequence without a camera, because the emulation itself keeps the cores busy."""
    shares, longest = {"with": [], "without": []}, 0.0
    with open_bench(settings(synchronisation="stream", trigger="box"), world) as bench:
        for _ in range(3):
            bench.prepare(patterns)
            with Watcher() as without:
                bench.projector.play()
                bench.projector.finish(10.0)
            bench.prepare(patterns)
            # A flip that the watcher has made late does not matter here.
            with Watcher() as watcher, suppress(HardwareError):
                all_photographed(bench, patterns)
            bench.darken()
            shares["without"].append(without.share_locked)
            shares["with"].append(watcher.share_locked)
            longest = max(longest, watcher.longest_locked_s)
    beside, alone = (float(np.median(shares[which])) for which in ("with", "without"))
    report(f"stalled > 2 ms: {beside:.2%} of the time, {alone:.2%} without the camera; longest {longest * 1e3:.1f} ms")
    assert beside - alone < 0.02
