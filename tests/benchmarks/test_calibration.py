"""Calibrations of forty random simulated rigs, picture by picture, against their truth; and the solver's speed.

    python -m pytest tests/benchmarks/test_calibration.py -m bench -s

A rig takes a minute of one core. Each is kept in a folder when it is done, ``calibration-study/`` or what the variable
CALIBRATION_STUDY names, so that a study that was stopped goes on; remove the folder to begin anew. CALIBRATION_RIGS and
CALIBRATION_PROCESSES change their number and how many run at a time.
"""

import multiprocessing
import os
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np
import pytest
from simulated_calibration import studied
from synthetic_boards import CAMERA_SIZE, PROJECTOR_SIZE, board_points, good_poses, random_rig, seen_all

from calibration.bundle import calibrate_rig

pytestmark = pytest.mark.bench

RIGS = int(os.environ.get("CALIBRATION_RIGS", 40))
PROCESSES = int(os.environ.get("CALIBRATION_PROCESSES", os.cpu_count() or 1))
FOLDER = Path(os.environ.get("CALIBRATION_STUDY", "calibration-study"))
ARTEFACTS_EVERY = 4  # rigs; their scans take as long as three poses
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def report(text):
    print(text, file=sys.stderr, flush=True)


@pytest.fixture(scope="module")
def study():
    FOLDER.mkdir(exist_ok=True)
    done = []
    with pytest.MonkeyPatch.context() as patch:
        for name in _THREADS:
            patch.setenv(name, "1")
        # Started afresh, so that they read how many threads they may have.
        with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
            jobs = [pool.submit(studied, seed, FOLDER, seed % ARTEFACTS_EVERY == 0) for seed in range(RIGS)]
            for job in as_completed(jobs):
                done.append(job.result())
                report(f"  rig {done[-1]['seed']:3d} done, {len(done)} of {RIGS}")
    return sorted(done, key=lambda one: one["seed"])


def test_the_numbers_of_forty_rigs(study):
    report(
        "\n  seed   camera f  projector f   baseline   r.m.s. camera, px     r.m.s. projector, px  in 95 %  error/σ"
        "\n              %           %           %      (over expected)       (over expected)              r.m.s."
    )
    for one in study:
        report(
            f"  {one['seed']:4d}  {100 * one['camera']:9.5f}  {100 * one['projector']:10.5f}"
            f"  {100 * one['baseline']:10.5f}   {one['rms_camera']:.5f} ({one['ratio_camera']:.2f})"
            f"        {one['rms_projector']:.5f} ({one['ratio_projector']:.2f})"
            f"      {100 * one['inside']:4.0f}   {one['spread']:.2f}"
        )
    inside = float(np.mean([one["inside"] for one in study]))
    names = sorted({name for one in study for name in one["in_sigmas"]})
    report(f"  {100 * inside:.1f} % of all true values lie in their 95 % intervals; error over σ, r.m.s. by parameter:")
    for name in names:
        errors = [one["in_sigmas"][name] for one in study if name in one["in_sigmas"]]
        report(f"    {name:16s} {np.sqrt(np.mean(np.square(errors))):.2f}")
    assert max(one["camera"] for one in study) <= 3e-4
    assert max(one["projector"] for one in study) <= 6e-4
    assert max(abs(one["baseline"]) for one in study) <= 2e-4
    assert inside >= 0.90
    for lens in ("camera", "projector"):
        assert float(np.median([one[f"ratio_{lens}"] for one in study])) == pytest.approx(1, abs=0.15)


def test_artefacts_with_the_rig_found_and_with_the_true_one(study):
    report("\n  seed   figure             rig found, mm   true rig, mm")
    for one in study:
        for name, (found, true) in one["artefacts"].items():
            report(f"  {one['seed']:4d}   {name:18s} {found:12.4f} {true:14.4f}")
    for one in study:
        for name in ("FLATNESS", "PROBING_FORM"):
            if name in one["artefacts"]:
                found, true = one["artefacts"][name]
                assert found <= 1.5 * true


def solve_fifty():
    """Seconds and the process's most memory, GB, for fifty poses of a board with 117 points."""
    rng = np.random.default_rng(50)
    rig = random_rig(rng)
    poses = seen_all(rig, good_poses(rng, 50), rng, points=board_points())
    begin = time.perf_counter()
    found = calibrate_rig(poses, CAMERA_SIZE, PROJECTOR_SIZE)
    assert found.usable
    return time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def test_fifty_poses():
    seconds, memory = solve_fifty()
    report(f"\n  fifty poses: {seconds:.1f} s on {os.cpu_count()} cores, {memory:.2f} GB at most")
    assert seconds < 30
    assert memory < 2
