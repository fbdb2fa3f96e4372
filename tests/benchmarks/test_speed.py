"""Speed and memory at the paper's scale, as ratios within one run; `make bench` prints them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from drivers import FrameFormat, NoiseModel
from scanner.interreflection import modulation_variation
from scanner.patterns import Plan, phase_steps
from scanner.phasors import RoundPhasors
from scanner.unwrapping import modulation_trend, unwrap

pytestmark = pytest.mark.bench

HEIGHT, WIDTH = 1600, 2560  # 4.1 megapixels
FREQUENCIES = [(80 + t) / 2560 for t in range(9)]  # 80 to 88 fringes, as the paper has them


@pytest.fixture(scope="module")
def one_axis():
    """Nine frequencies of twelve steps, 4.1 megapixels, 8 bit."""
    rng = np.random.default_rng(0)
    plan = Plan((WIDTH, HEIGHT), tuple(phase_steps("x", f, 12) for f in FREQUENCIES))
    u = np.arange(WIDTH) + 0.3
    frames = []
    for sequence in plan.sequences:
        line = 110 + 80 * np.cos(2 * np.pi * sequence.frequency * u + sequence.steps_rad[:, None])
        noise = rng.normal(0, 1.5, (12, HEIGHT, 64)).astype(np.float32)
        tiled = np.tile(noise, WIDTH // 64)
        frames.append(np.rint(line[:, None, :] + tiled).astype(np.uint8))
    return plan, frames, u


def decode(plan, frames):
    collected = RoundPhasors(plan, FrameFormat(WIDTH, HEIGHT, 8))
    for i, stack in enumerate(frames):
        collected.add(i, stack)
    phasors = collected.axis("x")
    sigma_z = phasors.sigma_z(NoiseModel(1.53), collected.mean)
    return unwrap(phasors, sigma_z, WIDTH, modulation_trend(phasors, sigma_z))


def best_of(count, run):
    times = []
    for _ in range(count):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)


def test_one_axis_against_the_peer_and_against_reading_the_frames(one_axis, capsys):
    plan, frames, u = one_axis
    decode(plan, frames)
    ours = best_of(3, lambda: decode(plan, frames))
    assert np.median(np.abs(decode(plan, frames).u - u)) < 0.02

    flat = [stack.reshape(-1).view(np.uint64) for stack in frames]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        reading = best_of(3, lambda: list(pool.map(np.max, flat)))

    fringes = pytest.importorskip("fringes", reason="the peer package Fringes is installed by `make bench`")
    peer = fringes.Fringes(X=WIDTH, Y=HEIGHT, axes=(0,), K=9, N=((12,) * 9,), v=(tuple(range(80, 89)),))
    whole = np.concatenate(frames)[..., None]
    peer.decode(np.ascontiguousarray(whole))  # compiles
    theirs = best_of(1, lambda: peer.decode(whole))
    with capsys.disabled():
        print(
            f"\none axis, 9 × 12 frames, 4.1 Mpx, frames in memory → coordinate, σ, χ²: {ours:.2f} s\n"
            f"  Fringes on the same frames and cores: {theirs:.1f} s, {theirs / ours:.0f} × as long\n"
            f"  reading the frames once: {reading:.3f} s; decoding takes {ours / reading:.1f} × that"
        )
    assert theirs / ours >= 25


def test_variation_and_detection_add_little(one_axis, capsys):
    plan, frames, _ = one_axis
    collected = RoundPhasors(plan, FrameFormat(WIDTH, HEIGHT, 8))
    for i, stack in enumerate(frames):
        collected.add(i, stack)
    seconds = best_of(3, lambda: modulation_variation(collected.axis("x"), np.ones(9)))
    with capsys.disabled():
        print(f"\nmodulation variation, 4.1 Mpx: {seconds:.2f} s")


_TAKE = """
import sys, numpy as np
from drivers import FrameFormat, FrameStamp
from scanner.config import ScanSection
from scanner.methods import METHODS
from scanner.take import TakeWriter
folder, width, height = sys.argv[1], 4008, 2688
method, scan = METHODS["mfs"], ScanSection()
plan = method.first_round(scan, (1280, 800))
fmt = FrameFormat(width, height, 8)
rng = np.random.default_rng(0)
u = {"x": np.broadcast_to(np.linspace(40, 1240, width, dtype=np.float32), (height, width)),
     "y": np.broadcast_to(np.linspace(20, 780, height, dtype=np.float32)[:, None], (height, width))}
noise = rng.normal(0, 1.5, (height, width)).astype(np.float32)
manifest = dict(method="mfs", bench={}, config={"scan": scan.model_dump(mode="json")}, plans=[plan.to_json()],
                simulated=True)
with TakeWriter.create(folder, frame_format=fmt, slots=plan.frame_count, manifest=manifest) as take:
    take.begin_round(1, plan.to_json())
    for s, sequence in enumerate(plan.sequences):
        for n, fringe in enumerate(sequence.fringes):
            shift = int(rng.integers(1, width))
            phase = np.float32(2 * np.pi * fringe.frequency) * u[sequence.axis] + np.float32(fringe.step_rad)
            frame = np.rint(110 + 80 * np.cos(phase) + np.roll(noise, shift)).astype(np.uint8)
            take.write_frame(1, s, 1, n, frame, FrameStamp(0, 0.0, 0.0))
        take.commit_sequence(1, s, 1)
"""

_PEAK = """
import json, resource, sys, time
from scanner import cli
began = time.perf_counter()
try:
    cli.app(["process", sys.argv[1], "--out", sys.argv[2], "--quiet"], standalone_mode=False)
except SystemExit:
    pass
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(json.dumps({"seconds": time.perf_counter() - began, "peak_kib": peak}))
"""


def test_full_scale_take_decodes_within_six_gigabytes(tmp_path, capsys):
    subprocess.run([sys.executable, "-c", _TAKE, str(tmp_path / "take")], check=True)
    done = subprocess.run(
        [sys.executable, "-c", _PEAK, str(tmp_path / "take"), str(tmp_path / "out")],
        check=True,
        capture_output=True,
        text=True,
    )
    figures = json.loads(done.stdout.splitlines()[-1])
    with capsys.disabled():
        print(
            f"\n216 frames of 4008 × 2688 px, take → result folder: {figures['seconds']:.1f} s, "
            f"peak {figures['peak_kib'] / 2**20:.2f} GiB"
        )
    assert figures["peak_kib"] * 1024 < 6e9


def test_cold_compilation(tmp_path, capsys):
    done = subprocess.run(
        [sys.executable, "-m", "scanner.kernels"],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
    )
    with capsys.disabled():
        print(f"\n{done.stdout.strip()} into an empty cache")


def test_help_answers_at_once(capsys):
    command = [os.path.join(os.path.dirname(sys.executable), "scan"), "--help"]
    subprocess.run(command, check=True, capture_output=True)
    seconds = best_of(5, lambda: subprocess.run(command, check=True, capture_output=True))
    with capsys.disabled():
        print(f"\nscan --help: {seconds:.2f} s")
    assert seconds < 0.5
